"""Sliding windows of convolutions and max-pools as arrays, for any number type."""

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Number = TypeVar("Number", bound=np.generic)


def extract_taps(
    padded: NDArray[Number], kernel: int, stride: int, dilation: int
) -> NDArray[Number]:
    """Extract every input of every output of a convolution (im2col).

    Parameters
    ----------
    padded
        (..., channels, rows, cols), padding included.
    kernel, stride, dilation
        The same both ways.

    Returns
    -------
    NDArray
        (..., channels, kernel * kernel, out_rows, out_cols), kernel positions in raster order.
    """
    reach = dilation * (kernel - 1)
    rows, cols = ((side - reach - 1) // stride + 1 for side in padded.shape[-2:])
    places = range(0, reach + 1, dilation)
    windows = [
        padded[
            ...,
            top : top + stride * (rows - 1) + 1 : stride,
            left : left + stride * (cols - 1) + 1 : stride,
        ]
        for top in places
        for left in places
    ]
    return np.stack(windows, axis=-3)


def max_pool_2x2(x: NDArray[Number]) -> NDArray[Number]:
    """Return (..., rows // 2, cols // 2) the maximum of each 2x2 block."""
    rows, cols = x.shape[-2] // 2, x.shape[-1] // 2
    blocks = x[..., : 2 * rows, : 2 * cols].reshape(*x.shape[:-2], rows, 2, cols, 2)
    out: NDArray[Any] = blocks.max(axis=(-3, -1))
    return out
