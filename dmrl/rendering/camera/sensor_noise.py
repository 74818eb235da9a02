"""Grain of a camera, apart from the texture of what it sees and from how bright that is.

Noise of light grows with light, so grain is told for every level by itself: else a dark street
would seem to have a finer camera than a bright wall. And a street has texture of its own. So a
block of a picture is measured where the block beside it is smooth: what a thing is like goes on
from block to block, while noise does not know its neighbour, so that none is favoured for having
little of it by chance, as it would be if blocks were chosen by their own.
"""

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.frames import Array
from dmrl.rendering.camera.distortion import Picture

BLOCK_PX = 8
SMOOTH_SHARE = 0.05
"""Share of the blocks of a level that are measured: those beside the smoothest."""
LEVELS = (16.0, 48.0, 80.0, 112.0, 144.0, 176.0, 208.0, 240.0)
"""Bounds of the levels that are told apart; beyond, black and white hide the grain."""
DARKEST, BRIGHTEST = 4.0, 251.0
"""Of a block's pixels: beyond, some may be cut off."""
LEAST_SHARE, LEAST_BLOCKS, FEWEST = 0.01, 40, 8
"""Of all blocks those of a level, how many that are, and of these measured, at least."""


@cache
def _flat() -> Array:
    """(64, 64) what takes a block's plane out of it."""
    place = np.linspace(-1, 1, BLOCK_PX)
    v, u = (grid.ravel() for grid in np.meshgrid(place, place, indexing="ij"))
    plane = np.stack([np.ones_like(u), u, v], axis=1)
    return np.asarray(np.eye(BLOCK_PX**2) - plane @ np.linalg.pinv(plane))


FREE = BLOCK_PX**2 - 3
"""Of the 64 pixels of a block, those that its plane leaves free."""


def _beside(blocks: Picture) -> Picture:
    """(N,) mean product of neighbours, across and down, of (N, 8, 8)."""
    across = (blocks[:, :, 1:] * blocks[:, :, :-1]).mean(axis=(1, 2))
    down = (blocks[:, 1:] * blocks[:, :-1]).mean(axis=(1, 2))
    return np.asarray((across + down) / 2)


@cache
def of_white() -> float:
    """Neighbours' correlation that taking out the plane leaves in white noise: under 0."""
    each = _flat().reshape(BLOCK_PX, BLOCK_PX, BLOCK_PX, BLOCK_PX)
    k = np.arange(BLOCK_PX)
    row, col = np.meshgrid(k, k[:-1], indexing="ij")
    product = (each[row, col, row, col + 1].mean() + each[col, row, col + 1, row].mean()) / 2
    return float(product * BLOCK_PX**2 / FREE)


@dataclass(frozen=True, slots=True)
class Grain:
    """Grain of a set of pictures.

    Parameters
    ----------
    grain
        Standard deviation, levels of 256: mean over what is dark, grey and bright alike. NaN
        where no block could be measured.
    grain_correlation
        Of neighbouring pixels: 0 is white noise. Median over levels, NaN likewise.
    """

    grain: float
    grain_correlation: float


def blocks_of(luma: Picture) -> NDArray[np.float32]:
    """(N, 4) of every block of a picture: level, variance, neighbours' product, next's variance."""
    height, width = luma.shape[0] // BLOCK_PX, luma.shape[1] // (2 * BLOCK_PX) * 2
    tiles = luma[: height * BLOCK_PX, : width * BLOCK_PX]
    tiles = tiles.reshape(height, BLOCK_PX, width, BLOCK_PX).swapaxes(1, 2)
    blocks: Picture = tiles.reshape(-1, BLOCK_PX**2)
    left: Picture = blocks @ _flat().astype(np.float32)
    variance = (left**2).sum(axis=1) / np.float32(FREE)
    product = _beside(left.reshape(-1, BLOCK_PX, BLOCK_PX)) * np.float32(BLOCK_PX**2 / FREE)
    whole = (blocks.min(axis=1) > DARKEST) & (blocks.max(axis=1) < BRIGHTEST)
    swapped = np.arange(len(blocks)) ^ 1  # the two of a pair lie beside each other
    measured = np.stack([blocks.mean(axis=1), variance, product, variance[swapped]], axis=1)
    return np.asarray(measured[whole & whole[swapped]], np.float32)


def grain_of(blocks: NDArray[np.float32]) -> Grain:
    """Grain of the blocks of a set of pictures.

    Parameters
    ----------
    blocks
        (N, 4) as `blocks_of` gives them, one picture's after the other.
    """
    middles, spreads, alike = [], [], []
    least = max(LEAST_BLOCKS, LEAST_SHARE * len(blocks))
    for low, high in pairwise(LEVELS):
        here = blocks[(blocks[:, 0] >= low) & (blocks[:, 0] < high)]
        if len(here) < least:
            continue
        count = max(FEWEST, int(len(here) * SMOOTH_SHARE))
        order = np.argsort(here[:, 3], kind="stable")[:count]
        variance, product = np.median(here[order, 1]), np.median(here[order, 2])
        middles.append((low + high) / 2)
        spreads.append(variance**0.5)
        alike.append(product / max(variance, 1e-6) - of_white())
    if not middles:
        return Grain(np.nan, np.nan)
    everywhere = np.interp([sum(pair) / 2 for pair in pairwise(LEVELS)], middles, spreads)
    return Grain(float(everywhere.mean()), float(np.median(alike)))
