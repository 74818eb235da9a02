from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import SourceError
from dmrl.formats import nanocockpit
from dmrl.formats.format import Options
from dmrl.formats.known import format_of
from dmrl.images.bayer import rgb_of
from dmrl.images.codec import decode
from dmrl.samples.sample import Sample

from . import foreign


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Six pictures; time and number wrap between the third and the fourth."""
    return foreign.nanocockpit(tmp_path / "cockpit")


def samples(folder: Path) -> dict[str, list[Sample]]:
    """Samples by topic."""
    found: dict[str, list[Sample]] = {}
    for sample in nanocockpit.content(folder, Options()).samples:
        found.setdefault(sample.topic, []).append(sample)
    return found


def test_pictures_have_the_camera_s_time_unwrapped(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = samples(folder)["/cf1/camera/image"]
    assert np.diff([s.time_ns for s in found]).tolist() == [50_000_000] * 5
    for sample, raw in zip(found, foreign.pictures(6), strict=True):
        np.testing.assert_array_equal(decode(sample.fields["data"]), rgb_of(raw))
    assert capsys.readouterr().err == ""


def test_the_state_has_the_units_of_dmrl(folder: Path) -> None:
    found = samples(folder)
    attitude, velocity = found["/cf1/attitude"], found["/cf1/velocity"]
    assert attitude[0].fields == pytest.approx(
        {"roll_rad": 0, "pitch_rad": 0, "yaw_rad": 0, "yaw_rate_radps": 0.25}, abs=2e-3
    )
    assert velocity[0].fields == pytest.approx({"vx_mps": 0.5, "vy_mps": 0, "vz_mps": 0}, abs=1e-9)
    assert [s.fields["height_m"] for s in found["/cf1/height"]] == pytest.approx([0.9] * 6)
    assert found["/cf1/pose"][5].fields["pose"]["position"]["x"] == pytest.approx(0.5)
    # The state came 5 ms before the picture.
    assert found["/cf1/camera/image"][0].time_ns - attitude[0].time_ns == 5_000_000


def test_lost_pictures_are_counted_by_their_numbers(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = (folder / "metadata.csv").read_text().splitlines()
    del lines[3:5]
    (folder / "metadata.csv").write_text("\n".join(lines) + "\n")
    assert len(samples(folder)["/cf1/camera/image"]) == 4
    assert "2 pictures were lost on the way" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("frame_id", "frame", r"metadata.csv:1: no column frame_id"),
        ("00003.jpg", "00009.jpg", r"no picture 00009 in .*camera_raw"),
        (",10,255,", ",10,x,", r"metadata.csv:4: not a file and whole numbers"),
    ],
)
def test_a_table_that_does_not_fit_is_one_line(folder: Path, old: str, new: str, text: str) -> None:
    path = folder / "metadata.csv"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(SourceError, match=text):
        samples(folder)


def test_it_is_known_by_its_table(folder: Path) -> None:
    assert format_of(folder).name == "nanocockpit"


def test_differences_of_counts_that_wrap_are_the_short_way() -> None:
    ticks = np.array([5, -5, 2**31 - 1, 2**31, -(2**31), 2**32 - 3, 3 - 2**32])
    short = [5, -5, 2**31 - 1, -(2**31), -(2**31), -3, 3]
    assert nanocockpit._nearest(ticks).tolist() == short


def test_a_state_that_stands_counts_once_and_none_before_the_first(folder: Path) -> None:
    path = folder / "metadata.csv"
    head, *lines = path.read_text().splitlines()
    at = head.split(",").index("state_gap8_timestamp")
    rows = [line.split(",") for line in lines]
    for row, stamp in zip(rows, ("0", "0", rows[2][at], rows[2][at], *"xx"), strict=True):
        row[at] = row[at] if stamp == "x" else stamp
    path.write_text("\n".join([head, *(",".join(row) for row in rows)]) + "\n")
    found = samples(folder)
    images = [s.time_ns for s in found["/cf1/camera/image"]]
    assert [s.time_ns for s in found["/cf1/attitude"]] == [images[k] - 5_000_000 for k in (2, 4, 5)]
    for row in rows:
        row[at] = "0"
    path.write_text("\n".join([head, *(",".join(row) for row in rows)]) + "\n")
    assert samples(folder).keys() == {"/cf1/camera/image"}
