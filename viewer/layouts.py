"""Layouts of the viewer (rerun blueprints), in code.

Panels of one robot have the same bounds, so a cell of a map stands where its pixels stand.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb

from dmrl.viewer.drawing.archetypes import Scale, channel_path, texts_path
from dmrl.viewer.drawing.entity import escaped, image_frame
from dmrl.viewer.drawing.legend import HEIGHT_PX, bar_path, legend_path

TIMELINE = "log_time"
BACKGROUND = (24, 24, 24)
# Texts stand on a translucent grey, on which they cannot be read over a bright image.
IMAGE_OPACITY, BELOW_MAP_OPACITY = 0.75, 0.4
MARGIN_PX = 4
TRAIL_S = 4.0


@dataclass(frozen=True, slots=True)
class Eye:
    """What is seen in the images of one camera, as far as a layout must know it.

    Parameters
    ----------
    robot
        Whose camera.
    title
        What its panels are called.
    width_px, height_px
        Size of the images.
    picture, labels, detections, grid
        Where they stand.
    channels
        Channels of the grid that are shown.
    """

    robot: str
    title: str
    width_px: int
    height_px: int
    picture: str
    labels: str
    detections: str
    grid: str
    channels: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Space:
    """A 3D view.

    Parameters
    ----------
    frame
        What stands still in it.
    contents
        Entities.
    trails
        Those of which the last seconds are shown.
    position, target
        Where the eye is, and where it looks, metres.
    """

    frame: str
    contents: tuple[str, ...]
    trails: tuple[str, ...]
    position: tuple[float, float, float]
    target: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Plot:
    """A panel with lines over time.

    Parameters
    ----------
    title
        What is plotted, with its unit.
    contents
        Entities.
    range
        Fixed ends of the vertical axis; None: as the data are.
    band
        States in place of numbers.
    """

    title: str
    contents: tuple[str, ...]
    range: tuple[float, float] | None = None
    band: bool = False


def image(eyes: Sequence[Eye], scales: Mapping[str, Scale], *, overlay: bool) -> rrb.Blueprint:
    """Images with labels and detections; confidence and depth maps beside them.

    Parameters
    ----------
    eyes
        A single one fills the window, with one panel more: confidence laid over the
        image. Of several, each has a row.
    scales
        Colours of the channels of the grids.
    overlay
        Lay every map over the image.
    """
    if len(eyes) == 1:
        views = eye_views(eyes[0], scales, both=not overlay, overlay=overlay)
        if len(views) == 3:
            beside = rrb.Vertical(*views[1:])
            return window(rrb.Horizontal(views[0], beside, column_shares=[1.4, 1]))
        return window(rrb.Grid(*views, grid_columns=min(len(views), 2)))
    return window(_rows(eyes, scales, overlay=overlay))


def _rows(eyes: Sequence[Eye], scales: Mapping[str, Scale], *, overlay: bool) -> rrb.Container:
    rows = [eye_views(eye, scales, overlay=overlay) for eye in eyes]
    return rrb.Vertical(*(rrb.Horizontal(*row) for row in rows))


def compare(
    eyes: Sequence[Eye],
    scales: Mapping[str, Scale],
    plots: Sequence[Plot],
    table: str,
    *,
    overlay: bool,
) -> rrb.Blueprint:
    """A row for each model, below them their errors over time and a table of them."""
    rows = _rows(eyes, scales, overlay=overlay)
    if not plots:
        return window(rows)
    words = rrb.TextDocumentView(origin=escaped(table), name="both models")
    below = rrb.Horizontal(*(plot_view(plot) for plot in plots), words)
    return window(rrb.Vertical(rows, below, row_shares=[2.6, 1]))


def flight(
    spaces: Sequence[Space],
    eyes: Sequence[Eye],
    plots: Mapping[str, Sequence[Plot]],
) -> rrb.Blueprint:
    """Space and images above, plots below.

    Parameters
    ----------
    spaces
        3D views, in tabs.
    eyes
        Cameras whose images are shown.
    plots
        Panels by tab.
    """
    views = [eye_views(eye, {})[0] for eye in eyes]
    spatial = rrb.Tabs(*(_space_view(space) for space in spaces))
    above: rrb.Container = spatial
    if len(views) == 1:
        above = rrb.Horizontal(spatial, *views, column_shares=[1.2, 1])
    elif views:
        above = rrb.Horizontal(spatial, rrb.Grid(*views, grid_columns=2), column_shares=[1, 1.3])
    tabs = [
        rrb.Grid(*map(plot_view, panels), grid_columns=_columns(len(panels)), name=name)
        for name, panels in plots.items()
        if panels
    ]
    if not tabs:
        return window(above)
    return window(rrb.Vertical(above, rrb.Tabs(*tabs), row_shares=[1, 1]))


def _columns(panels: int) -> int:
    """Columns of a grid of plots, the more the fewer of its places stay empty."""
    return min((4, 3, 5), key=lambda columns: -panels % columns) if panels > 4 else panels


def dataset(
    eye: Eye,
    scales: Mapping[str, Scale],
    plot: Plot | None,
    facts: str,
    *,
    timeline: str,
    overlay: bool,
) -> rrb.Blueprint:
    """Row by row: image and maps, what the row is, and how large the errors are."""
    views = eye_views(eye, scales, both=not overlay, overlay=overlay)
    words = rrb.TextDocumentView(origin=escaped(facts), name="row")
    side = [words] if plot is None else [words, plot_view(plot)]
    panels = rrb.Horizontal(
        rrb.Grid(*views, grid_columns=2),
        rrb.Vertical(*side),
        column_shares=[3, 1],
    )
    return window(panels, timeline=timeline)


def window(panels: rrb.Container, timeline: str = TIMELINE) -> rrb.Blueprint:
    """Panels in a window that waits at the start."""
    return rrb.Blueprint(
        panels,
        rrb.TopPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state="paused"),
        auto_layout=False,
        auto_views=False,
    )


def eye_views(
    eye: Eye, scales: Mapping[str, Scale], *, both: bool = False, overlay: bool = False
) -> list[rrb.View]:
    """The image, and a panel for each map; ``both``: confidence also laid over the image."""
    picture = escaped(eye.picture)
    found = [eye.detections, texts_path(eye.detections)]
    marks = [f"{escaped(eye.labels)}/**", *map(escaped, found)]
    cell = escaped(f"{eye.grid}/best")
    views = [_view(eye, "image", [picture, *marks, escaped(legend_path(eye.robot))])]
    heat = {
        channel: [
            escaped(channel_path(eye.grid, channel)),
            f"{escaped(bar_path(eye.robot, channel))}/**",
            cell,
        ]
        for channel in eye.channels
        if channel in scales
    }
    over = list(heat) if overlay else ["confidence"] if both and "confidence" in heat else []
    for channel in over:
        contents = [picture, *heat[channel], *(marks if overlay else [])]
        what, comma, unit = scales[channel].title.partition(",")
        name = f"{what} over image{comma}{unit}"
        views.append(_view(eye, name, contents, texts=False, opacity=BELOW_MAP_OPACITY))
    if not overlay:
        for channel, paths in heat.items():
            views.append(_view(eye, scales[channel].title, [*paths, *marks], texts=False))
    return views


def _view(
    eye: Eye,
    name: str,
    contents: list[str],
    *,
    texts: bool = True,
    opacity: float = IMAGE_OPACITY,
) -> rrb.View:
    bounds = rrb.VisualBounds2D(
        x_range=(-MARGIN_PX, eye.width_px + MARGIN_PX),
        y_range=(-MARGIN_PX, eye.height_px + HEIGHT_PX),
    )
    kinds = () if texts else (rr.Points2D, rr.Boxes2D)
    return rrb.Spatial2DView(
        origin=escaped(eye.robot),
        name=f"{eye.title} {name}",
        contents=contents,
        visual_bounds=bounds,
        background=BACKGROUND,
        spatial_information=rrb.SpatialInformation(target_frame=image_frame(eye.robot)),
        defaults=[
            rr.EncodedImage.from_fields(opacity=opacity),
            rr.Image.from_fields(opacity=opacity),
            *(kind.from_fields(show_labels=False) for kind in kinds),
        ],
    )


def _space_view(space: Space) -> rrb.View:
    recent = rrb.VisibleTimeRanges(
        [
            rrb.VisibleTimeRange(
                TIMELINE,
                start=rrb.TimeRangeBoundary.cursor_relative(seconds=-TRAIL_S),
                end=rrb.TimeRangeBoundary.cursor_relative(),
            )
        ]
    )
    return rrb.Spatial3DView(
        origin="/",
        name=f"space, {space.frame}, grid 1 m",
        contents=[escaped(path) for path in space.contents],
        background=BACKGROUND,
        spatial_information=rrb.SpatialInformation(target_frame=space.frame),
        eye_controls=rrb.EyeControls3D(
            position=space.position, look_target=space.target, eye_up=(0, 0, 1)
        ),
        line_grid=rrb.LineGrid3D(spacing=1.0, color=[90, 90, 90]),
        overrides={escaped(path): recent for path in space.trails},
    )


def plot_view(plot: Plot) -> rrb.View:
    """A panel over time; all of them show the same stretch of it."""
    contents = [escaped(path) for path in plot.contents]
    shared = rrb.archetypes.TimeAxis(link="LinkToGlobal")
    if plot.band:
        return rrb.StateTimelineView(
            origin="/", name=plot.title, contents=contents, time_view=shared
        )
    return rrb.TimeSeriesView(
        origin="/",
        name=plot.title,
        contents=contents,
        axis_x=shared,
        axis_y=None if plot.range is None else rrb.ScalarAxis(range=plot.range),
        plot_legend=rrb.PlotLegend(corner="RightTop"),
        # A browser may have a light theme, on which bright lines cannot be seen.
        background=rrb.archetypes.PlotBackground(color=BACKGROUND),
    )
