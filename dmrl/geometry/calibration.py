"""Validation of the numbers of a calibration message."""

from collections.abc import Sequence

import numpy as np

from dmrl.geometry.frames import Array

PLUMB_BOB_MODELS = ("", "plumb_bob", "rational_polynomial")
"""Names of lens models equal to plumb bob, the last if its further coefficients are 0."""
SKEW_MAX = 1e-3
"""Largest skew of K over its focal length. A tenth of a pixel at the edge of most images."""
FOCAL_SHARES = (0.1, 100.0)
"""Focal lengths over the width of the images that are doubted beyond: 157 and 0.6 degrees wide."""
MAX_VALUE = 1e6
"""Maximum of a focal length and a principal point, pixels, and of a coefficient."""
ROI_KEYS, BINNING_KEYS = ("x_offset", "y_offset", "width", "height"), ("binning_x", "binning_y")
"""What `crop_and_bin` takes, as ROS names it."""


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
    if abs(k[1]) > SKEW_MAX * k[0] or any((k[3], k[6], k[7])):
        return "has a skew in K, or K is transposed"
    if min(width_px, height_px) <= 0:
        return f"has images of {width_px} x {height_px} px"
    return ""


def doubt_focal_length(width_px: int, fx_px: float) -> str:
    """Return a doubt about a focal length, such as about its unit, or an empty text."""
    if FOCAL_SHARES[0] <= fx_px / width_px <= FOCAL_SHARES[1]:
        return ""
    found = f"has a focal length of {fx_px:.3g} px for images {width_px} px wide"
    return f"{found}. Is it in mm, or a share?"


def find_lens_fault(model: str, d: Sequence[float]) -> str:
    """Return why the lens of a calibration is not of dmrl's model, or an empty text.

    Parameters
    ----------
    model
        Its ``distortion_model``.
    d
        D: distortion coefficients.
    """
    if model in PLUMB_BOB_MODELS and not any(d[5:]):
        return ""
    return f"has a lens of model {model!r} with {len(d)} coefficients, dmrl knows plumb_bob with 5"


def crop_and_bin(
    size_px: Sequence[float], roi_px: Sequence[float], binning: Sequence[float], *matrices: Array
) -> tuple[int, int]:
    """Change the matrices of a sensor to those of its images; return their width and height.

    ROS describes the whole sensor: its region of interest and then its binning are the images.

    Parameters
    ----------
    size_px
        Width and height of the sensor, pixels.
    roi_px
        Left, top, width and height of the region, pixels; a side of 0: all of the sensor.
    binning
        Pixels of the sensor in one of the image, along x and y; 0 is 1.
    matrices
        (2 or 3, 3 or 4) matrices in pixel-edge coordinates, changed in place.
    """
    bins = np.maximum(binning, 1)
    for matrix in matrices:
        matrix[:2, 2] -= roi_px[:2]
        matrix[:2] /= bins[:, None]
    width, height = (part or side for part, side in zip(roi_px[2:], size_px, strict=True))
    return int(width // bins[0]), int(height // bins[1])
