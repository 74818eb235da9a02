"""Measure how the scene shifts between images by phase correlation.

Phase correlation (Kuglin and Hines, 1975) of small grey images needs no features and no
calibration. The shift of the whole scene follows the rotation of the camera.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TARGET_WIDTH_PX = 80
"""Approximate width of the shrunk images, pixels. Shrinking removes noise and keeps rotations. No
record of how the value was chosen."""
NOISE_PEAK = 7.0
"""Upper bound of the correlation peak of two noise images, times the root of their pixels. Chosen
to reject chance matches at any image size."""
MAX_INTERVAL_S = 0.5
"""Largest interval between two compared images, seconds. No record of how the value was chosen."""


def shrink_image(pixels: NDArray[np.uint8]) -> Array:
    """Shrink an image to the input of `estimate_shift`.

    Parameters
    ----------
    pixels
        (H, W, 3) or (H, W).

    Returns
    -------
    Array
        (h, w) means of square blocks of pixels, about ``TARGET_WIDTH_PX`` wide.
    """
    grey = pixels.mean(axis=2) if pixels.ndim == 3 else pixels.astype(float)
    side = max(round(grey.shape[1] / TARGET_WIDTH_PX), 1)
    height, width = (length // side for length in grey.shape)
    squares = grey[: height * side, : width * side].reshape(height, side, width, side)
    return np.asarray(squares.mean(axis=(1, 3)))


def estimate_shift(before: Array, after: Array) -> tuple[float, float] | None:
    """Estimate the shift of the scene from one image to the next.

    Parameters
    ----------
    before, after
        (h, w), see `shrink_image`.

    Returns
    -------
    tuple | None
        Shift right and down, in their pixels; None if the images have too little in common.
    """
    height, width = before.shape
    if after.shape != before.shape or min(height, width) < 8:
        return None
    window = np.outer(np.hanning(height), np.hanning(width))
    one, other = (np.fft.rfft2((p - p.mean()) * window) for p in (before, after))
    cross = other * np.conj(one)
    size = np.abs(cross)
    # Frequencies without energy have a random phase.
    cross /= np.maximum(size, 0.01 * size.mean() + 1e-12)
    peaks = np.fft.irfft2(cross, s=before.shape)
    row, col = np.unravel_index(int(peaks.argmax()), peaks.shape)
    if peaks[row, col] < NOISE_PEAK / np.sqrt(peaks.size):
        return None
    around = np.arange(-1, 2)
    right = col + _parabola_peak(peaks[row, (col + around) % width])
    down = row + _parabola_peak(peaks[(row + around) % height, col])
    return _wrap_shift(right, width), _wrap_shift(down, height)


def shift_rates(time_s: Array, moved: Array) -> tuple[Array, Array]:
    """Convert shifts to velocities of the scene in the image.

    Parameters
    ----------
    time_s
        (N,) times of the images, increasing.
    moved
        (N - 1, 2) shifts from each to the next, NaN where there is none.

    Returns
    -------
    tuple
        (M,) times halfway between two images, (M, 2) pixels per second, right and down.
    """
    step = np.diff(time_s)
    good = np.isfinite(moved).all(axis=1) & (step > 0) & (step < MAX_INTERVAL_S)
    return (time_s[:-1] + step / 2)[good], moved[good] / step[good, None]


def _parabola_peak(values: Array) -> float:
    """Return the peak of the parabola through three values, relative to the middle one."""
    left, middle, right = values.tolist()
    bend = left - 2 * middle + right
    return 0.0 if bend >= 0 else float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5))


def _wrap_shift(place: float, length: int) -> float:
    """Wrap a shift of a circular correlation to a signed one."""
    return place - length if place > length / 2 else place
