"""Flags: a CSV file lists images to leave out of a dataset."""

from pathlib import Path

import pytest

from dmrl.datasets.writing.exclusions import load_flags
from dmrl.errors import DmrlError, SettingError
from dmrl.stages.dataset import Settings, run

from ..conftest import Record, build_peer

HEAD = "source,robot,log_time\n"


def write_flags(folder: Path, text: str) -> Path:
    """Write a flag file."""
    path = folder / "flags.csv"
    path.write_text(text)
    return path


def test_flags_are_read_with_reasons_or_without(tmp_path: Path) -> None:
    text = "log_time,reason,robot,source\n5,blurred,cf1,a.mcap\n5,,cf1,a.mcap\n"
    assert load_flags(write_flags(tmp_path, text)) == {("a.mcap", "cf1", 5)}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("source,robot\n", "flags.csv:1: no column log_time"),
        (HEAD.replace("robot", "robot,colour"), "flags.csv:1: column 'colour'"),
        (HEAD + "a.mcap,cf1,1.5\n", "flags.csv:2: '1.5' is not a time"),
        (HEAD + "a.mcap,cf1,--5\n", "flags.csv:2: '--5' is not a time"),
        (HEAD + "a.mcap,,1\n", "flags.csv:2: not a source, robot, log_time"),
        (HEAD + "a.mcap,cf1,1,2\n", "flags.csv:2: not a source, robot, log_time"),
        (HEAD + '"a.mcap,cf1', "flags.csv is not a CSV file"),
        ("", "flags.csv:1: no column source"),
    ],
)
def test_invalid_flag_error_names_its_line(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(SettingError, match=says):
        load_flags(write_flags(tmp_path, text))


def test_missing_file_gives_one_line_error(record: Record, tmp_path: Path) -> None:
    with pytest.raises(DmrlError, match=r"no file .*none\.csv"):
        run([record()], tmp_path / "out", Settings(without=tmp_path / "none.csv"))
    assert not (tmp_path / "out").exists()


@pytest.mark.heavy
def test_flags_without_an_image_are_reported(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_flags(tmp_path, HEAD + "flight.mcap,cf1,0\nflight.mcap,cf9,0\n")
    made = run([record()], tmp_path / "out", Settings(split="none", without=path))
    assert made.images == {"train": 5}
    assert "1 of 2 flags name no image here" in capsys.readouterr().err


@pytest.mark.heavy
def test_images_with_an_impossible_label_are_left_out(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    nan, inf = float("nan"), float("inf")
    odd = [{"u_px": nan}, {"v_px": -inf}, {"u_px": 1e30}, {"depth_m": inf}, {"depth_m": nan}]
    unknown = {"depth_m": nan, "sigma_depth_m": inf}
    flight = record(peers=[[build_peer(**fields)] for fields in ({}, *odd, unknown)])
    made = run([flight], tmp_path / "out", Settings(split="none"))
    assert made.images == {"train": 2}
    assert "pixel or depth is no number: 5" in capsys.readouterr().err
