"""Encoding of a camera's images for storage."""

from typing import Literal

import numpy as np

from dmrl.errors import SourceError
from dmrl.formats.aideck.cpx import Image
from dmrl.geometry.frames import AIDECK, AIDECK_CORNER_PX, AIDECK_SENSOR_PX
from dmrl.images import bayer, codec

ColourMode = Literal["colour", "grey"]
StoredFormat = Literal["png", "jpeg"]
JPEG_QUALITY = 95


def encode_image(
    image: Image, colours: ColourMode, stored: StoredFormat = "png"
) -> tuple[bytes, str]:
    """Return the encoded image, and "png" or "jpeg".

    Images of the whole sensor are cropped to the 320 x 224 px of the calibration. A JPEG that needs
    no crop keeps its bytes.

    Parameters
    ----------
    image
        Image as received.
    colours
        Whether a raw image comes from a sensor with colour filters.
    stored
        Format of all other images: PNG is lossless, JPEG takes a fifth of its size.

    Raises
    ------
    SourceError
        If a JPEG cannot be decoded, or its size differs from its header.
    """
    whole = (image.width_px, image.height_px) == AIDECK_SENSOR_PX
    if image.encoding == "jpeg":
        width_px, height_px, kind = codec.read_size(image.data, "the camera's JPEG")
        if (width_px, height_px) != (image.width_px, image.height_px) or kind != "jpeg":
            raise SourceError(
                f"the camera's {kind} is {width_px} x {height_px} px, not "
                f"{image.width_px} x {image.height_px} px as in its header. Restart the deck"
            )
        if not whole:
            return image.data, "jpeg"
        return _encode_pixels(
            _crop_to_calibration(codec.decode(image.data, "the camera's JPEG")), stored
        ), stored
    pixels = np.frombuffer(image.data, np.uint8).reshape(image.height_px, image.width_px)
    if whole:
        pixels = _crop_to_calibration(pixels)
    return _encode_pixels(bayer.demosaic(pixels) if colours == "colour" else pixels, stored), stored


def _encode_pixels(pixels: codec.Rgb, stored: StoredFormat) -> bytes:
    if stored == "png":
        return codec.encode_png(pixels)
    return codec.encode_jpeg(pixels, JPEG_QUALITY)


def _crop_to_calibration(pixels: codec.Rgb) -> codec.Rgb:
    left, top = AIDECK_CORNER_PX
    return pixels[top : top + AIDECK.height_px, left : left + AIDECK.width_px]
