"""What a camera does to its pictures, in numbers that real frames and renders can share.

Every figure is of the picture as it is stored. None needs a target, a known scene or a label:
they are meant to be compared between sets of pictures, not to calibrate a camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from dmrl.geometry.frames import Array
from dmrl.images.codec import Rgb
from dmrl.rendering.lens import Picture

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
BLOCK_PX = 8
SMOOTH_SHARE = 0.1
"""Share of the blocks that are taken for smooth: those that differ least from a plane."""
DARKEST, BRIGHTEST = 16.0, 235.0
"""Levels between which neither black nor white hides the grain."""
REACH_PX = 4
"""An edge is looked for within so many pixels to either side."""
EDGE_SHARE = 0.02
"""Share of the pixels that are taken for edges: those with the greatest step across."""
CORNER, MIDDLE = 0.7, 0.1
"""Squared distances from the middle, 1 in the corner, that bound the corners and the middle."""


@dataclass(frozen=True, slots=True)
class Likeness:
    """What a set of pictures looks like, on average.

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
    grain
        Standard deviation of luma in smooth blocks, levels of 256.
    grain_correlation
        Of the grain of neighbouring pixels: 0 is white noise.
    edge_px
        Step across an edge over its steepest slope, pixels.
    corners
        Luma of the corners over that of the middle.
    """

    brightness: float
    contrast: float
    cast: float
    colour: float
    grain: float
    grain_correlation: float
    edge_px: float
    corners: float


FIGURES = tuple(field.name for field in fields(Likeness))
RATIOS = ("contrast", "cast", "corners", "grain", "edge_px")


def likeness(pictures: Sequence[Rgb]) -> Likeness:
    """Figures of a set of pictures: means over pictures, of ratios the geometric mean; 0 for none.

    Parameters
    ----------
    pictures
        (H, W, 3) uint8 each, of any size over 16 px.
    """
    rows = np.array([of_one(picture) for picture in pictures])
    return Likeness(*(mean_of(name, column) for name, column in zip(FIGURES, rows.T, strict=True)))


def mean_of(figure: str, values: Array) -> float:
    """Mean of the values that could be measured, geometric for ratios; 0 without any.

    Parameters
    ----------
    figure
        One of `FIGURES`.
    values
        (N,) of as many pictures; NaN where it could not be measured.
    """
    found = values[np.isfinite(values)]
    if not len(found):
        return 0.0
    if figure in RATIOS:
        return float(np.exp(np.log(np.maximum(found, 1e-3)).mean()))
    return float(found.mean())


def of_one(picture: Rgb) -> list[float]:
    """``FIGURES`` of one picture; NaN where it has no smooth block or no edge."""
    levels = picture.astype(np.float32)
    luma = levels @ LUMA
    mean = max(float(luma.mean()), 1.0)
    red, blue = (levels[..., k] / max(float(levels[..., k].mean()), 1.0) for k in (0, 2))
    cast = max(float(levels[..., 0].mean()), 1.0) / max(float(levels[..., 2].mean()), 1.0)
    colour = float((red - blue).std())
    return [
        *(mean / 255, float(luma.std()) / mean, cast, colour),
        *(*_grain(luma), _edge_px(luma), _corners(luma)),
    ]


def _grain(luma: Picture) -> tuple[float, float]:
    """Strength and neighbour correlation of what is left of smooth blocks without their plane."""
    height, width = (side // BLOCK_PX * BLOCK_PX for side in luma.shape)
    tiles = luma[:height, :width].reshape(height // BLOCK_PX, BLOCK_PX, -1, BLOCK_PX)
    blocks: Picture = tiles.swapaxes(1, 2).reshape(-1, BLOCK_PX * BLOCK_PX)
    middle = blocks.mean(axis=1)
    blocks = blocks[(middle > DARKEST) & (middle < BRIGHTEST)]
    if len(blocks) < 1 / SMOOTH_SHARE:
        return np.nan, np.nan
    place = np.linspace(-1, 1, BLOCK_PX, dtype=np.float32)
    v, u = (grid.ravel() for grid in np.meshgrid(place, place, indexing="ij"))
    plane = np.stack([np.ones_like(u), u, v], axis=1)
    left = blocks - (blocks @ np.linalg.pinv(plane).T) @ plane.T
    order = np.argsort(left.std(axis=1), kind="stable")[: int(len(left) * SMOOTH_SHARE)]
    smooth = left[order].reshape(-1, BLOCK_PX, BLOCK_PX)
    variance = float((smooth**2).mean())
    beside = float((smooth[:, :, 1:] * smooth[:, :, :-1]).mean())
    below = float((smooth[:, 1:] * smooth[:, :-1]).mean())
    return variance**0.5, (beside + below) / 2 / max(variance, 1e-6)


def _edge_px(luma: Picture) -> float:
    """Median width of the strongest edges, across and down."""
    steps, slopes = [], []
    for lines in (luma, luma.T):
        step = np.abs(lines[:, 2 * REACH_PX :] - lines[:, : -2 * REACH_PX])
        slope = np.abs(np.diff(lines, axis=1))
        steepest = sliding_window_view(slope, 2 * REACH_PX, axis=1).max(axis=-1)
        steps.append(step.ravel())
        slopes.append(steepest.ravel())
    step, steep = np.concatenate(steps), np.concatenate(slopes)
    strong = step >= np.quantile(step, 1 - EDGE_SHARE)
    if not step[strong].min() > 0:
        return np.nan
    return float(np.median(step[strong] / steep[strong]))


def _corners(luma: Picture) -> float:
    radius2 = radius2_of(*luma.shape)
    middle = float(luma[radius2 < MIDDLE].mean())
    return float(luma[radius2 > CORNER].mean()) / max(middle, 1.0)


def radius2_of(height: int, width: int) -> NDArray[np.float64]:
    """(H, W) squared distance from the middle, 1 in the corners."""
    v, u = np.mgrid[:height, :width] + 0.5
    return np.asarray(((u / width * 2 - 1) ** 2 + (v / height * 2 - 1) ** 2) / 2)
