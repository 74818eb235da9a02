"""Image codec: encoded bytes to arrays and back. The only user of Pillow's decoders.

Arrays are (height, width, 3), uint8, RGB. EXIF orientation is not applied unless asked for: the
calibration of a recorded camera refers to the pixels as stored.
"""

import re
import struct
import warnings
from dataclasses import dataclass
from io import BytesIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from dmrl.errors import SourceError
from dmrl.guards import limits

Rgb = NDArray[np.uint8]
Grey = NDArray[np.uint8]

FORMATS = ("PNG", "JPEG", "PPM", "BMP", "TIFF", "WEBP", "GIF")
# Exceptions that Pillow's decoders raise on broken images.
DECODE_ERRORS = (
    *(OSError, SyntaxError, ValueError, LookupError, TypeError, AttributeError, EOFError),
    *(RuntimeError, ArithmeticError, struct.error, Image.DecompressionBombError),
)
UNDECODABLE = "images that cannot be decoded"
"""Reason of `dmrl.terminal.left_out`."""
BITS = 16
"""Significant bits of a 16-bit channel, unless a source states fewer."""
ORIENTATION_TAG = 0x0112
"""EXIF tag of the orientation; 1 is upright."""


def scale_to_8_bits(values: NDArray[np.uint16], bits: int = BITS) -> NDArray[np.uint8]:
    """Scale [0, 2^bits - 1] to [0, 255], the same for every image; larger values become 255."""
    most = (1 << bits) - 1
    scaled = np.minimum(values, most).astype(np.uint32) * 255
    return ((scaled + most // 2) // most).astype(np.uint8)


_spent = 0
"""Pixels of large images that this process decoded, in excess of their compressed size."""


def _open_image(data: bytes, what: object) -> Image.Image:
    try:
        if data[:1] == b"P" and not _has_header(data):
            raise ValueError("a header without end")
        with warnings.catch_warnings():
            # Warnings about many pixels: our limit is stricter. About metadata: it is not used.
            warnings.simplefilter("ignore")
            return Image.open(BytesIO(data), formats=FORMATS)
    except Image.DecompressionBombError:
        raise _too_many_pixels(what, limits.PIXELS) from None
    except DECODE_ERRORS:
        names = ", ".join(FORMATS)
        raise SourceError(f"{what} is not an image ({names}). Remove it or save it again") from None


def _has_header(data: bytes) -> bool:
    """Return whether a PPM's sizes are near its start: Pillow reads comments byte by byte."""
    words = re.sub(rb"#[^\r\n]*[\r\n]", b" ", data[: limits.HEADER_BYTES]).split(None, 4)
    return len(words) >= (3 if data[:2] in (b"P1", b"P4") else 4)


def _too_many_pixels(what: object, most: int) -> SourceError:
    words = f"{most / 1e6:.0f} million pixels"
    return SourceError(f"{what} has more than {words}, or too many scans. Scale it down")


def _check_decodable(image: Image.Image, data: bytes, what: object, most: int) -> None:
    """Raise SourceError if decoding exceeds the limits on time and memory."""
    pixels = image.width * image.height
    # Every scan of a progressive JPEG visits all pixels. FF DA starts a scan.
    scans = data.count(b"\xff\xda") if image.format == "JPEG" else 1
    if pixels > most or pixels * scans > limits.DECODED_PIXELS:
        raise _too_many_pixels(what, most)
    if max(image.size) > limits.SIDE_PX:
        raise SourceError(f"{what} is {max(image.size)} px long. Cut it into pieces")
    global _spent
    excess = max(0, pixels - limits.UNPACKED_TIMES * len(data))
    if pixels > limits.LARGE_PIXELS and excess:
        _spent += excess
        if _spent > limits.DECODED_PIXELS:
            raise SourceError(
                f"{what} and those before it are blank and very large. Scale them down"
            )


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """An image whose header was read, but no pixel.

    Parameters
    ----------
    width_px, height_px
        Size of the image as stored.
    kind
        Its format in lower case: one of ``FORMATS``.
    """

    width_px: int
    height_px: int
    kind: str
    _image: Image.Image
    _data: bytes
    _what: object
    _has_deep_colours: bool

    @property
    def has_16_bits(self) -> bool:
        """Whether its values have more than 8 bits."""
        return self._image.mode.startswith("I") or self._has_deep_colours

    @property
    def is_turned(self) -> bool:
        """Whether EXIF states another orientation than upright."""
        if self.kind == "png" and b"eXIf" not in self._data:
            return False
        try:
            # Pillow decodes a PNG to find it.
            _check_decodable(self._image, self._data, self._what, limits.PIXELS)
            return self._image.getexif().get(ORIENTATION_TAG, 1) in range(2, 9)
        except DECODE_ERRORS:
            return False

    @property
    def is_animated(self) -> bool:
        """Whether the file holds further images, which are never decoded."""
        try:
            return bool(getattr(self._image, "is_animated", False))
        except DECODE_ERRORS:
            return False

    def decode(self, most: int, *, bits: int = BITS, upright: bool = False) -> Rgb:
        """Decode the pixels of the first image, once: see `decode`."""
        with self._image as image:
            _check_decodable(image, self._data, self._what, most)
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    if image.mode == "P" and image.palette is None:  # Pillow only asserts it
                        raise ValueError("its palette is missing")
                    if self._has_deep_colours and bits < BITS:
                        return _decode_deep_colours(self._data, bits)
                    return _to_rgb(image, bits, upright=upright)
            except DECODE_ERRORS as e:
                why = " ".join(str(e).split())
                raise SourceError(
                    f"{self._what} cannot be decoded: {why}. Remove it or save it again"
                ) from None


def _decode_deep_colours(data: bytes, bits: int) -> Rgb:
    """Decode colours of 16 bits with fewer significant ones, which Pillow would drop."""
    from dmrl.images.bayer import load_opencv  # noqa: PLC0415 - it imports this module

    cv2 = load_opencv(what="colours of 16 bits with --bits")
    bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if bgr is None or bgr.ndim < 3:
        raise ValueError("OpenCV cannot decode it")
    return scale_to_8_bits(np.ascontiguousarray(bgr[..., 2::-1]), bits)


def _to_rgb(image: Image.Image, bits: int, *, upright: bool) -> Rgb:
    image.seek(0)
    if image.mode == "F" or (image.mode == "I" and image.format != "PPM"):
        raise ValueError("pixels of 32 bits have no stated range")
    if upright:
        image = ImageOps.exif_transpose(image)
    if image.mode.startswith("I"):
        # Pillow scales the grey values of a PPM to 16 bits already.
        values = np.asarray(image).clip(0, 65535).astype(np.uint16)
        grey = scale_to_8_bits(values, BITS if image.format == "PPM" else bits)
        return np.ascontiguousarray(np.broadcast_to(grey[..., None], (*grey.shape, 3)))
    # Converting an RGB image would copy it.
    return np.asarray(image if image.mode == "RGB" else image.convert("RGB"))


def read_header(data: bytes, what: object = "the image") -> ImageHeader:
    """Read an image's header, with its size.

    Parameters
    ----------
    data
        The encoded image.
    what
        Name of the image in errors.

    Raises
    ------
    SourceError
        If the bytes do not start like such an image.
    """
    image = _open_image(data, what)
    # Pillow keeps the upper 8 bits of colours of 16.
    deep = image.mode.startswith("RGB") and ";16" in str(getattr(image, "tile", ""))
    kind = str(image.format).lower()
    return ImageHeader(image.width, image.height, kind, image, data, what, deep)


def decode(data: bytes, what: object = "the image", most: int = limits.FRAME_PIXELS) -> Rgb:
    """Decode the first image of a file of one of ``FORMATS``.

    Parameters
    ----------
    data
        The encoded image. Bytes after its end are ignored.
    what
        Name of the image in the error.
    most
        Maximum number of pixels.

    Returns
    -------
    Rgb
        (H, W, 3), uint8, RGB. Grey becomes RGB, transparency is dropped, 16 bits become 8: see
        `scale_to_8_bits`.

    Raises
    ------
    SourceError
        If the bytes are not such an image, are truncated, or exceed the limits.
    """
    return read_header(data, what).decode(most)


def read_size(data: bytes, what: object = "the image") -> tuple[int, int, str]:
    """Return width and height in pixels and format, one of ``FORMATS``, without decoding.

    Raises
    ------
    SourceError
        If the bytes do not start like such an image.
    """
    picture = read_header(data, what)
    return picture.width_px, picture.height_px, picture.kind


def is_decodable(data: bytes) -> bool:
    """Return whether an image can be decoded. One that begins and ends as a whole one is not."""
    ends = {b"\xff\xd8": b"\xff\xd9", b"\x89P": b"IEND\xaeB`\x82"}
    try:
        header = read_header(data)
        if not data.endswith(ends.get(data[:2], b"no end")):
            header.decode(limits.FRAME_PIXELS)
    except SourceError:
        return False
    return True


def encode_png(rgb: Rgb | NDArray[np.uint16]) -> bytes:
    """Encode (H, W, 3) uint8 RGB, or grey (H, W), as PNG. The same pixels give the same bytes."""
    buffer = BytesIO()
    # Level 1 takes half the time of the default 6; camera images become a tenth larger.
    Image.fromarray(rgb).save(buffer, "PNG", compress_level=1)
    return buffer.getvalue()


def encode_jpeg(rgb: Rgb, quality: int = 95, *, subsampled: bool = False) -> bytes:
    """Encode an (H, W, 3) uint8 RGB array as JPEG.

    Parameters
    ----------
    rgb
        The image.
    quality
        1 to 100.
    subsampled
        Whether four pixels share their chroma (4:2:0), as in most JPEGs.
    """
    buffer = BytesIO()
    Image.fromarray(rgb).save(buffer, "JPEG", quality=quality, subsampling=2 if subsampled else 0)
    return buffer.getvalue()


def crop_and_scale(
    rgb: Rgb,
    box_px: tuple[float, float, float, float],
    width_px: int,
    height_px: int,
    *,
    sharp: bool = True,
) -> Rgb:
    """Crop an image to ``box_px`` and scale it to (height_px, width_px, 3).

    Parameters
    ----------
    rgb
        (H, W, 3), uint8.
    box_px
        Left, top, right, bottom, pixel-edge coordinates; fractions allowed.
    width_px, height_px
        Size of the result.
    sharp
        False takes half the time and is slightly softer.
    """
    image = Image.fromarray(rgb)
    # Both filters average when they shrink, so there is no aliasing: Pillow scales their support.
    how = Image.Resampling.BICUBIC if sharp else Image.Resampling.HAMMING
    return np.asarray(image.resize((width_px, height_px), how, box=box_px))
