"""Measurement of a camera's noise, separated from the scene's texture and brightness.

Shot noise grows with light, so noise is measured per brightness level. Otherwise a dark scene
would appear to have a better camera than a bright one. Texture is excluded by measuring a block
only where the block beside it is smooth. Texture continues from block to block, but noise is
independent between blocks. Selecting blocks by their own smoothness would bias the noise down.
"""

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.frames import Array
from dmrl.rendering.camera.distortion import FloatImage

BLOCK_PX = 8
SMOOTH_SHARE = 0.05
"""Share of a level's blocks that are measured: those beside the smoothest blocks."""
LEVELS = (16.0, 48.0, 80.0, 112.0, 144.0, 176.0, 208.0, 240.0)
"""Bounds of the brightness levels. Outside them, clipping hides the noise."""
MIN_PIXEL, MAX_PIXEL = 4.0, 251.0
"""Range of a block's pixels. Outside it, some may be clipped."""
MIN_LEVEL_SHARE, MIN_LEVEL_BLOCKS, MIN_MEASURED_BLOCKS = 0.01, 40, 8
"""Minimum blocks of a level: as a share of all, as a number, and number of measured ones."""


@cache
def _plane_removal_matrix() -> Array:
    """Return the (64, 64) matrix that removes the plane of a block."""
    place = np.linspace(-1, 1, BLOCK_PX)
    v, u = (grid.ravel() for grid in np.meshgrid(place, place, indexing="ij"))
    plane = np.stack([np.ones_like(u), u, v], axis=1)
    return np.asarray(np.eye(BLOCK_PX**2) - plane @ np.linalg.pinv(plane))


FREE_PIXELS = BLOCK_PX**2 - 3
"""Degrees of freedom of a block after removing its plane."""


def _neighbour_products(blocks: FloatImage) -> FloatImage:
    """Return the (N,) mean product of neighbouring pixels of (N, 8, 8), across and down."""
    across = (blocks[:, :, 1:] * blocks[:, :, :-1]).mean(axis=(1, 2))
    down = (blocks[:, 1:] * blocks[:, :-1]).mean(axis=(1, 2))
    return np.asarray((across + down) / 2)


@cache
def white_noise_correlation() -> float:
    """Return the negative correlation of neighbours in white noise after removing the plane."""
    each = _plane_removal_matrix().reshape(BLOCK_PX, BLOCK_PX, BLOCK_PX, BLOCK_PX)
    k = np.arange(BLOCK_PX)
    row, col = np.meshgrid(k, k[:-1], indexing="ij")
    product = (each[row, col, row, col + 1].mean() + each[col, row, col + 1, row].mean()) / 2
    return float(product * BLOCK_PX**2 / FREE_PIXELS)


@dataclass(frozen=True, slots=True)
class NoiseEstimate:
    """Noise of a set of images.

    Parameters
    ----------
    grain
        Standard deviation, levels of 256, with equal weight of dark, grey and bright areas. NaN
        where no block could be measured.
    grain_correlation
        Correlation of neighbouring pixels, median over levels. 0 for white noise, NaN as above.
    """

    grain: float
    grain_correlation: float


def measure_blocks(luma: FloatImage) -> NDArray[np.float32]:
    """Measure (N, 4) blocks: level, variance, neighbours' product, variance of the block beside."""
    height, width = luma.shape[0] // BLOCK_PX, luma.shape[1] // (2 * BLOCK_PX) * 2
    tiles = luma[: height * BLOCK_PX, : width * BLOCK_PX]
    tiles = tiles.reshape(height, BLOCK_PX, width, BLOCK_PX).swapaxes(1, 2)
    blocks: FloatImage = tiles.reshape(-1, BLOCK_PX**2)
    left: FloatImage = blocks @ _plane_removal_matrix().astype(np.float32)
    variance = (left**2).sum(axis=1) / np.float32(FREE_PIXELS)
    product = _neighbour_products(left.reshape(-1, BLOCK_PX, BLOCK_PX)) * np.float32(
        BLOCK_PX**2 / FREE_PIXELS
    )
    whole = (blocks.min(axis=1) > MIN_PIXEL) & (blocks.max(axis=1) < MAX_PIXEL)
    swapped = np.arange(len(blocks)) ^ 1  # the two blocks of a pair are neighbours
    measured = np.stack([blocks.mean(axis=1), variance, product, variance[swapped]], axis=1)
    return np.asarray(measured[whole & whole[swapped]], np.float32)


def estimate_noise(blocks: NDArray[np.float32]) -> NoiseEstimate:
    """Estimate the noise from the blocks of a set of images.

    Parameters
    ----------
    blocks
        (N, 4) results of `measure_blocks`, concatenated.
    """
    middles, spreads, alike = [], [], []
    least = max(MIN_LEVEL_BLOCKS, MIN_LEVEL_SHARE * len(blocks))
    for low, high in pairwise(LEVELS):
        here = blocks[(blocks[:, 0] >= low) & (blocks[:, 0] < high)]
        if len(here) < least:
            continue
        count = max(MIN_MEASURED_BLOCKS, int(len(here) * SMOOTH_SHARE))
        order = np.argsort(here[:, 3], kind="stable")[:count]
        variance, product = np.median(here[order, 1]), np.median(here[order, 2])
        middles.append((low + high) / 2)
        spreads.append(variance**0.5)
        alike.append(product / max(variance, 1e-6) - white_noise_correlation())
    if not middles:
        return NoiseEstimate(np.nan, np.nan)
    everywhere = np.interp([sum(pair) / 2 for pair in pairwise(LEVELS)], middles, spreads)
    return NoiseEstimate(float(everywhere.mean()), float(np.median(alike)))
