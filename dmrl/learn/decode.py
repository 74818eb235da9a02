"""Confidence and depth grids to detections. NumPy only.

A detection is a cell that is the most confident of its 3x3 neighbourhood, at the cell's
centre, in order of confidence. (The published code walks the cells in raster order.)
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Found:
    """Detections of N images, best first, K columns wide.

    Parameters
    ----------
    u_px, v_px, depth_m, confidence
        (N, K). Only the first ``count[i]`` columns of row i are detections.
    count
        (N,) detections in each image, at least 1.
    """

    u_px: Array
    v_px: Array
    depth_m: Array
    confidence: Array
    count: NDArray[np.int64]


def peaks(confidence: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Cells of (N, rows, cols) grids that no neighbour exceeds.

    Of equal neighbours the first in raster order is the peak, so every grid has one.
    """
    rows, cols = confidence.shape[1:]
    padded = np.pad(confidence, ((0, 0), (1, 1), (1, 1)), constant_values=-np.inf)
    peak = np.ones(confidence.shape, bool)
    for row in range(3):
        for col in range(3):
            neighbour = padded[:, row : row + rows, col : col + cols]
            if (row, col) < (1, 1):
                peak &= confidence > neighbour
            elif (row, col) > (1, 1):
                peak &= confidence >= neighbour
    return peak


def decode(
    confidence: NDArray[np.floating],
    depth_m: NDArray[np.floating],
    *,
    stride_px: int = 8,
    most: int = 20,
    min_confidence: float = 0.01,
) -> Found:
    """Detections in grids of the network's output.

    Parameters
    ----------
    confidence, depth_m
        (N, rows, cols): 0 to 1, and metres.
    stride_px
        Pixels per cell, both ways.
    most
        Keep at most this many per image.
    min_confidence
        Drop peaks below this, but never the best of an image.
    """
    images, rows, cols = confidence.shape
    score = np.where(peaks(confidence), confidence, -1.0).reshape(images, rows * cols)
    best = np.argsort(-score, axis=1, kind="stable")[:, :most]
    kept = np.take_along_axis(score, best, axis=1)
    row, col = np.divmod(best, cols)
    return Found(
        u_px=(col + 0.5) * stride_px,
        v_px=(row + 0.5) * stride_px,
        depth_m=np.take_along_axis(depth_m.reshape(images, -1), best, axis=1).astype(np.float64),
        confidence=kept.astype(np.float64),
        count=np.maximum((kept >= max(min_confidence, 0.0)).sum(axis=1), 1),
    )
