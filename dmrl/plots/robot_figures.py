"""Figure of a robot's model with its axes, its box and its size."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.plots.style import METADATA, STYLE, Figure, mpl, withStroke

AXES = (("x forward", "#e00000"), ("y left", "#007a00"), ("z up", "#0030e0"))
BOX_COLOUR = "#404040"
VIEW_INCHES = 3.6
NAME_PX = np.array([46.0, 14.0])
"""Distance from the end of an axis to its name, if horizontal and if vertical."""
MIN_AXIS_PX = 30
"""Minimum length of a drawn axis. One that points at the camera is only a dot."""


@dataclass(frozen=True, slots=True)
class Side:
    """A robot from one side.

    Parameters
    ----------
    name
        Name of the side.
    rgb
        (H, W, 3) uint8.
    axes_px
        (3, 2, 2) pixels of both ends of its axes x, y and z.
    edges_px
        (12, 2, 2) pixels of both ends of its box's edges.
    """

    name: str
    rgb: NDArray[np.uint8]
    axes_px: NDArray[np.float64]
    edges_px: NDArray[np.float64]


def plot_model_sides(sides: Sequence[Side], title: str, size_m: Sequence[float]) -> bytes:
    """Plot a robot from several sides as PNG.

    Parameters
    ----------
    sides
        Two or more, two per row.
    title
        Title above them.
    size_m
        (3,) size of the box along x, y and z, metres.
    """
    rows = -(-len(sides) // 2)
    words = " x ".join(f"{metres:.3g}" for metres in size_m)
    with mpl.rc_context(STYLE):
        figure = Figure((2 * VIEW_INCHES, rows * (VIEW_INCHES + 0.3) + 0.5), layout="constrained")
        figure.suptitle(f"{title}\nbox, x by y by z: {words} m", fontsize=10)
        places = figure.subplots(rows, 2).ravel()
        for axes in places:
            axes.axis("off")
        for axes, side in zip(places, sides, strict=False):
            _draw_side(axes, side)
        stream = io.BytesIO()
        figure.savefig(stream, format="png", dpi=150, metadata=METADATA[".png"])
    return stream.getvalue()


def _draw_side(axes: Any, side: Side) -> None:
    height, width = side.rgb.shape[:2]
    axes.imshow(side.rgb, extent=(0, width, height, 0))
    axes.set_title(side.name, fontsize=9)
    for ends in side.edges_px:
        axes.plot(*ends.T, color=BOX_COLOUR, linewidth=0.8, linestyle=(0, (4, 3)))
    rim = [withStroke(linewidth=2.5, foreground="white")]
    for (name, colour), (start, end) in zip(AXES, side.axes_px, strict=True):
        if np.hypot(*(end - start)) < MIN_AXIS_PX:
            continue
        arrow = {"arrowstyle": "-|>", "color": colour, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", xy=end, xytext=start, arrowprops=arrow)
        along = (end - start) / np.hypot(*(end - start))
        beyond = end + along * (NAME_PX @ np.abs(along))
        at = {"ha": "center", "va": "center", "fontsize": 9, "path_effects": rim}
        axes.text(*beyond, name, color=colour, **at)
    axes.set(xlim=(0, width), ylim=(height, 0))
