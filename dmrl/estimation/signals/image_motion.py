"""How a camera turned between pictures, from the pictures alone.

Phase correlation (Kuglin and Hines, 1975) of small grey pictures: what moves is the whole
scene, so it takes no features and no calibration.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WIDTH_PX = 80
"""Pictures are shrunk to about this width: noise goes, and turns remain."""
CHANCE = 7.0
"""Peaks of two pictures of noise are lower than this over the root of their pixels."""
LONGEST_S = 0.5
"""Pictures further apart than this are not compared."""


def small(pixels: NDArray[np.uint8]) -> Array:
    """A picture as `shifts` wants it.

    Parameters
    ----------
    pixels
        (H, W, 3) or (H, W).

    Returns
    -------
    Array
        (h, w) means of squares of pixels, some ``WIDTH_PX`` wide.
    """
    grey = pixels.mean(axis=2) if pixels.ndim == 3 else pixels.astype(float)
    side = max(round(grey.shape[1] / WIDTH_PX), 1)
    height, width = (length // side for length in grey.shape)
    squares = grey[: height * side, : width * side].reshape(height, side, width, side)
    return np.asarray(squares.mean(axis=(1, 3)))


def shift(before: Array, after: Array) -> tuple[float, float] | None:
    """By how much the scene moved from one picture to the next.

    Parameters
    ----------
    before, after
        (h, w), see `small`.

    Returns
    -------
    tuple | None
        Right and down, in their pixels; None where the two have too little in common.
    """
    height, width = before.shape
    if after.shape != before.shape or min(height, width) < 8:
        return None
    window = np.outer(np.hanning(height), np.hanning(width))
    one, other = (np.fft.rfft2((p - p.mean()) * window) for p in (before, after))
    cross = other * np.conj(one)
    size = np.abs(cross)
    # Where both have next to nothing, the phase is noise.
    cross /= np.maximum(size, 0.01 * size.mean() + 1e-12)
    peaks = np.fft.irfft2(cross, s=before.shape)
    row, col = np.unravel_index(int(peaks.argmax()), peaks.shape)
    if peaks[row, col] < CHANCE / np.sqrt(peaks.size):
        return None
    around = np.arange(-1, 2)
    right = col + _vertex(peaks[row, (col + around) % width])
    down = row + _vertex(peaks[(row + around) % height, col])
    return _signed(right, width), _signed(down, height)


def rates(time_s: Array, moved: Array) -> tuple[Array, Array]:
    """Speed of the scene, from its shifts.

    Parameters
    ----------
    time_s
        (N,) of the pictures, increasing.
    moved
        (N - 1, 2) shifts from each to the next, NaN where none was found.

    Returns
    -------
    tuple
        (M,) times in the middle of two pictures, (M, 2) pixels per second, right and down.
    """
    step = np.diff(time_s)
    good = np.isfinite(moved).all(axis=1) & (step > 0) & (step < LONGEST_S)
    return (time_s[:-1] + step / 2)[good], moved[good] / step[good, None]


def _vertex(values: Array) -> float:
    """Where the parabola through three values has its top, from the middle one."""
    left, middle, right = values.tolist()
    bend = left - 2 * middle + right
    return 0.0 if bend >= 0 else float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5))


def _signed(place: float, length: int) -> float:
    return place - length if place > length / 2 else place
