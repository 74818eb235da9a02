"""What a camera sent, as a picture that can be stored."""

from typing import Literal

import numpy as np

from dmrl.errors import SourceError
from dmrl.formats.aideck.cpx import Image
from dmrl.geometry.frames import AIDECK, AIDECK_CORNER_PX, AIDECK_SENSOR_PX
from dmrl.images import bayer, codec

Colours = Literal["colour", "grey"]
Stored = Literal["png", "jpeg"]
JPEG_QUALITY = 95


def encoded(image: Image, colours: Colours, stored: Stored = "png") -> tuple[bytes, str]:
    """The picture, and "png" or "jpeg".

    Images of the whole sensor are cut to the 320 x 224 px that the calibration is of. A JPEG
    that need not be cut keeps its bytes.

    Parameters
    ----------
    image
        As it came.
    colours
        Whether there are colour filters before the pixels of a raw image.
    stored
        What becomes of the rest: PNG, so that nothing is lost, or JPEG, a fifth of that.

    Raises
    ------
    SourceError
        If a JPEG cannot be decoded, or has another size than the camera said.
    """
    whole = (image.width_px, image.height_px) == AIDECK_SENSOR_PX
    if image.encoding == "jpeg":
        width_px, height_px, kind = codec.size(image.data, "the camera's JPEG")
        if (width_px, height_px) != (image.width_px, image.height_px) or kind != "jpeg":
            raise SourceError(
                f"the camera's {kind} is {width_px} x {height_px} px, not "
                f"{image.width_px} x {image.height_px} px as it said. Start the deck anew"
            )
        if not whole:
            return image.data, "jpeg"
        return _stored(_cut(codec.decode(image.data, "the camera's JPEG")), stored), stored
    pixels = np.frombuffer(image.data, np.uint8).reshape(image.height_px, image.width_px)
    if whole:
        pixels = _cut(pixels)
    return _stored(bayer.rgb_of(pixels) if colours == "colour" else pixels, stored), stored


def _stored(pixels: codec.Rgb, stored: Stored) -> bytes:
    if stored == "png":
        return codec.encode_png(pixels)
    return codec.encode_jpeg(pixels, JPEG_QUALITY)


def _cut(pixels: codec.Rgb) -> codec.Rgb:
    left, top = AIDECK_CORNER_PX
    return pixels[top : top + AIDECK.height_px, left : left + AIDECK.width_px]
