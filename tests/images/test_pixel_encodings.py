"""Every pixel encoding of ROS's image_encodings.hpp, compared with OpenCV or its definition."""

import re

import cv2
import numpy as np
import pytest

from dmrl.errors import SourceError
from dmrl.images.pixel_encodings import LAYOUTS, convert_to_rgb

HEIGHT, WIDTH = 6, 8
ROS = [
    *(["rgb8", "rgba8", "rgb16", "rgba16", "bgr8", "bgra8", "bgr16", "bgra16", "mono8", "mono16"]),
    *(f"{n}{kind}C{count}" for n in (8, 16) for kind in "US" for count in (1, 2, 3, 4)),
    *(f"bayer_{p}{n}" for p in ("rggb", "bggr", "gbrg", "grbg") for n in (8, 16)),
    *(["yuv422", "yuv422_yuy2", "uyvy", "yuyv", "nv21", "nv24"]),
]
"""All names of the header with channels of 8 or 16 bits."""


def draw_raw(rows: int, values: int, size: int, spare: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Draw random values (rows, values); return them and their bytes, with spare ones per row."""
    rng = np.random.default_rng(values)
    found = rng.integers(0, 256**size, (rows, values)).astype(f"<u{size}")
    lines = np.concatenate([found.view(np.uint8), np.full((rows, spare), 9, np.uint8)], axis=1)
    return found, lines.ravel()


def test_encoding_table_equals_ros() -> None:
    assert set(LAYOUTS) == {*ROS, "nv12"}


@pytest.mark.parametrize("spare", [0, 3])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("encoding", [e for e in ROS if re.search(r"^(rgb|bgr|mono)|C\d", e)])
def test_channel_order_follows_the_encoding_name(encoding: str, big: bool, spare: int) -> None:
    found = re.fullmatch(r"(\D+)(8|16)|(8|16)([US])C(\d)", encoding)
    assert found is not None
    name, size = found[1], int(found[2] or found[3]) // 8
    count = int(found[5] or {"mono": 1}.get(name, len(name)))
    values, data = draw_raw(HEIGHT, WIDTH * count, size, spare)
    if big and size == 2:
        data = values.byteswap().view(np.uint8)
        data = np.pad(data, ((0, 0), (0, spare))).ravel()
    rgb = convert_to_rgb(
        data, encoding, (HEIGHT, WIDTH), WIDTH * count * size + spare, big_endian=big
    )
    pixels = values.reshape(HEIGHT, WIDTH, count).astype(np.float64)
    if found[4] == "S":
        pixels = (pixels + 256**size / 2) % 256**size
    letters = name if name in ("rgb", "bgr", "rgba", "bgra") else "bgra"  # the order of OpenCV
    places = [letters.index(c) if count > 2 else 0 for c in "rgb"]
    want = pixels[..., places] * 255 / (256**size - 1)
    assert np.abs(rgb - want).max() <= 0.5 + 1e-9


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
def test_bayer_pattern_of_one_colour_gives_that_colour(pattern: str, bits: int) -> None:
    # In a scene of one colour, each pixel of the mosaic has the value of its colour filter.
    colour = dict(zip("rgb", (200, 90, 30), strict=True))
    mosaic = np.array([[colour[pattern[2 * (v % 2) + u % 2]] for u in range(8)] for v in range(6)])
    kind = np.uint8 if bits == 8 else np.dtype("<u2")
    values = (mosaic * (1 if bits == 8 else 257)).astype(kind)
    data = np.ascontiguousarray(values).view(np.uint8).ravel()
    rgb = convert_to_rgb(data, f"bayer_{pattern}{bits}", (6, 8), 8 * bits // 8)
    assert (rgb[1:-1, 1:-1] == (200, 90, 30)).all()


@pytest.mark.parametrize(
    ("encoding", "rows", "code"),
    [
        ("yuv422", HEIGHT, cv2.COLOR_YUV2RGB_UYVY),
        ("uyvy", HEIGHT, cv2.COLOR_YUV2RGB_UYVY),
        ("yuv422_yuy2", HEIGHT, cv2.COLOR_YUV2RGB_YUY2),
        ("yuyv", HEIGHT, cv2.COLOR_YUV2RGB_YUY2),
        ("nv12", HEIGHT * 3 // 2, cv2.COLOR_YUV2RGB_NV12),
        ("nv21", HEIGHT * 3 // 2, cv2.COLOR_YUV2RGB_NV21),
    ],
)
def test_luma_and_chroma_conversion_equals_opencv(encoding: str, rows: int, code: int) -> None:
    count = 1 if encoding.startswith("nv") else 2
    values, data = draw_raw(rows, WIDTH * count, 1)
    values = values.clip(16, 235)
    want = cv2.cvtColor(values if count == 1 else values.reshape(rows, WIDTH, 2), code)
    rgb = convert_to_rgb(values.ravel(), encoding, (HEIGHT, WIDTH), WIDTH * count)
    assert np.abs(rgb.astype(int) - want).max() <= 2
    assert len(data) == values.size


def test_nv24_has_a_chroma_sample_for_each_pixel() -> None:
    y = np.full((HEIGHT, WIDTH), 81, np.uint8)
    chroma = np.tile(np.array([90, 240], np.uint8), HEIGHT * WIDTH)  # U and V of red
    data = np.concatenate([y.ravel(), chroma])
    rgb = convert_to_rgb(data, "nv24", (HEIGHT, WIDTH), WIDTH)
    assert np.abs(rgb.astype(int) - (254, 0, 0)).max() <= 2


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_bit_depth_sets_the_white_level(bits: int) -> None:
    values = np.array([[0, (1 << bits) // 2, (1 << bits) - 1, 65535]] * 4, "<u2")
    rgb = convert_to_rgb(values.view(np.uint8).ravel(), "mono16", (4, 4), 8, bits=bits)
    assert rgb[0, :, 0].tolist() == [0, 128, 255, 255]


@pytest.mark.parametrize(
    ("encoding", "shape", "step", "size"),
    [
        ("rgb8", (4, 4), 12, 47),
        ("rgb8", (4, 4), 11, 100),
        ("rgb8", (0, 4), 12, 100),
        ("rgb8", (4, 0), 12, 100),
        ("bayer_rggb8", (3, 8), 8, 24),
        ("yuyv", (4, 5), 10, 40),
        ("nv21", (5, 4), 4, 40),
        ("nv21", (4, 4), 4, 23),
        ("nv24", (4, 4), 4, 47),
        ("32FC1", (4, 4), 16, 64),
        ("", (4, 4), 16, 64),
    ],
)
def test_invalid_image_data_is_refused(
    encoding: str, shape: tuple[int, int], step: int, size: int
) -> None:
    with pytest.raises(SourceError, match=r"^images (of|with)"):
        convert_to_rgb(np.zeros(size, np.uint8), encoding, shape, step)
