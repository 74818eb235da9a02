"""Encoding and decoding of images: damaged, oversized and unusual files."""

import struct
import zlib
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dmrl.errors import SourceError
from dmrl.guards import limits
from dmrl.images import codec


@pytest.fixture
def rgb() -> codec.Rgb:
    return np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8)


def test_png_keeps_every_pixel(rgb: codec.Rgb) -> None:
    png = codec.encode_png(rgb)
    assert codec.read_size(png) == (32, 24, "png")
    np.testing.assert_array_equal(codec.decode(png), rgb)
    assert codec.encode_png(rgb) == png


def test_jpeg_is_close_to_the_original(rgb: codec.Rgb) -> None:
    smooth = np.broadcast_to(np.arange(24, dtype=np.uint8)[:, None, None] * 8, (24, 32, 3)).copy()
    jpeg = codec.encode_jpeg(smooth)
    assert codec.read_size(jpeg) == (32, 24, "jpeg")
    assert np.abs(codec.decode(jpeg).astype(int) - smooth).max() < 6


def test_ppm_may_hold_comments_and_junk() -> None:
    ppm = b"P6\n# a camera\n2 1\n# its name\n255\n" + bytes([1, 2, 3, 4, 5, 6]) + b"junk"
    np.testing.assert_array_equal(codec.decode(ppm), [[[1, 2, 3], [4, 5, 6]]])
    assert codec.read_size(ppm) == (2, 1, "ppm")


def test_frames_with_trailing_bytes_are_decoded(data: Path) -> None:
    if not (frames := sorted((data / "aideck-frames").glob("*.ppm"))):
        pytest.skip("the frames of the AI-deck are not there")
    for path in frames:
        bytes_ = path.read_bytes()
        pixels = np.frombuffer(bytes_[15 : 15 + 320 * 224 * 3], np.uint8)
        np.testing.assert_array_equal(codec.decode(bytes_).ravel(), pixels)


@pytest.mark.parametrize("share", [0.9, 0.5, 0.1])
def test_error_of_a_truncated_image_names_it(rgb: codec.Rgb, share: float) -> None:
    png = codec.encode_png(rgb)
    with pytest.raises(SourceError, match=r"^a\.png cannot be decoded: .*Remove it") as e:
        codec.decode(png[: int(len(png) * share)], "a.png")
    assert "\n" not in str(e.value)


@pytest.mark.parametrize("bad", [b"", b"GIF89a" + b"\0" * 40, b"\x89PNG\r\n\x1a\n" + b"\0" * 40])
def test_invalid_image_is_reported_by_name(bad: bytes) -> None:
    for function in (codec.decode, codec.read_size):
        with pytest.raises(SourceError, match=r"^a\.png is not an image \(PNG, JPEG"):
            function(bad, "a.png")


def test_indexed_image_without_a_palette_is_refused(rgb: codec.Rgb) -> None:
    stream = BytesIO()
    Image.fromarray(rgb).convert("P").save(stream, "PNG")
    assert codec.decode(stream.getvalue()).shape == rgb.shape
    without = stream.getvalue().replace(b"PLTE", b"pLTE")  # an optional chunk, which is skipped
    with pytest.raises(SourceError, match=r"a\.png cannot be decoded: its palette is missing"):
        codec.decode(correct_crcs(without), "a.png")


def correct_crcs(png: bytes) -> bytes:
    """Return a PNG with the CRC of every chunk corrected."""
    out, at = png[:8], 8
    while at < len(png):
        (size,) = struct.unpack_from(">I", png, at)
        named = png[at + 4 : at + 8 + size]
        out += png[at : at + 4] + named + struct.pack(">I", zlib.crc32(named))
        at += 12 + size
    return out


def test_crop_and_scale_takes_the_given_region() -> None:
    rgb = np.zeros((40, 60, 3), np.uint8)
    rgb[10:30, 20:40] = 200
    part = codec.crop_and_scale(rgb, (20, 10, 40, 30), 10, 10)
    assert part.min() > 150  # scaling mixes the border with its neighbours
    assert np.abs(part[1:-1, 1:-1].astype(int) - 200).max() < 6
    assert codec.crop_and_scale(rgb, (0, 0, 60, 40), 30, 20).shape == (20, 30, 3)


def build_png(width_px: int, height_px: int) -> bytes:
    """Build a black grey-scale PNG without holding its pixels in memory."""
    packer = zlib.compressobj(9)
    row = bytes(1 + width_px)
    body = b"".join(packer.compress(row) for _ in range(height_px)) + packer.flush()
    parts = (
        (b"IHDR", struct.pack(">IIBBBBB", width_px, height_px, 8, 0, 0, 0, 0)),
        (b"IDAT", body),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in parts
    )


@pytest.mark.parametrize("side_px", [8_001, 13_000, 30_000])
def test_a_picture_of_too_many_pixels_is_refused_before_it_is_decoded(
    side_px: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    header = build_png(side_px, 1)
    header = header[:16] + struct.pack(">II", side_px, side_px) + header[24:]
    header = header[:29] + struct.pack(">I", zlib.crc32(header[12:29])) + header[33:]
    monkeypatch.setattr(Image.Image, "load", None)
    monkeypatch.setattr(Image.Image, "convert", None)
    for data in (
        header,
        b"P6 %d %d 255 " % (side_px, side_px),
        b"P5 %d %d 255 " % (side_px, side_px),
    ):
        with pytest.raises(SourceError, match=r"a\.png has more than 64 million pixels"):
            codec.decode(data, "a.png", limits.PIXELS)


@pytest.mark.heavy
def test_an_image_of_a_recording_is_no_larger_than_a_network_can_take() -> None:
    """Without the limit, a blank image of 190 kB would take `dmrl predict` 6.5 GB."""
    large = build_png(3840, 2352)
    with pytest.raises(SourceError, match=r"a\.png has more than 9 million pixels.* Scale it down"):
        codec.decode(large, "a.png")
    assert codec.decode(large, "a.png", limits.PIXELS).shape == (2352, 3840, 3)
    assert codec.decode(build_png(3840, 2160)).shape == (2160, 3840, 3)


@pytest.mark.heavy
def test_a_jpeg_of_endless_scans_is_refused() -> None:
    grey = Image.new("L", (4000, 4000))
    buffer = BytesIO()
    grey.save(buffer, "JPEG", progressive=True)
    data = buffer.getvalue()
    assert codec.decode(data, most=limits.PIXELS).shape == (4000, 4000, 3)
    at = data.index(b"\xff\xda")
    second = data.index(b"\xff\xda", at + 2)
    endless = data[:second] + data[at:second] * 1000 + data[second:]
    with pytest.raises(SourceError, match="too many scans"):
        codec.decode(endless, most=limits.PIXELS)


@pytest.mark.heavy
def test_a_large_photo_is_no_bomb() -> None:
    assert codec.decode(build_png(6000, 4000), most=limits.PIXELS).shape == (4000, 6000, 3)


def test_a_ppm_whose_header_does_not_end_is_refused() -> None:
    for head in (
        b"P6 #" + b"x" * 100_000 + b"\n2 2 255\n",
        b"P6 " + b"#\n" * 50_000 + b"2 2 255\n",
    ):
        with pytest.raises(SourceError, match="not an image"):
            codec.decode(head + bytes(12))


@pytest.mark.parametrize("shape", [(65_536, 1), (1, 65_536)])
def test_image_with_longer_sides_than_a_jpeg_may_have_is_refused(shape: tuple[int, int]) -> None:
    """Without the limit, a column of 60 million pixels, 61 kB, would take 1.8 GB."""
    with pytest.raises(SourceError, match=r"a\.png is 65536 px long"):
        codec.decode(codec.encode_png(np.zeros(shape, np.uint8)), "a.png")


def test_large_blank_pictures_have_a_budget_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the budget, a folder of them would take a second of CPU time per 7 kB."""
    monkeypatch.setattr(codec, "_spent", 0)
    monkeypatch.setattr(codec.limits, "DECODED_PIXELS", 4_000_000)
    blank = codec.encode_png(np.zeros((1600, 2000), np.uint8))
    for _ in range(2):
        codec.decode(blank)
    with pytest.raises(SourceError, match="blank and very large"):
        codec.decode(blank)
    small = codec.encode_png(np.zeros((224, 320), np.uint8))
    assert codec.decode(small).shape == (224, 320, 3)
