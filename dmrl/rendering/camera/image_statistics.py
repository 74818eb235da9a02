"""What a camera does to its pictures, in numbers that real frames and renders can share.

Every figure is of the picture as it is stored. None needs a target, a known scene or a label:
they are meant to be compared between sets of pictures, not to calibrate a camera.
"""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import cache

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.frames import Array
from dmrl.images.codec import Rgb
from dmrl.rendering.camera.distortion import Picture
from dmrl.rendering.camera.sensor_noise import blocks_of, grain_of

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
REACH_PX = 4
"""An edge is looked for within so many pixels to either side."""
EDGE_SHARE = 0.02
"""Share of the pixels that are taken for edges: those with the greatest step across."""
CORNER, MIDDLE = 0.7, 0.1
"""Squared distances from the middle, 1 in the corner, that bound the corners and the middle."""


@dataclass(frozen=True, slots=True)
class Likeness:
    """What a set of pictures looks like, on average; None: nothing in them shows it.

    Parameters
    ----------
    brightness
        Mean luma, 0 to 1.
    contrast
        Standard deviation of luma over its mean.
    cast
        Mean red over mean blue: over 1 is warm.
    colour
        Standard deviation of red less blue, each over its mean: 0 for a grey camera.
    edge_px
        Step across an edge over its steepest slope, pixels.
    corners
        Luma of the corners over that of the middle, of all pictures together.
    grain
        Standard deviation of luma where things are smooth, levels of 256, of dark, grey and
        bright places alike.
    grain_correlation
        Of the grain of neighbouring pixels: 0 is white noise.
    """

    brightness: float | None
    contrast: float | None
    cast: float | None
    colour: float | None
    edge_px: float | None
    corners: float | None
    grain: float | None
    grain_correlation: float | None


FIGURES = tuple(field.name for field in fields(Likeness))
OF_ONE = FIGURES[:5]
"""Those that one picture has by itself."""
RATIOS = ("contrast", "cast", "edge_px")


@dataclass(frozen=True, slots=True)
class Seen:
    """What was measured of a set of pictures.

    Parameters
    ----------
    rows
        (N, 5) `OF_ONE` of every picture; NaN where it cannot be known.
    corners
        (N, 2) luma of its corners and of its middle.
    blocks
        (M, 4) of all pictures, see `dmrl.rendering.camera.sensor_noise`.
    """

    rows: Array
    corners: Array
    blocks: NDArray[np.float32]

    def values(self, figure: str) -> Array:
        """(N,) a figure of the pictures in which it can be known; (1,) of a figure of them all."""
        if figure in OF_ONE:
            column = self.rows[:, OF_ONE.index(figure)]
        elif figure == "corners":
            corner, middle = self.corners.mean(axis=0)
            column = np.array([corner / max(middle, 1.0)])
        else:
            column = np.array([getattr(grain_of(self.blocks), figure)])
        return np.asarray(column[np.isfinite(column)])

    def middle(self, figure: str) -> float | None:
        """Mean over pictures, of ratios the geometric mean."""
        found = self.values(figure)
        return middle_of(figure, found) if len(found) else None

    def likeness(self) -> Likeness:
        """All figures."""
        return Likeness(*(self.middle(figure) for figure in FIGURES))


def middle_of(figure: str, values: Array) -> float:
    """Mean of a figure's values, geometric for ratios.

    Parameters
    ----------
    figure
        One of `FIGURES`.
    values
        (N,) of as many pictures, one at least.
    """
    if figure in RATIOS:
        return float(np.exp(np.log(np.maximum(values, 1e-3)).mean()))
    return float(values.mean())


def seen(pictures: Iterable[Rgb]) -> Seen:
    """What can be measured of pictures.

    Parameters
    ----------
    pictures
        (H, W, 3) uint8 each, of any size over 16 px; one at least.
    """
    rows, corners, blocks = [], [], []
    for picture in pictures:
        levels = picture.astype(np.float32)
        luma: Picture = levels @ LUMA
        rows.append(_of_one(levels, luma))
        corners.append(_corners(luma))
        blocks.append(blocks_of(luma))
    return Seen(np.array(rows), np.array(corners), np.concatenate(blocks))


def _of_one(levels: Picture, luma: Picture) -> list[float]:
    """`OF_ONE` of one picture."""
    mean = max(float(luma.mean()), 1.0)
    red, blue = (levels[..., k] / max(float(levels[..., k].mean()), 1.0) for k in (0, 2))
    cast = max(float(levels[..., 0].mean()), 1.0) / max(float(levels[..., 2].mean()), 1.0)
    colour = float((red - blue).std())
    return [mean / 255, float(luma.std()) / mean, cast, colour, _edge_px(luma)]


def _edge_px(luma: Picture) -> float:
    """Median width of the strongest edges, across and down; NaN without any."""
    steps, slopes = [], []
    for lines in (luma, luma.T):
        step = np.abs(lines[:, 2 * REACH_PX :] - lines[:, : -2 * REACH_PX])
        slope = np.abs(np.diff(lines, axis=1))
        for reach in (1, 2, 4):  # the steepest of two, of four, of eight
            slope = np.maximum(slope[:, reach:], slope[:, :-reach])
        steps.append(step.ravel())
        slopes.append(slope.ravel())
    step, steep = np.concatenate(steps), np.concatenate(slopes)
    strong = step >= np.quantile(step, 1 - EDGE_SHARE)
    if not step[strong].min() > 0:
        return np.nan
    return float(np.median(step[strong] / steep[strong]))


def _corners(luma: Picture) -> list[float]:
    """Luma of the corners, and of the middle."""
    radius2 = radius2_of(*luma.shape)
    return [float(luma[part].mean()) for part in (radius2 > CORNER, radius2 < MIDDLE)]


@cache
def radius2_of(height: int, width: int) -> NDArray[np.float64]:
    """(H, W) squared distance from the middle, 1 in the corners."""
    v, u = np.mgrid[:height, :width] + 0.5
    return np.asarray(((u / width * 2 - 1) ** 2 + (v / height * 2 - 1) ** 2) / 2)
