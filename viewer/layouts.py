"""Layouts of the viewer (rerun blueprints), in code.

Panels of one robot have equal bounds, so a map's cell has the same position as its pixels.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import rerun as rr
import rerun.blueprint as rrb

from dmrl.viewer.drawing.archetypes import ColourScale, channel_path, texts_path
from dmrl.viewer.drawing.entity import escape_path, image_frame
from dmrl.viewer.drawing.legend import LEGEND_HEIGHT_PX, bar_path, legend_path

TIMELINE = "log_time"
BACKGROUND = (24, 24, 24)
# Labels have a translucent grey background and are unreadable over a bright image.
IMAGE_OPACITY, BELOW_MAP_OPACITY = 0.75, 0.4
MARGIN_PX = 4
TRAIL_LENGTH_S = 4.0
"""Length of a trail in a 3D view, seconds."""


@dataclass(frozen=True, slots=True)
class CameraPanel:
    """Content of the panels of one camera.

    Parameters
    ----------
    robot
        Robot that carries the camera.
    title
        Start of the panels' titles.
    width_px, height_px
        Size of the images.
    picture, labels, detections, grid
        Entity paths.
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
class SpacePanel:
    """A 3D view.

    Parameters
    ----------
    frame
        Fixed frame of the view.
    contents
        Entities.
    trails
        Entities that show their last seconds.
    position, target
        Position of the viewpoint, and the point that it faces, metres.
    """

    frame: str
    contents: tuple[str, ...]
    trails: tuple[str, ...]
    position: tuple[float, float, float]
    target: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class PlotPanel:
    """A panel with lines over time.

    Parameters
    ----------
    title
        Quantity and unit.
    contents
        Entities.
    range
        Fixed limits of the vertical axis; None: limits of the data.
    band
        Show states in place of numbers.
    """

    title: str
    contents: tuple[str, ...]
    range: tuple[float, float] | None = None
    band: bool = False


def build_image_layout(
    cameras: Sequence[CameraPanel], scales: Mapping[str, ColourScale], *, overlay: bool
) -> rrb.Blueprint:
    """Build a layout of images with labels and detections, and their maps beside them.

    Parameters
    ----------
    cameras
        A single camera fills the window and gets an extra panel: confidence laid over the image.
        Several cameras get a row each.
    scales
        Colours of the channels of the grids.
    overlay
        Lay every map over the image.
    """
    if len(cameras) == 1:
        views = build_camera_views(cameras[0], scales, both=not overlay, overlay=overlay)
        if len(views) == 3:
            beside = rrb.Vertical(*views[1:])
            return build_window(rrb.Horizontal(views[0], beside, column_shares=[1.4, 1]))
        return build_window(rrb.Grid(*views, grid_columns=min(len(views), 2)))
    return build_window(_build_rows(cameras, scales, overlay=overlay))


def _build_rows(
    cameras: Sequence[CameraPanel], scales: Mapping[str, ColourScale], *, overlay: bool
) -> rrb.Container:
    rows = [build_camera_views(camera, scales, overlay=overlay) for camera in cameras]
    return rrb.Vertical(*(rrb.Horizontal(*row) for row in rows))


def build_compare_layout(
    cameras: Sequence[CameraPanel],
    scales: Mapping[str, ColourScale],
    plots: Sequence[PlotPanel],
    table: str,
    *,
    overlay: bool,
) -> rrb.Blueprint:
    """Build a layout with a row per model; below them, their errors over time and a table."""
    rows = _build_rows(cameras, scales, overlay=overlay)
    if not plots:
        return build_window(rows)
    words = rrb.TextDocumentView(origin=escape_path(table), name="both models")
    below = rrb.Horizontal(*(build_plot_view(plot) for plot in plots), words)
    return build_window(rrb.Vertical(rows, below, row_shares=[2.6, 1]))


def build_flight_layout(
    spaces: Sequence[SpacePanel],
    cameras: Sequence[CameraPanel],
    plots: Mapping[str, Sequence[PlotPanel]],
    scales: Mapping[str, ColourScale],
) -> rrb.Blueprint:
    """Build a layout with 3D views and images above, and plots below.

    Parameters
    ----------
    spaces
        3D views, in tabs.
    cameras
        Cameras whose images are shown.
    plots
        Panels by tab.
    scales
        Colours of the maps that are shown beside the images.
    """
    views = [view for camera in cameras for view in build_camera_views(camera, scales)]
    spatial = rrb.Tabs(*(_build_space_view(space) for space in spaces))
    above: rrb.Container = spatial
    if len(views) == 1:
        above = rrb.Horizontal(spatial, *views, column_shares=[1.2, 1])
    elif views:
        above = rrb.Horizontal(spatial, rrb.Grid(*views, grid_columns=2), column_shares=[1, 1.3])
    tabs = [
        rrb.Grid(
            *map(build_plot_view, panels), grid_columns=_choose_columns(len(panels)), name=name
        )
        for name, panels in plots.items()
        if panels
    ]
    if not tabs:
        return build_window(above)
    return build_window(rrb.Vertical(above, rrb.Tabs(*tabs), row_shares=[1, 1]))


def _choose_columns(panels: int) -> int:
    """Choose the number of columns that leaves the fewest places of a grid of plots empty."""
    return min((4, 3, 5), key=lambda columns: -panels % columns) if panels > 4 else panels


def build_dataset_layout(
    camera: CameraPanel,
    scales: Mapping[str, ColourScale],
    plot: PlotPanel | None,
    facts: str,
    *,
    timeline: str,
    overlay: bool,
) -> rrb.Blueprint:
    """Build a layout for one row at a time: image and maps, facts about the row, and its error."""
    views = build_camera_views(camera, scales, both=not overlay, overlay=overlay)
    words = rrb.TextDocumentView(origin=escape_path(facts), name="row")
    side = [words] if plot is None else [words, build_plot_view(plot)]
    images = rrb.Grid(*views, grid_columns=2)
    panels = rrb.Horizontal(images, rrb.Vertical(*side), column_shares=[3, 1])
    return build_window(panels, timeline=timeline)


def build_window(
    panels: rrb.Container,
    timeline: str = TIMELINE,
    *,
    play: Literal["paused", "following"] = "paused",
) -> rrb.Blueprint:
    """Build a window with these panels, paused at the start or following what arrives."""
    return rrb.Blueprint(
        panels,
        rrb.TopPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state=play),
        auto_layout=False,
        auto_views=False,
    )


def build_camera_views(
    camera: CameraPanel,
    scales: Mapping[str, ColourScale],
    *,
    both: bool = False,
    overlay: bool = False,
) -> list[rrb.View]:
    """Build views of the image and of each map; ``both``: also confidence over the image."""
    picture = escape_path(camera.picture)
    found = [camera.detections, texts_path(camera.detections)]
    marks = [f"{escape_path(camera.labels)}/**", *map(escape_path, found)]
    cell = escape_path(f"{camera.grid}/best")
    shown = [picture, *marks, escape_path(legend_path(camera.robot))]
    views = [_build_image_view(camera, "image", shown)]
    heat = {
        channel: [
            escape_path(channel_path(camera.grid, channel)),
            f"{escape_path(bar_path(camera.robot, channel))}/**",
            cell,
        ]
        for channel in camera.channels
        if channel in scales
    }
    over = list(heat) if overlay else ["confidence"] if both and "confidence" in heat else []
    for channel in over:
        contents = [picture, *heat[channel], *(marks if overlay else [])]
        what, comma, unit = scales[channel].title.partition(",")
        name = f"{what} over image{comma}{unit}"
        views.append(
            _build_image_view(camera, name, contents, texts=False, opacity=BELOW_MAP_OPACITY)
        )
    if not overlay:
        for channel, paths in heat.items():
            views.append(
                _build_image_view(camera, scales[channel].title, [*paths, *marks], texts=False)
            )
    return views


def _build_image_view(
    camera: CameraPanel,
    name: str,
    contents: list[str],
    *,
    texts: bool = True,
    opacity: float = IMAGE_OPACITY,
) -> rrb.View:
    bounds = rrb.VisualBounds2D(
        x_range=(-MARGIN_PX, camera.width_px + MARGIN_PX),
        y_range=(-MARGIN_PX, camera.height_px + LEGEND_HEIGHT_PX),
    )
    kinds = () if texts else (rr.Points2D, rr.Boxes2D)
    return rrb.Spatial2DView(
        origin=escape_path(camera.robot),
        name=f"{camera.title} {name}",
        contents=contents,
        visual_bounds=bounds,
        background=BACKGROUND,
        spatial_information=rrb.SpatialInformation(target_frame=image_frame(camera.robot)),
        defaults=[
            rr.EncodedImage.from_fields(opacity=opacity),
            rr.Image.from_fields(opacity=opacity),
            *(kind.from_fields(show_labels=False) for kind in kinds),
        ],
    )


def _build_space_view(space: SpacePanel) -> rrb.View:
    recent = rrb.VisibleTimeRanges(
        [
            rrb.VisibleTimeRange(
                TIMELINE,
                start=rrb.TimeRangeBoundary.cursor_relative(seconds=-TRAIL_LENGTH_S),
                end=rrb.TimeRangeBoundary.cursor_relative(),
            )
        ]
    )
    return rrb.Spatial3DView(
        origin="/",
        name=f"space, {space.frame}, grid 1 m",
        contents=[escape_path(path) for path in space.contents],
        background=BACKGROUND,
        spatial_information=rrb.SpatialInformation(target_frame=space.frame),
        eye_controls=rrb.EyeControls3D(
            position=space.position, look_target=space.target, eye_up=(0, 0, 1)
        ),
        line_grid=rrb.LineGrid3D(spacing=1.0, color=[90, 90, 90]),
        overrides={escape_path(path): recent for path in space.trails},
    )


def build_plot_view(plot: PlotPanel) -> rrb.View:
    """Build a panel over time; all such panels share their time range."""
    contents = [escape_path(path) for path in plot.contents]
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
        # A browser may have a light theme, on which bright lines are invisible.
        background=rrb.archetypes.PlotBackground(color=BACKGROUND),
    )
