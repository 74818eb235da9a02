"""Third-party images: bit depth, order, hidden files and truncated files."""

import io
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
from cyclopts import App

import dmrl
from dmrl.cli import app
from dmrl.images.codec import decode, encode_jpeg, encode_png

Convert = Callable[..., dict[str, int]]


@pytest.fixture
def convert(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Convert:
    """Return a function that runs ``dmrl convert`` into out.mcap.

    The function returns the JSON document of the command, with standard error added.
    """

    def run(source: Path, *flags: object) -> dict[str, int]:
        command: App = app
        with pytest.raises(SystemExit) as e:
            command(
                ["convert", str(source), str(tmp_path / "out.mcap"), "--json", *map(str, flags)]
            )
        printed = capsys.readouterr()
        assert not e.value.code, printed.err
        told = json.loads(printed.out)
        told["stderr"] = printed.err
        return told

    return run


def read_images(tmp_path: Path) -> list[np.ndarray]:
    """Return the images of the recording out.mcap."""
    return list(dmrl.open(tmp_path / "out.mcap").images("cf1"))


def test_grey_of_16_bits_is_scaled(data: Path, convert: Convert, tmp_path: Path) -> None:
    told = convert(data / "strangers/picture-grey16/grey16")
    assert abs(read_images(tmp_path)[0].mean() - 127) <= 1
    assert "16 bits scaled to 8, 65535 to 255 (--bits)" in told["stderr"]


@pytest.mark.parametrize("name", ["only_mono16", "only_bayer_bggr8"])
@pytest.mark.heavy
def test_images_of_bags_have_their_colours(
    name: str, data: Path, convert: Convert, tmp_path: Path
) -> None:
    convert(data / f"strangers/ros-{name}/{name}")
    found = read_images(tmp_path)
    assert len(found) == 20
    # The ramp ends at 38300 of 65535. The mosaic has all values.
    assert found[0].max() == (149 if name == "only_mono16" else 255)


def test_hidden_files_are_no_pictures(data: Path, convert: Convert, tmp_path: Path) -> None:
    told = convert(data / "strangers/picture-hidden_mac/hidden_mac")
    assert told["left_out"] == {}
    assert len(read_images(tmp_path)) == 1


def test_names_are_in_natural_order(data: Path, convert: Convert, tmp_path: Path) -> None:
    convert(data / "strangers/labels-natural_order/natural_order")
    table = dmrl.open(tmp_path / "out.mcap")["/cf1/labels"].to_pandas()
    assert table.sort_values("log_time")["peers.u_px"].tolist() == [1, 2, 10]


def test_normalised_coordinates_are_reported(data: Path, convert: Convert) -> None:
    told = convert(data / "strangers/labels-normalised_yolo/normalised_yolo")
    assert "doubt: 3 of 3 labels have u_px and v_px in [0, 1]" in told["stderr"]


def test_a_stream_of_jpegs_gets_the_size_of_the_network(
    data: Path, convert: Convert, tmp_path: Path
) -> None:
    source = data / "strangers/cpx-jpeg/jpeg.cpx"
    convert(source, "--width-px", 320, "--height-px", 224)
    assert [image.shape for image in read_images(tmp_path)] == [(224, 320, 3)] * 6


def test_a_cut_jpeg_of_a_stream_is_left_out(data: Path, convert: Convert, tmp_path: Path) -> None:
    told = convert(data / "strangers/cpx-jpeg_half/jpeg_half.cpx")
    assert told["left_out"] == {"images that cannot be decoded": 1}
    assert len(read_images(tmp_path)) == 5


RAMP = np.tile(np.linspace(0, 1, 64), (48, 1))


def save(path: Path, picture: PIL.Image.Image, **more: object) -> None:
    """Save an image in the format of its suffix."""
    picture.save(path, **more)


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
@pytest.mark.parametrize("suffix", ["png", "tiff"])
@pytest.mark.heavy
def test_every_depth_of_grey_becomes_the_same_ramp(
    bits: int, suffix: str, convert: Convert, tmp_path: Path
) -> None:
    (tmp_path / "in").mkdir()
    values = np.rint(RAMP * (2**bits - 1)).astype(np.uint16)
    assert cv2.imwrite(str(tmp_path / f"in/a.{suffix}"), values)
    # The second image is dark. Its own maximum must not set the scale.
    assert cv2.imwrite(str(tmp_path / f"in/b.{suffix}"), values // 4)
    convert(tmp_path / "in", "--bits", bits)
    bright, dark = read_images(tmp_path)
    assert np.abs(bright[..., 0] - RAMP * 255).max() <= 0.6
    assert np.abs(dark[..., 0] - RAMP * 255 / 4).max() <= 0.8


@pytest.mark.parametrize("bits", [12, 16])
@pytest.mark.parametrize("suffix", ["png", "tiff"])
@pytest.mark.parametrize("channels", [3, 4])
def test_colours_of_every_depth_are_scaled(
    bits: int, suffix: str, channels: int, convert: Convert, tmp_path: Path
) -> None:
    (tmp_path / "in").mkdir()
    shares = np.random.default_rng(0).random((48, 64, channels))
    bgr = np.rint(shares * (2**bits - 1)).astype(np.uint16)
    assert cv2.imwrite(str(tmp_path / f"in/a.{suffix}"), bgr)
    told = convert(tmp_path / "in", "--bits", bits)
    (image,) = read_images(tmp_path)
    assert np.abs(image - shares[..., 2::-1] * 255).max() <= 1
    assert f"16 bits scaled to 8, {2**bits - 1} to 255" in told["stderr"]


COLOURS = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)


def _make_palette_image() -> PIL.Image.Image:
    """Return an image of 64 colours with a palette."""
    return PIL.Image.fromarray(COLOURS // 64 * 64).quantize(64, dither=PIL.Image.Dither.NONE)


@pytest.mark.parametrize(
    ("name", "make", "apart"),
    [
        ("a.bmp", lambda: PIL.Image.fromarray(COLOURS), 0),
        ("a.tif", lambda: PIL.Image.fromarray(COLOURS), 0),
        ("a.webp", lambda: PIL.Image.fromarray(COLOURS), 0),
        ("a.png", lambda: PIL.Image.fromarray(COLOURS).convert("RGBA"), 0),
        ("a.png", lambda: PIL.Image.fromarray(np.dstack([COLOURS, COLOURS[..., :1]])), 0),
        ("a.tif", lambda: PIL.Image.fromarray(COLOURS).convert("CMYK"), 3),
        ("a.gif", _make_palette_image, 64),
        ("a.png", _make_palette_image, 64),
    ],
)
def test_images_opened_by_pillow_become_rgb(
    name: str,
    make: Callable[[], PIL.Image.Image],
    apart: int,
    convert: Convert,
    tmp_path: Path,
) -> None:
    (tmp_path / "in").mkdir()
    save(tmp_path / "in" / name, make(), **({"lossless": True} if "webp" in name else {}))
    assert convert(tmp_path / "in")["left_out"] == {}
    (image,) = read_images(tmp_path)
    assert np.abs(image.astype(int) - COLOURS).max() <= apart


@pytest.mark.parametrize("as_stored", [False, True])
def test_exif_orientation_is_applied(as_stored: bool, convert: Convert, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    exif = PIL.Image.Exif()
    exif[0x0112] = 6  # rotate by 90 degrees clockwise
    save(tmp_path / "in/a.png", PIL.Image.fromarray(COLOURS), exif=exif)
    told = convert(tmp_path / "in", *["--as-stored"] * as_stored)
    (image,) = read_images(tmp_path)
    assert (image == (COLOURS if as_stored else np.rot90(COLOURS, -1))).all()
    assert ("turned upright by EXIF" in told["stderr"]) != as_stored


@pytest.mark.parametrize("name", ["a.gif", "a.webp", "a.tif", "a.png"])
def test_first_image_of_a_multi_image_file_is_used(
    name: str, convert: Convert, tmp_path: Path
) -> None:
    (tmp_path / "in").mkdir()
    frames = [PIL.Image.new("RGB", (64, 48), (k, k, k)) for k in (10, 200)]
    more = {"lossless": True} if "webp" in name else {}
    save(tmp_path / "in" / name, frames[0], save_all=True, append_images=frames[1:], **more)
    told = convert(tmp_path / "in")
    (image,) = read_images(tmp_path)
    assert (image == 10).all()
    assert "1 pictures: one image of several used, the first" in told["stderr"]


def _cut(data: bytes) -> bytes:
    """Return the first half of a file."""
    return data[: len(data) // 2]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("b.jpg", _cut(encode_jpeg(COLOURS))),
        ("b.png", _cut(encode_png(COLOURS))),
        ("b.png", b""),
        ("b.jpeg", b"<html>not found</html>"),
        ("b.tif", b"II*\0" + b"\xff" * 50),
        ("b.png", encode_png(COLOURS).replace(b"IDAT", b"IDAX", 1)),
    ],
)
def test_a_picture_that_is_broken_is_left_out_with_its_labels(
    name: str, content: bytes, convert: Convert, tmp_path: Path
) -> None:
    (tmp_path / "in").mkdir()
    for good in ("a.png", "c.png"):
        (tmp_path / "in" / good).write_bytes(encode_png(COLOURS))
    (tmp_path / "in" / name).write_bytes(content)
    rows = "".join(f"{n},cf2,10,12,1.5\n" for n in ("a.png", name, "c.png"))
    (tmp_path / "in/labels.csv").write_text("file,peer,u_px,v_px,depth_m\n" + rows)
    told = convert(tmp_path / "in")
    assert told["left_out"] == {"images that cannot be decoded": 1}
    assert name in told["stderr"]
    recording = dmrl.open(tmp_path / "out.mcap")
    assert recording["/cf1/labels"].to_pandas()["log_time"].astype(int).tolist() == [0, 200_000_000]
    assert len(read_images(tmp_path)) == 2


def test_floating_point_images_are_left_out(convert: Convert, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    save(tmp_path / "in/a.tif", PIL.Image.fromarray(RAMP.astype(np.float32)))
    (tmp_path / "in/b.png").write_bytes(encode_png(COLOURS))
    assert convert(tmp_path / "in")["left_out"] == {"images that cannot be decoded": 1}


def test_names_with_a_point_are_seconds(convert: Convert, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for name in ("1403636579.763555527.png", "1403636579.8135555.png"):
        (tmp_path / "in" / name).write_bytes(encode_png(COLOURS))
    convert(tmp_path / "in")
    table = dmrl.open(tmp_path / "out.mcap")["/cf1/camera/image"].to_pandas()
    assert table["log_time"].astype("int64").tolist() == [
        1403636579_763555527,
        1403636579_813555500,
    ]


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (("0.5", "0.25"), (250_000_000, 500_000_000)),
        (("1700000001", "1700000000"), (1_700_000_000_000_000_000, 1_700_000_001_000_000_000)),
        (("0.5", "a"), (0, 100_000_000)),
        (("0000000001", "0000000002"), (0, 100_000_000)),
    ],
)
def test_names_are_seconds_if_all_are(
    names: tuple[str, ...], times: tuple[int, ...], convert: Convert, tmp_path: Path
) -> None:
    (tmp_path / "in").mkdir()
    for name in names:
        (tmp_path / "in" / f"{name}.png").write_bytes(encode_png(COLOURS))
    output = convert(tmp_path / "in")["stderr"]
    table = dmrl.open(tmp_path / "out.mcap")["/cf1/camera/image"].to_pandas()
    assert tuple(table["log_time"].astype("int64")) == times
    assert ("taken for times in seconds" in output) == (times[0] != 0)


def test_implausible_depths_boxes_and_peers_are_reported(convert: Convert, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in/a.png").write_bytes(encode_png(COLOURS))
    (tmp_path / "in/labels.csv").write_text(
        "file,peer,u_px,v_px,depth_m,left_px,top_px,right_px,bottom_px\n"
        "a.png,cf2,10,12,1200,20,20,30,30\na.png,cf1,25,25,1,20,20,30,30\n"
    )
    output = convert(tmp_path / "in")["stderr"]
    assert "doubt: 1 of 2 labels have a depth over 100 m: millimetres?" in output
    assert "doubt: 1 of 2 labels have their centre outside their box" in output
    assert "doubt: 1 of 2 labels are of cf1, which carries the camera" in output


def test_recorded_16_bit_images_are_scaled() -> None:
    buffer = io.BytesIO()
    PIL.Image.fromarray(np.full((4, 4), 32768, np.uint16)).save(buffer, "PNG")
    assert (decode(buffer.getvalue()) == 128).all()
