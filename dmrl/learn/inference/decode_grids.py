"""Grids of a network's output to detections. NumPy only.

A detection is a cell that is the most confident of its 3x3 neighbourhood, in order of
confidence. (The published code walks the cells in raster order.) It lies in the middle of the
cell or, where the network says so, at an offset from it; then two cells may name one robot,
and of detections closer than ``SAME_PX`` only the most confident stays.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PER_DETECTION = ("u_px", "v_px", "depth_m", "confidence", "sigma_depth_m", "class_id")
"""Columns of `Found`, named as the fields of a Detection."""
SAME_PX = 8.0
"""Detections closer than this are of one robot."""


class Grids(NamedTuple):
    """What a network says of N images.

    Parameters
    ----------
    confidence
        (N, rows, cols), 0 to 1.
    depth_m
        (N, rows, cols), metres.
    offset
        (N, 2, rows, cols) centre of the robot minus middle of the cell, (u, v), cells; None
        for a network that has no such channels.
    spread
        (N, rows, cols) scale b of the error of log depth, exp(-|error| / b); None likewise.
    class_id
        (N, rows, cols) the likeliest class; None likewise.
    """

    confidence: NDArray[np.floating]
    depth_m: NDArray[np.floating]
    offset: NDArray[np.floating] | None
    spread: NDArray[np.floating] | None = None
    class_id: NDArray[np.integer] | None = None


@dataclass(frozen=True, slots=True)
class Found:
    """Detections of N images, best first, K columns wide.

    Parameters
    ----------
    u_px, v_px, depth_m, confidence
        (N, K). Only the first ``count[i]`` columns of row i are detections.
    sigma_depth_m
        (N, K) standard deviation of the depth; 0 where the network does not say.
    class_id
        (N, K) the likeliest class; 0 where the network does not say.
    count
        (N,) detections in each image, at least 1.
    """

    u_px: Array
    v_px: Array
    depth_m: Array
    confidence: Array
    sigma_depth_m: Array
    class_id: NDArray[np.int64]
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
    offset: NDArray[np.floating] | None = None,
    spread: NDArray[np.floating] | None = None,
    class_id: NDArray[np.integer] | None = None,
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
    offset
        (N, 2, rows, cols) centre of the robot minus middle of the cell, (u, v), cells. None:
        the middle is as good as it gets.
    spread, class_id
        (N, rows, cols), as in `Grids`.
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
    uv = np.stack((col + 0.5, row + 0.5)).astype(np.float64)
    if offset is not None:
        flat = offset.reshape(images, 2, -1)
        uv += np.stack([np.take_along_axis(flat[:, axis], best, axis=1) for axis in range(2)])
        uv = np.clip(uv, 0, np.array([cols, rows])[:, None, None])
    uv *= stride_px

    def there(grid: NDArray[Any] | None) -> NDArray[Any]:
        """A grid's values where the detections are, 0 where there is no grid."""
        if grid is None:
            return np.zeros(best.shape, np.int64)
        return np.take_along_axis(grid.reshape(images, -1), best, axis=1)

    depth = there(depth_m).astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):  # a network may say anything
        sigma = np.sqrt(2) * depth * there(spread)  # Laplace
    count = np.maximum((kept >= max(min_confidence, 0.0)).sum(axis=1), 1)
    found = Found(uv[0], uv[1], depth, kept.astype(np.float64), sigma, there(class_id), count)
    return found if offset is None else _without_doubles(found)


def _without_doubles(found: Found) -> Found:
    """The same without detections that lie by a more confident one."""
    wide = found.u_px.shape[1]
    stays = np.arange(wide) < found.count[:, None]
    for k in range(1, int(found.count.max())):
        away_px = np.hypot(
            found.u_px[:, :k] - found.u_px[:, k : k + 1],
            found.v_px[:, :k] - found.v_px[:, k : k + 1],
        )
        stays[:, k] &= ~((away_px < SAME_PX) & stays[:, :k]).any(axis=1)
    # Those that stay first, in their order.
    first = np.argsort(~stays, axis=1, kind="stable")
    sorted_columns = {
        name: np.take_along_axis(getattr(found, name), first, axis=1) for name in PER_DETECTION
    }
    return Found(**sorted_columns, count=stays.sum(axis=1))
