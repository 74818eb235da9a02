"""Layouts of the viewer (rerun blueprints), in code.

Panels of one robot have the same bounds, so a cell of a map stands where its pixels stand.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb

from dmrl import topics
from dmrl.viewer.entities import Scale, channel_path, escaped
from dmrl.viewer.legend import HEIGHT_PX, bar_path, legend_path

TIMELINE = "log_time"
BACKGROUND = (24, 24, 24)
# Texts stand on a translucent grey, on which they cannot be read over a bright image.
IMAGE_OPACITY, BELOW_MAP_OPACITY = 0.75, 0.4
MARGIN_PX = 4


@dataclass(frozen=True, slots=True)
class Eye:
    """A robot's camera, as far as a layout must know it.

    Parameters
    ----------
    robot
        Its name.
    width_px, height_px
        Size of its images.
    channels
        Channels of its grid that are shown.
    """

    robot: str
    width_px: int
    height_px: int
    channels: tuple[str, ...]


def image(eyes: Sequence[Eye], scales: Mapping[str, Scale]) -> rrb.Blueprint:
    """Images with labels and detections; confidence and depth maps beside them.

    Parameters
    ----------
    eyes
        A single robot fills the window, with one panel more: confidence laid over the
        image. Of several, each has a row.
    scales
        Colours of the channels of the grids.
    """
    if len(eyes) == 1:
        views = _views(eyes[0], scales, alone=True)
        panels: rrb.Container = rrb.Grid(*views, grid_columns=min(len(views), 2))
    else:
        rows = [_views(eye, scales, alone=False) for eye in eyes]
        panels = rrb.Vertical(*(rrb.Horizontal(*row) for row in rows))
    return rrb.Blueprint(
        panels,
        rrb.TopPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="paused"),
        auto_layout=False,
        auto_views=False,
    )


def _views(eye: Eye, scales: Mapping[str, Scale], *, alone: bool) -> list[rrb.View]:
    picture = escaped(topics.camera_image(eye.robot))
    marks = [f"{escaped(topics.labels(eye.robot))}/**", escaped(topics.detections(eye.robot))]
    legend = escaped(legend_path(eye.robot))
    views: list[rrb.View] = [_view(eye, "image", [picture, *marks, legend])]
    heat = {
        channel: [
            escaped(channel_path(topics.grid(eye.robot), channel)),
            f"{escaped(bar_path(eye.robot, channel))}/**",
        ]
        for channel in eye.channels
    }
    if alone and "confidence" in heat:
        views.append(
            _view(
                eye,
                "confidence over image",
                [picture, *heat["confidence"]],
                opacity=BELOW_MAP_OPACITY,
            )
        )
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
        name=f"{eye.robot} {name}",
        contents=contents,
        visual_bounds=bounds,
        background=BACKGROUND,
        defaults=[
            rr.EncodedImage.from_fields(opacity=opacity),
            *(kind.from_fields(show_labels=False) for kind in kinds),
        ],
    )
