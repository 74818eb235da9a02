"""Draw the legend and the colour bars below the image and the maps, in image pixels."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import takewhile

import numpy as np
import rerun as rr

from dmrl.viewer.drawing.archetypes import Colour, ColourScale, build_still_map, map_style
from dmrl.viewer.drawing.entity import LINE_UI, Entity, image_frame

LEGEND_HEIGHT_PX = 26
"""Height of the legend and the colour bars below an image, pixels."""

MARK_PX, BAR_PX, BAR_STEPS = 6, 6, 64
TEXT_COLOUR = (128, 128, 128)
"""Grey that is readable on a dark theme and on a light one."""
MAX_CHARACTERS, GAP_CHARACTERS = 50, 4
"""Characters that fit side by side in a panel of a quarter of the window, and gap between names."""


def legend_path(robot: str) -> str:
    """Return the entity path of a robot's legend of sources."""
    return f"/{robot}/legend/sources"


def bar_path(robot: str, channel: str) -> str:
    """Return the entity path above the colour bar of a channel, and its ticks."""
    return f"/{robot}/legend/{channel}"


def draw_legend(robot: str, colours: Mapping[str, Colour], width_px: int, height_px: int) -> Entity:
    """Draw a line in the colour of each source, with its name."""
    names = _fit_names(list(colours))
    takes = np.array([len(name) + GAP_CHARACTERS for name in names])
    middle_px = (np.cumsum(takes) - takes / 2) * width_px / max(MAX_CHARACTERS, takes.sum())
    left_px, y_px = (middle_px - MARK_PX).tolist(), height_px + MARK_PX
    marks = rr.LineStrips2D(
        [[[x_px, y_px], [x_px + 2 * MARK_PX, y_px]] for x_px in left_px],
        colors=list(colours.values()),
        labels=names,
        radii=2 * LINE_UI,
    )
    return Entity(legend_path(robot), style=(marks,), frame=image_frame(robot))


def _fit_names(names: Sequence[str]) -> list[str]:
    """Truncate names to fit side by side; long names keep the part in which they differ."""
    length = max(map(len, names), default=0)
    while (
        length > 3
        and sum(min(len(name), length) + GAP_CHARACTERS for name in names) > MAX_CHARACTERS
    ):
        length -= 1
    long = [name for name in names if len(name) > length]
    first, last = _common_prefix_length(long), _common_prefix_length([name[::-1] for name in long])
    return [
        name if len(name) <= length else _strip_common(name, length, first, last) for name in names
    ]


def _common_prefix_length(names: Sequence[str]) -> int:
    """Return the length of the common prefix of two or more names."""
    if len(names) < 2:
        return 0
    columns = zip(*names, strict=False)
    return sum(1 for _ in takewhile(lambda letters: len(set(letters)) == 1, columns))


def _strip_common(name: str, length: int, first: int, last: int) -> str:
    """Remove the common prefix and suffix of a name, and truncate it if it is still too long."""
    own = name[first : len(name) - last]
    kept = f"{'…' * (first > 0)}{own}{'…' * (last > 0)}"
    return kept if len(kept) <= length else f"{kept[: length - 1]}…"


def draw_colour_bars(
    robot: str, scales: Mapping[str, ColourScale], width_px: int, height_px: int
) -> Iterator[Entity]:
    """Draw a bar with three ticks for each channel of the grid."""
    left_px, length_px = width_px / 10, width_px * 8 / 10
    top_px = height_px + BAR_PX / 2
    shares = (0.0, 0.5, 1.0)
    at_px = [left_px + length_px * share for share in shares]
    for channel, scale in scales.items():
        steps = np.linspace(0.0, scale.last, BAR_STEPS, dtype=np.float32)
        ticks = rr.LineStrips2D(
            [[[x_px, top_px], [x_px, top_px + BAR_PX]] for x_px in at_px],
            colors=[TEXT_COLOUR],
            labels=[f"{scale.last * share:g}{scale.unit}" for share in shares],
            radii=LINE_UI,
        )
        path = bar_path(robot, channel)
        frame = f"{image_frame(robot)}/bar/{channel}"
        place = rr.Transform3D(
            translation=[left_px, top_px, 0],
            scale=[length_px / BAR_STEPS, BAR_PX, 1],
            child_frame=frame,
            parent_frame=image_frame(robot),
        )
        bar = build_still_map(scale, steps[None]), map_style(scale), place
        yield Entity(f"{path}/bar", style=bar, frame=frame)
        yield Entity(f"{path}/ticks", style=(ticks,), frame=image_frame(robot))
