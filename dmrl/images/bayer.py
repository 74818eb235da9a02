"""Conversion between raw Bayer images and RGB, with OpenCV."""

import re
from types import ModuleType
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dmrl.errors import MissingExtra
from dmrl.images.codec import Grey, Rgb

Value = TypeVar("Value", bound=np.generic)
RAW_FORMAT = re.compile(r"bayer_([rgb]{4})(?:8|16)\b")
BAYER_MIN_PX = 4
"""Smallest width and height of a raw image whose colours can be interpolated."""


def load_opencv(extra: str = "bayer", what: str = "a raw picture") -> ModuleType:
    """Import OpenCV.

    Parameters
    ----------
    extra, what
        Extra and purpose in the error.

    Raises
    ------
    MissingExtra
        If OpenCV is not installed.
    """
    try:
        import cv2  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as e:
        raise MissingExtra("opencv-python-headless", extra, what) from e
    return cv2


def demosaic(raw: Grey, pattern: str = "RGGB") -> Rgb:
    """Convert a raw Bayer image to RGB, bilinearly, as OpenCV does.

    The AI-deck's sensor is RGGB: red at the first pixel, blue one down and one to the right. The
    firmware's own conversion of published frames is identical to within 1 of 255.

    Parameters
    ----------
    raw
        (H, W), uint8, at least 2 x 2.
    pattern
        Colours of the first two pixels of the first two rows: RGGB, BGGR, GBRG or GRBG.

    Returns
    -------
    Rgb
        (H, W, 3), uint8.

    Raises
    ------
    MissingExtra
        If OpenCV is not installed.
    """
    cv2 = load_opencv()
    return np.asarray(cv2.cvtColor(raw, getattr(cv2, f"COLOR_Bayer{pattern}2RGB")), np.uint8)


def demosaic_decoded(rgb: Rgb, kind: str) -> Rgb | None:
    """Return the colours of a decoded ROS image whose format says that its pixels are raw.

    ROS's image_transport compresses the pixels of a colour sensor as one grey picture.

    Parameters
    ----------
    rgb
        (H, W, 3), uint8.
    kind
        Format of the compressed image, such as ``bayer_rggb8; png compressed``.

    Returns
    -------
    Rgb | None
        None: the pixels are not raw.
    """
    if (found := RAW_FORMAT.match(kind)) is None or min(rgb.shape[:2]) < BAYER_MIN_PX:
        return None
    return demosaic(np.ascontiguousarray(rgb[..., 0]), found[1].upper())


def to_bayer(rgb: NDArray[Value]) -> NDArray[Value]:
    """Convert (H, W, 3) RGB to a raw (H, W) RGGB image with one colour per pixel."""
    raw = rgb[..., 1].copy()
    raw[::2, ::2] = rgb[::2, ::2, 0]
    raw[1::2, 1::2] = rgb[1::2, 1::2, 2]
    return raw
