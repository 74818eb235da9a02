"""Decoding of output grids to detections. NumPy only.

A detection is a cell with the highest confidence in its 3x3 neighbourhood. Detections are sorted by
confidence; the published code uses raster order. A detection lies at the centre of its cell or,
if the network has offset channels, at the offset from it. With offsets, two cells may locate the
same robot: of detections closer than ``DUPLICATE_RADIUS_PX``, only the most confident is kept.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmrl.errors import SettingError

Array = NDArray[np.float64]

DETECTION_COLUMNS = ("u_px", "v_px", "depth_m", "confidence", "sigma_depth_m", "class_id")
"""Columns of `Detections`, named as the fields of a Detection message."""
DUPLICATE_RADIUS_PX = 8.0
"""Detections closer than this, in pixels, belong to one robot."""


class Grids(NamedTuple):
    """Output of a network for N images.

    Parameters
    ----------
    confidence
        (N, rows, cols), 0 to 1.
    depth_m
        (N, rows, cols), metres.
    offset
        (N, 2, rows, cols) robot centre minus cell centre, (u, v), cells; None without these
        channels.
    spread
        (N, rows, cols) scale b of the error of log depth, exp(-|error| / b); None without it.
    class_id
        (N, rows, cols) the most likely class; None without class channels.
    """

    confidence: NDArray[np.floating]
    depth_m: NDArray[np.floating]
    offset: NDArray[np.floating] | None
    spread: NDArray[np.floating] | None = None
    class_id: NDArray[np.integer] | None = None


@dataclass(frozen=True, slots=True)
class Detections:
    """Detections of N images, most confident first, K columns wide.

    Parameters
    ----------
    u_px, v_px, depth_m, confidence
        (N, K). Only the first ``count[i]`` columns of row i are detections.
    sigma_depth_m
        (N, K) standard deviation of the depth; 0 without a spread channel.
    class_id
        (N, K) the most likely class; 0 without class channels.
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


def require_whole_cells(
    size_px: tuple[int, int], stride_px: int, network: str, what: object
) -> None:
    """Raise SettingError unless images of this width and height divide into grid cells.

    Parameters
    ----------
    size_px
        Width and height of the images.
    stride_px
        Side of a grid cell.
    network, what
        Names of the network and of the images, for the error.
    """
    width_px, height_px = size_px
    if width_px % stride_px or height_px % stride_px:
        raise SettingError(
            f"{what}: images of {width_px} x {height_px} px do not divide into cells of "
            f"{stride_px} px, as {network} needs. Convert them again: dmrl convert ... "
            f"{_whole_size(size_px, stride_px)}"
        )


def _whole_size(size_px: tuple[int, int], stride_px: int) -> str:
    """Return flags of ``dmrl convert`` for the largest whole cells in images of this size."""
    width_px, height_px = (max(side // stride_px, 1) * stride_px for side in size_px)
    return f"--width-px {width_px} --height-px {height_px}"


def find_peaks(confidence: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return the local maxima of (N, rows, cols) grids.

    Of equal neighbours, the first in raster order is the maximum, so every grid has one.
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
) -> Detections:
    """Decode the output grids of a network to detections.

    Parameters
    ----------
    confidence, depth_m
        (N, rows, cols): 0 to 1, and metres.
    offset
        (N, 2, rows, cols) robot centre minus cell centre, (u, v), cells. None: positions are cell
        centres.
    spread, class_id
        (N, rows, cols), as in `Grids`.
    stride_px
        Pixels per cell, both ways.
    most
        Maximum number of detections per image.
    min_confidence
        Drop peaks below this confidence, but always keep the best of an image.
    """
    images, rows, cols = confidence.shape
    score = np.where(find_peaks(confidence), confidence, -1.0).reshape(images, rows * cols)
    best = np.argsort(-score, axis=1, kind="stable")[:, :most]
    kept = np.take_along_axis(score, best, axis=1)
    row, col = np.divmod(best, cols)
    uv = np.stack((col + 0.5, row + 0.5)).astype(np.float64)
    if offset is not None:
        flat = offset.reshape(images, 2, -1)
        uv += np.stack([np.take_along_axis(flat[:, axis], best, axis=1) for axis in range(2)])
        uv = np.clip(uv, 0, np.array([cols, rows])[:, None, None])
    uv *= stride_px

    def gather_cells(grid: NDArray[Any] | None) -> NDArray[Any]:
        """Return a grid's values at the detections, 0 if there is no grid."""
        if grid is None:
            return np.zeros(best.shape, np.int64)
        return np.take_along_axis(grid.reshape(images, -1), best, axis=1)

    depth = gather_cells(depth_m).astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):  # outputs can be arbitrarily large
        sigma = np.sqrt(2) * depth * gather_cells(spread)  # Laplace
    count = np.maximum((kept >= max(min_confidence, 0.0)).sum(axis=1), 1)
    found = Detections(
        uv[0], uv[1], depth, kept.astype(np.float64), sigma, gather_cells(class_id), count
    )
    return found if offset is None else _drop_duplicates(found)


def _drop_duplicates(found: Detections) -> Detections:
    """Drop detections that are close to a more confident one."""
    wide = found.u_px.shape[1]
    stays = np.arange(wide) < found.count[:, None]
    for k in range(1, int(found.count.max())):
        away_px = np.hypot(
            found.u_px[:, :k] - found.u_px[:, k : k + 1],
            found.v_px[:, :k] - found.v_px[:, k : k + 1],
        )
        stays[:, k] &= ~((away_px < DUPLICATE_RADIUS_PX) & stays[:, :k]).any(axis=1)
    # Kept detections first, in their order.
    first = np.argsort(~stays, axis=1, kind="stable")
    sorted_columns = {
        name: np.take_along_axis(getattr(found, name), first, axis=1) for name in DETECTION_COLUMNS
    }
    return Detections(**sorted_columns, count=stays.sum(axis=1))
