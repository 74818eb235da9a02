"""Times of images are read from their names."""

from pathlib import Path

import pytest

from dmrl.errors import SettingError, SourceError
from dmrl.formats.base import Options
from dmrl.formats.files import image_folder


def test_names_beyond_64_bits_are_not_times(tmp_path: Path) -> None:
    (tmp_path / f"{2**63 - 1}.png").write_bytes(b"")
    (tmp_path / "000000000007.png").write_bytes(b"")
    found = image_folder.list_images(tmp_path, 10.0)
    assert [time_ns for time_ns, _ in found] == [7, 2**63 - 1]
    (tmp_path / f"{2**63}.png").write_bytes(b"")
    with pytest.raises(SourceError, match="time after the year 2262"):
        image_folder.list_images(tmp_path, 10.0)


@pytest.mark.parametrize(("digits", "timed"), [(11, False), (12, True)])
def test_a_time_has_twelve_digits(digits: int, timed: bool, tmp_path: Path) -> None:
    (tmp_path / f"{5:0{digits}}.png").write_bytes(b"")
    ((time_ns, _),) = image_folder.list_images(tmp_path, 10.0)
    assert time_ns == (5 if timed else 0)


@pytest.mark.parametrize(
    ("names", "times", "said"),
    [
        (("1700000000123", "1700000000156"), (1_700_000_000_123_000_000, 33_000_000), "milli"),
        (
            ("1700000000123456", "1700000000156789"),
            (1_700_000_000_123_456_000, 33_333_000),
            "micro",
        ),
        (
            ("1700000000123456789", "1700000000126456789"),
            (1_700_000_000_123_456_789, 3_000_000),
            "",
        ),
        (("000000000001", "000000000002"), (0, 100_000_000), "numbers, too near for times"),
    ],
)
def test_unit_of_numeric_names_is_inferred_from_a_plausible_image_rate(
    names: tuple[str, ...],
    times: tuple[int, int],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in names:
        (tmp_path / f"{name}.png").write_bytes(b"")
    (first, _), (second, _) = image_folder.list_images(tmp_path, 10.0)
    assert (first, second - first) == times
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("names", "step_ns"),
    [
        (("20240301120000", "20240301120002"), 2_000_000_000),
        (("20240229235959", "20240301000000"), 1_000_000_000),
        (("20240301_115959", "20240301_120001"), 2_000_000_000),
        (("20240301-120000123", "20240301-120000456"), 333_000_000),
        (("20240301120000.000", "20240301120000.033"), 33_000_000),
        (("20240301120000000001", "20240301120000100002"), 100_001_000),
        (("IMG_20240301_120000", "IMG_20240301_120003_HDR"), 3_000_000_000),
        (("PXL_20240301_120000123.MP", "PXL_20240301_120001123"), 1_000_000_000),
        (("cam0-20240301T120000", "cam0-20240301T120007"), 7_000_000_000),
    ],
)
def test_dates_are_times(
    names: tuple[str, str], step_ns: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in names:
        (tmp_path / f"{name}.png").write_bytes(b"")
    (first, _), (second, _) = image_folder.list_images(tmp_path, 10.0)
    assert abs(first - 1_709_294_400_000_000_000) <= 43_201_000_000_000
    assert second - first == step_ns
    assert "are taken for dates in UTC" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["20241301120000", "20240230120000", "19691231235959"])
def test_invalid_dates_are_not_times(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for k in range(2):
        (tmp_path / f"{int(name) + k}.png").write_bytes(b"")
    found = image_folder.list_images(tmp_path, 10.0)
    assert [time_ns for time_ns, _ in found] == [0, 100_000_000]
    assert "for numbers, too near for times" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("names", "why"),
    [
        (("20241301120000", "20241301120002"), "month must be in 1..12"),
        (("20240015120000", "20240015130000"), "month must be in 1..12"),  # months counted from 0
        (("20240301120000", "20240301120060"), "second must be in 0..59"),
        (("20240230120000123", "20240230120000456"), "day is out of range for month"),
    ],
)
def test_near_dates_are_refused_with_what_is_wrong(
    names: tuple[str, str], why: str, tmp_path: Path
) -> None:
    for name in names:
        (tmp_path / f"{name}.png").write_bytes(b"")
    with pytest.raises(SourceError, match=rf"\d\.png is no date: {why}\. Rename it"):
        image_folder.list_images(tmp_path, 10.0)


@pytest.mark.parametrize(
    ("other", "why"),
    [("IMG_20240301_126000", "minute must be in 0..59"), ("a", "not like YYYYMMDD_hhmmss")],
)
def test_one_invalid_date_makes_all_times_nominal_and_is_reported(
    other: str, why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("IMG_20240301_120000", other):
        (tmp_path / f"{name}.jpg").write_bytes(b"")
    assert [t for t, _ in image_folder.list_images(tmp_path, 10.0)] == [0, 100_000_000]
    assert f"{other}.jpg is no date: {why}. So the times" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("frame_1403636579763555584", True),
        ("left1305031102.175304-a", True),
        ("frame_000000001", False),
        ("00012", False),
    ],
)
def test_times_beside_other_text_are_ignored_and_reported(
    name: str, said: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / f"{name}.png").write_bytes(b"")
    assert image_folder.list_images(tmp_path, 10.0)[0][0] == 0
    assert ("is not taken for a time" in capsys.readouterr().err) == said


def test_a_rate_has_an_effect_unless_names_are_times(folder: Path) -> None:
    for path in sorted(folder.glob("[abc].*")):
        path.rename(folder / f"frame_{path.stem:0>9}{path.suffix}")
    found = image_folder.load_content(folder, Options(rate_hz=20)).samples
    assert [s.time_ns for s in found if s.message == "CompressedImage"][1] == 50_000_000
    for k, path in enumerate(sorted(folder.glob("frame_*"))):
        path.rename(folder / f"{k}.5{path.suffix}")
    with pytest.raises(SettingError, match="are named by times"):
        image_folder.load_content(folder, Options(rate_hz=20))
