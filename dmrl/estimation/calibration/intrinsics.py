"""Calibrate camera intrinsics from chessboard images, by OpenCV (Zhang 2000)."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dmrl.errors import MissingExtra
from dmrl.geometry.frames import Array, Camera

try:
    import cv2
except ImportError as e:
    raise MissingExtra("cv2", "calibrate", "dmrl calibrate") from e

cv2.setNumThreads(1)  # threads would add in a random order and change the last digits

MIN_BOARDS = 5
"""Fewest views of a board. With fewer, focal length and distortion are up to chance."""
WINDOW_SHARE = 0.45
"""Half the side of the refinement window of a corner, relative to the distance of its neighbours.
It contains as much of the edges as possible and nothing of another corner."""
MIN_WINDOW_PX, MAX_WINDOW_PX = 2, 11
"""Bounds of that half side, pixels. No record of how the values were chosen."""
MAX_DETECTION_PIXELS = 4_000_000
"""Largest image in which a board is detected, pixels. Larger ones are shrunk, as a blank one of
8,000 x 8,000 kept the detector busy for minutes."""
PROBED_FACTORS = (0.3, 0.5, 0.7, 0.97, 1.03, 1.4, 2.0, 3.0)
"""Multiples of the focal length at which its likelihood is measured. Boards without tilt fit all
focal lengths, far ones too, and OpenCV's standard errors are then those of a pseudo-inverse."""
SUBPIXEL_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
"""Stop criteria of the corner refinement: iterations and pixels."""


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Calibrated intrinsics with standard errors.

    Parameters
    ----------
    camera
        Focal lengths, centre and distortion. k3 is zero, since corners rarely reach far enough out
        to separate it from k1 and k2.
    focal_std_px, centre_std_px
        (2,) standard errors.
    rms_px
        Root mean square distance between corners and their projections.
    focal_share
        How far the focal length may be off, relative to it, by how well others fit; without tilted
        boards, OpenCV's standard errors may be tiny, and wrong.
    """

    camera: Camera
    focal_std_px: tuple[float, float]
    centre_std_px: tuple[float, float]
    rms_px: float
    focal_share: float


def find_corners(grey: NDArray[np.uint8], columns: int, rows: int) -> NDArray[np.float32] | None:
    """Find the (columns x rows, 2) inner corners of a board in an image; None without a board.

    Parameters
    ----------
    grey
        (H, W) image.
    columns, rows
        Inner corners of the board.

    Returns
    -------
    Array
        Pixel-edge coordinates: those of OpenCV plus half a pixel.
    """
    # Not CALIB_CB_NORMALIZE_IMAGE: it stretches flat backgrounds and hides boards in front of them.
    small, times = _shrink_image(grey)
    found, at = cv2.findChessboardCornersSB(small, (columns, rows), flags=cv2.CALIB_CB_EXHAUSTIVE)
    if not found:
        return None
    # The sector-based detector finds boards that others miss, but its corners are off by up to
    # 2 px, all in the same way within a board. The gradients at a corner (Foerstner) are unbiased.
    rough = np.asarray(at, np.float32).reshape(rows, columns, 2)
    rough = rough * np.float32(times) + np.float32((times - 1) / 2)  # centres of pixels
    half_px = int(np.clip(WINDOW_SHARE * _min_spacing(rough), MIN_WINDOW_PX, MAX_WINDOW_PX))
    window = (half_px, half_px)
    fine = cv2.cornerSubPix(grey, rough.reshape(-1, 1, 2), window, (-1, -1), SUBPIXEL_CRITERIA)
    return np.asarray(fine, np.float32).reshape(-1, 2) + np.float32(0.5)


def _shrink_image(grey: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], int]:
    """Return a smaller copy of a large image, and the scale to the original.

    The detector takes a third of a second per million pixels.
    """
    times = max(1, int(np.ceil(np.sqrt(grey.size / MAX_DETECTION_PIXELS))))
    if times == 1 or min(grey.shape) < times:
        return grey, 1
    size = grey.shape[1] // times, grey.shape[0] // times
    whole = grey[: size[1] * times, : size[0] * times]
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), np.uint8), times


def _min_spacing(at: NDArray[np.float32]) -> float:
    """Return the shortest distance between neighbours among (rows, columns, 2) corners, pixels."""
    steps = (np.linalg.norm(np.diff(at, axis=axis), axis=2).min() for axis in (0, 1))
    return float(min(steps))


def calibrate_intrinsics(
    boards: Iterable[NDArray[np.float32]], shape: tuple[int, int], size_px: tuple[int, int]
) -> Intrinsics:
    """Calibrate the camera from views of a board.

    Parameters
    ----------
    boards
        (columns x rows, 2) corners of each view, pixel-edge coordinates.
    shape
        Columns and rows of inner corners.
    size_px
        Width and height of the images.
    """
    columns, rows = shape
    flat = np.zeros((columns * rows, 3), np.float32)
    flat[:, :2] = np.mgrid[:columns, :rows].T.reshape(-1, 2)
    views = [view - np.float32(0.5) for view in boards]
    rms_px, matrix, bend, errors = _solve(flat, views, size_px, np.eye(3))
    fx, fy, cx, cy = (float(matrix[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
    fx_std, fy_std, cx_std, cy_std = (float(e) for e in errors[:4])
    camera = Camera(*size_px, fx, fy, cx + 0.5, cy + 0.5, tuple(bend[:5].tolist()))
    share = max(_probe_focal_share(flat, views, size_px, matrix, rms_px), fx_std / fx, fy_std / fy)
    return Intrinsics(camera, (fx_std, fy_std), (cx_std, cy_std), rms_px, share)


def _probe_focal_share(
    flat: NDArray[np.float32],
    views: list[NDArray[np.float32]],
    size_px: tuple[int, int],
    matrix: Array,
    rms_px: float,
) -> float:
    """Return the relative change of the focal length that raises the cost by one half."""
    # Two coordinates a corner; six numbers a pose, and eight of the camera.
    free = max(2 * flat.shape[0] * len(views) - 6 * len(views) - 8, 1)
    variance = rms_px**2 * flat.shape[0] * len(views) / free
    widest = 0.0
    for factor in PROBED_FACTORS:
        start = np.diag([factor * matrix[0, 0], factor * matrix[1, 1], 1.0])
        start[:2, 2] = np.array(size_px) / 2
        rms = _solve(flat, views, size_px, start, cv2.CALIB_FIX_FOCAL_LENGTH)[0]
        worse = (rms**2 - rms_px**2) * flat.shape[0] * len(views) / variance
        widest = max(widest, abs(np.log(factor)) / np.sqrt(worse) if worse > 0 else np.inf)
    return float(widest)


def _solve(
    flat: NDArray[np.float32],
    views: list[NDArray[np.float32]],
    size_px: tuple[int, int],
    start: Array,
    fixed: int = 0,
) -> tuple[float, Array, Array, Array]:
    """Return the residual, the matrix, distortion and standard errors.

    Without ``fixed``, a flag of OpenCV for what stays as in ``start``, OpenCV finds its own start.
    """
    flags = cv2.CALIB_FIX_K3 | (cv2.CALIB_USE_INTRINSIC_GUESS | fixed if fixed else 0)
    rms_px, matrix, bend, _, _, errors, _, _ = cv2.calibrateCameraExtended(
        [flat] * len(views), views, size_px, start.copy(), np.zeros(5), flags=flags
    )
    return float(rms_px), np.asarray(matrix), np.ravel(bend), np.ravel(errors)
