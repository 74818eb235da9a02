"""Folders of the nanocockpit client become images and states with unwrapped times."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import SourceError
from dmrl.formats.aideck import nanocockpit
from dmrl.formats.base import Options
from dmrl.formats.registry import find_format
from dmrl.geometry.frames import AIDECK
from dmrl.images.bayer import demosaic
from dmrl.images.codec import decode, encode_jpeg, encode_png
from dmrl.samples.sample import Sample
from dmrl.terminal.left_out import count_left_out

from .. import foreign
from ..reading import group_by_topic


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder of six images; time and number wrap between the third and the fourth."""
    return foreign.write_nanocockpit(tmp_path / "cockpit")


def read_samples(folder: Path) -> dict[str, list[Sample]]:
    """Return the samples of a folder by topic."""
    return group_by_topic(nanocockpit.load_content(folder, Options()).samples)


def test_pictures_have_the_camera_s_time_unwrapped(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = read_samples(folder)["/cf1/camera/image"]
    assert np.diff([s.time_ns for s in found]).tolist() == [50_000_000] * 5
    for sample, raw in zip(found, foreign.make_raw_images(6), strict=True):
        np.testing.assert_array_equal(decode(sample.fields["data"]), demosaic(raw))
    assert capsys.readouterr().err == ""


def test_the_state_has_the_units_of_dmrl(folder: Path) -> None:
    found = read_samples(folder)
    attitude, velocity = found["/cf1/attitude"], found["/cf1/velocity"]
    assert attitude[0].fields == pytest.approx(
        {"roll_rad": 0, "pitch_rad": 0, "yaw_rad": 0, "yaw_rate_radps": 0.25}, abs=2e-3
    )
    assert velocity[0].fields == pytest.approx({"vx_mps": 0.5, "vy_mps": 0, "vz_mps": 0}, abs=1e-9)
    assert [s.fields["height_m"] for s in found["/cf1/height"]] == pytest.approx([0.9] * 6)
    assert found["/cf1/pose"][5].fields["pose"]["position"]["x"] == pytest.approx(0.5)
    # The state was received 5 ms before the image was taken.
    assert found["/cf1/camera/image"][0].time_ns - attitude[0].time_ns == 5_000_000


def test_lost_pictures_are_counted_by_their_numbers(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = (folder / "metadata.csv").read_text().splitlines()
    del lines[3:5]
    (folder / "metadata.csv").write_text("\n".join(lines) + "\n")
    assert len(read_samples(folder)["/cf1/camera/image"]) == 4
    assert "2 images were lost in transmission" in capsys.readouterr().err


def test_table_that_does_not_fit_gives_one_line_error(folder: Path) -> None:
    path = folder / "metadata.csv"
    path.write_text(path.read_text().replace("frame_id", "frame"))
    with pytest.raises(SourceError, match=r"metadata\.csv:1: no column frame_id"):
        read_samples(folder)


def test_row_with_an_invalid_number_is_left_out_with_its_line(folder: Path) -> None:
    path = folder / "metadata.csv"
    assert ",10,255," in path.read_text()
    path.write_text(path.read_text().replace(",10,255,", ",10,x,"))
    with count_left_out() as counted:
        assert len(read_samples(folder)["/cf1/camera/image"]) == 5
    assert counted.first == {"lines with numbers that are not whole": f"{path}:4"}


def test_a_row_without_its_picture_is_left_out(folder: Path) -> None:
    path = folder / "metadata.csv"
    path.write_text(path.read_text().replace("00003.jpg", "00009.jpg"))
    with count_left_out() as counted:
        assert len(read_samples(folder)["/cf1/camera/image"]) == 5
    assert counted.counts == {"rows without their picture": 1}


def test_nanocockpit_folder_is_recognized_by_its_table(folder: Path) -> None:
    assert find_format(folder).name == "nanocockpit"


def test_counter_differences_wrap_to_signed_32_bits() -> None:
    ticks = np.array([5, -5, 2**31 - 1, 2**31, -(2**31), 2**32 - 3, 3 - 2**32])
    short = [5, -5, 2**31 - 1, -(2**31), -(2**31), -3, 3]
    assert nanocockpit._wrap_to_int32(ticks).tolist() == short


def test_a_state_from_before_the_wrap_has_a_time_before_the_first_picture(folder: Path) -> None:
    path = folder / "metadata.csv"
    head, *rows = path.read_text().splitlines()
    cells = [row.split(",") for row in rows]
    for number in (3, 4):  # columns of the times of image and state
        for k, row in enumerate(cells):
            row[number] = str((2_000 + 50_000 * k - (number == 4) * 5_000) % 2**32)
    path.write_text("\n".join([head, *map(",".join, cells)]) + "\n")
    found = read_samples(folder)
    images, states = found["/cf1/camera/image"], found["/cf1/attitude"]
    assert min(sample.time_ns for sample in states) >= 0
    assert {i.time_ns - s.time_ns for i, s in zip(images, states, strict=True)} == {5_000_000}


def test_repeated_state_is_written_once(folder: Path) -> None:
    path = folder / "metadata.csv"
    head, *lines = path.read_text().splitlines()
    at = head.split(",").index("state_gap8_timestamp")
    rows = [line.split(",") for line in lines]
    for row, stamp in zip(rows, ("0", "0", rows[2][at], rows[2][at], *"xx"), strict=True):
        row[at] = row[at] if stamp == "x" else stamp
    path.write_text("\n".join([head, *(",".join(row) for row in rows)]) + "\n")
    found = read_samples(folder)
    images = [s.time_ns for s in found["/cf1/camera/image"]]
    assert [s.time_ns for s in found["/cf1/attitude"]] == [images[k] - 5_000_000 for k in (2, 4, 5)]
    for row in rows:
        row[at] = "0"
    path.write_text("\n".join([head, *(",".join(row) for row in rows)]) + "\n")
    assert read_samples(folder).keys() == {"/cf1/camera/image"}


def test_given_calibration_is_written_before_the_images(folder: Path) -> None:
    camera = replace(AIDECK, width_px=32, height_px=24)
    first, *rest = nanocockpit.load_content(folder, Options(robot="me", camera=camera)).samples
    while first.topic != "/me/camera/calibration":  # states may precede the calibration
        first, *rest = rest
    images = [s.time_ns for s in rest if s.topic == "/me/camera/image"]
    assert first.time_ns == images[0] == (2**32 - 120_000) * 1000
    assert len(images) == 6


def test_colour_images_are_used_if_raw_ones_are_missing(folder: Path) -> None:
    (folder / "camera_raw").rename(folder / "camera_rgb")
    jpegs = []
    for k, path in enumerate(sorted((folder / "camera_rgb").iterdir())):
        path.unlink()
        jpegs.append(encode_jpeg(np.full((24, 32, 3), 20 * k, np.uint8)))
        path.with_suffix(".jpg").write_bytes(jpegs[-1])
    found = read_samples(folder)["/cf1/camera/image"]
    assert [s.fields["data"] for s in found] == jpegs
    assert {s.fields["format"] for s in found} == {"jpeg"}
    assert nanocockpit.can_read(folder)


@pytest.mark.parametrize(("size", "fits"), [((4, 4), True), ((3, 8), False), ((8, 3), False)])
def test_raw_pictures_are_of_four_by_four_pixels_at_least(
    size: tuple[int, int], fits: bool, folder: Path
) -> None:
    for path in (folder / "camera_raw").iterdir():
        path.write_bytes(encode_png(np.zeros(size, np.uint8)))
    if fits:
        assert len(read_samples(folder)["/cf1/camera/image"]) == 6
    else:
        with count_left_out() as counted:
            assert "/cf1/camera/image" not in read_samples(folder)
        assert counted.counts == {"images that cannot be decoded": 6}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "metadata.csv has no line of names"),
        ("a,b\n1,2\n", "metadata.csv:1: no column filename"),
        ("{head}\n", "has no rows"),
        ("{head}\n{row}\n{row}", ""),
        ("{head}\n{row}\na,1", ""),
        ("{head}\na,1", "has no rows"),
        ("{head}\na,1\n{row}\n{row}\n", ""),
        ("{head}\n{large}\n", "has no row of whole numbers"),
    ],
)
def test_a_table_s_last_line_may_be_cut(
    text: str, said: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / "metadata.csv"
    head, row, *_ = path.read_text().splitlines()
    large = row.replace(row.split(",")[3], str(2**64))
    path.write_text(text.format(head=head, row=row, large=large))
    if said:
        with pytest.raises(SourceError, match=said.replace(".", r"\.")):
            read_samples(folder)
        return
    cut = "a,1" in text
    assert len(read_samples(folder)["/cf1/camera/image"]) == text.count("{row}")
    assert (
        "left out: lines with fewer or more cells than the header: 1" in capsys.readouterr().err
    ) == cut


def test_every_number_of_a_state_is_in_its_place(folder: Path) -> None:
    path = folder / "metadata.csv"
    head, row, *_ = path.read_text().splitlines()
    names, cells = head.split(","), row.split(",")
    values = {"x": 1000, "y": -2000, "z": 3000, "vx": 400, "vy": -500, "vz": 600}
    for name, value in values.items():
        cells[names.index(f"state_{name}")] = str(value)
    path.write_text(f"{head}\n{','.join(cells)}\n")
    found = read_samples(folder)
    velocity = found["/cf1/velocity"][0].fields  # the robot faces along x
    assert velocity == pytest.approx({"vx_mps": 0.4, "vy_mps": -0.5, "vz_mps": 0.6})
    place = found["/cf1/pose"][0].fields["pose"]["position"]
    assert place == pytest.approx({"x": 1, "y": -2, "z": 3})
    logged = found["/cf1/log/stateEstimateZ"][0].fields
    assert logged["stateEstimateZ_x"] == 1000 and logged["stateEstimateZ_rateYaw"] == 250
