"""Validation of the numbers of a calibration message."""

from collections.abc import Sequence

import numpy as np

MAX_VALUE = 1e6
"""Maximum of a focal length and a principal point, pixels, and of a coefficient."""


def find_calibration_fault(
    width_px: int, height_px: int, k: Sequence[float], d: Sequence[float]
) -> str:
    """Return the fault of a camera calibration, or an empty text if it is valid.

    Parameters
    ----------
    width_px, height_px
        Size of its images, pixels.
    k
        K of ``foxglove.CameraCalibration``: 9 numbers, row by row, pixels. All zero or empty for
        an uncalibrated camera.
    d
        D: distortion coefficients.
    """
    if not any(k):
        return "is not calibrated: K is zero or missing"
    if len(k) != 9:
        return f"has {len(k)} numbers in K, not 9"
    if not np.isfinite([*k, *d]).all() or np.abs([*k, *d]).max() > MAX_VALUE:
        return "has numbers in K or D that are not finite or too large"
    if min(k[0], k[4]) <= 0:
        return "has a focal length that is not above 0"
    if min(width_px, height_px) <= 0:
        return f"has images of {width_px} x {height_px} px"
    return ""
