"""Convert uncompressed images in the encodings of ROS's ``image_encodings.hpp`` to RGB.

Channels have 8 or 16 bits. A single channel is grey, the first of two channels is grey, and a
fourth channel is dropped. Signed values are shifted by half of their range, so 0 becomes mid-grey.
Channels without names, as in ``8UC3``, are blue, green and red, as OpenCV has them; Foxglove's
``RawImage`` defines ``8UC3`` so, too. ``nv12`` is Foxglove's alone.
"""

import re

import numpy as np
from numpy.typing import NDArray

from dmrl.errors import SourceError
from dmrl.images.bayer import BAYER_MIN_PX, demosaic
from dmrl.images.codec import BITS, Rgb, scale_to_8_bits

CHANNELS: dict[str, tuple[int, ...]] = {
    "mono": (0, 0, 0),
    "rgb": (0, 1, 2),
    "bgr": (2, 1, 0),
    "rgba": (0, 1, 2, 3),
    "bgra": (2, 1, 0, 3),
}
"""Channel of red, green, blue and alpha, by the name of an encoding without its bits."""
UNNAMED_CHANNELS = re.compile(r"(8|16)[US]C[34]")
"""Encodings that do not name their channels."""
BAYER_PATTERNS = ("rggb", "bggr", "gbrg", "grbg")
YUV = {
    **dict.fromkeys(("yuv422", "uyvy"), (1, 0, 2)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (0, 1, 3)),
}
"""Packed 4:2:2 encodings: place of the first Y, of U and of V among 4 bytes of 2 pixels."""
PLANAR_YUV = {"nv12": 2, "nv21": 2, "nv24": 1}
"""A plane of Y, then rows of V and U in turns: pixels per chroma sample, both ways.

``nv21`` is V, U; the others are U, V.
"""
RGB_FROM_YUV = np.array([[1.164, 0.0, 1.596], [1.164, -0.392, -0.813], [1.164, 2.017, 0.0]])
"""ITU-R BT.601, video range: Y from 16 to 235, U and V from 16 to 240."""


def _build_layouts() -> dict[str, tuple[int, int, bool]]:
    """Return the number of channels, the bytes of each, and whether they are signed, by name."""
    sizes = {"8": (1, False), "16": (2, False)}
    found = {
        f"{name}{bits}": (len(order) if name != "mono" else 1, *size)
        for name, order in CHANNELS.items()
        for bits, size in sizes.items()
    }
    found |= {
        f"bayer_{p}{bits}": (1, *size) for p in BAYER_PATTERNS for bits, size in sizes.items()
    }
    for count in (1, 2, 3, 4):
        for letter, signed in (("U", False), ("S", True)):
            found |= {f"{8 * n}{letter}C{count}": (count, n, signed) for n in (1, 2)}
    return found | dict.fromkeys(YUV, (2, 1, False)) | dict.fromkeys(PLANAR_YUV, (1, 1, False))


LAYOUTS = _build_layouts()
"""Channels, bytes of a channel, and whether they are signed, of every known encoding."""


def convert_to_rgb(
    data: NDArray[np.uint8],
    encoding: str,
    shape: tuple[int, int],
    step: int,
    *,
    big_endian: bool = False,
    bits: int = BITS,
) -> Rgb:
    """Convert an uncompressed image to RGB.

    Parameters
    ----------
    data
        Its bytes.
    encoding
        Name of the encoding, a key of ``LAYOUTS``.
    shape
        Height and width, pixels.
    step
        Bytes from row to row.
    big_endian
        Byte order of 16-bit channels.
    bits
        Significant bits of 16-bit channels.

    Returns
    -------
    Rgb
        (H, W, 3), uint8.

    Raises
    ------
    SourceError
        If the encoding is unknown, or the bytes are too few for the shape. Its text is a reason of
        `dmrl.terminal.left_out`.
    MissingExtra
        If it is a Bayer image and OpenCV is not installed.
    """
    if encoding not in LAYOUTS:
        raise SourceError(f"images of encoding {encoding[:40]!r}, which is not supported")
    (height, width), (channels, size, signed) = shape, LAYOUTS[encoding]
    rows = height + {2: height // 2, 1: 2 * height}.get(PLANAR_YUV.get(encoding, 0), 0)
    halved = PLANAR_YUV.get(encoding) == 2
    odd = ((encoding in YUV or halved) and width % 2) or (halved and height % 2)
    whole = height > 0 and 0 < width * channels * size <= step and rows * step <= len(data)
    small = encoding.startswith("bayer_") and min(shape) < BAYER_MIN_PX
    if odd or small or not whole:
        raise SourceError("images with another number of bytes than their size states")
    lines = np.ascontiguousarray(data[: rows * step].reshape(rows, step))
    if encoding in PLANAR_YUV:
        return _convert_planar_yuv(lines, encoding, shape)
    lines = np.ascontiguousarray(lines[:, : width * channels * size])
    if encoding in YUV:
        return _convert_packed_yuv(lines, YUV[encoding])
    values = lines.view(f"{'>' if big_endian else '<'}u{size}").reshape(height, width, channels)
    if signed:
        values = values ^ (1 << (8 * size - 1))
    pixels = values.astype(np.uint8) if size == 1 else scale_to_8_bits(values, bits)
    if encoding.startswith("bayer_"):
        return demosaic(np.ascontiguousarray(pixels[..., 0]), encoding[6:10].upper())
    order = CHANNELS.get(encoding.rstrip("0123456789"), (2, 1, 0) if channels > 2 else (0, 0, 0))
    return np.ascontiguousarray(pixels[..., order[:3]])


def _convert_packed_yuv(lines: NDArray[np.uint8], places: tuple[int, int, int]) -> Rgb:
    luma, *chroma = places
    pairs = lines[:, : lines.shape[1] // 4 * 4].reshape(len(lines), -1, 4)
    y = pairs[..., [luma, luma + 2]].reshape(len(lines), -1)
    u, v = (np.repeat(pairs[..., place], 2, axis=1) for place in chroma)
    return _yuv_to_rgb(y, u, v)


def _convert_planar_yuv(lines: NDArray[np.uint8], encoding: str, shape: tuple[int, int]) -> Rgb:
    (height, width), scale = shape, PLANAR_YUV[encoding]
    plane = lines[height:].reshape(-1)
    pairs = plane.reshape(-1, lines.shape[1] * 2 // scale)[:, : 2 * width // scale]
    both = pairs.reshape(len(pairs), -1, 2).repeat(scale, 0).repeat(scale, 1)
    first, second = both[:height, :width, 0], both[:height, :width, 1]
    u, v = (second, first) if encoding == "nv21" else (first, second)
    return _yuv_to_rgb(lines[:height, :width], u, v)


def _yuv_to_rgb(y: NDArray[np.uint8], u: NDArray[np.uint8], v: NDArray[np.uint8]) -> Rgb:
    yuv = np.stack([y, u, v], axis=-1) - np.array([16.0, 128.0, 128.0])
    return np.asarray(np.rint(yuv @ RGB_FROM_YUV.T).clip(0, 255), np.uint8)
