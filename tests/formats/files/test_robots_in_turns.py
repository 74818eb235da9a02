"""A file with rows of several robots whose column map names no robot column."""

from pathlib import Path

import pytest

from dmrl.formats.base import Options
from dmrl.formats.files import mapped_csv

TABLE = '[time]\nname = "t"\nunit = "s"\n[height]\nname = "z"\nunit = "m"\n'


@pytest.mark.parametrize(
    ("name", "values", "doubted"),
    [
        ("robot", ("cf1", "cf2"), True),
        ("mode", ("cf1", "cf2"), True),
        ("id", ("1", "2"), True),
        ("flag", ("0", "1"), False),
        ("robot", ("cf1", "cf1"), False),
    ],
)
def test_alternating_robots_are_reported(
    name: str,
    values: tuple[str, str],
    doubted: bool,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    rows = [f"{0.01 * k:.2f},{values[k % 2]},{1 + k % 2}" for k in range(20)]
    (path := tmp_path / "a.csv").write_text("\n".join([f"t,{name},z", *rows]))
    (table := tmp_path / "a.toml").write_text(TABLE)
    mapped_csv.load_content(path, Options(columns=table))
    told = capsys.readouterr().err
    assert (f"{name!r} is {values[0]}, {values[1]} in turns" in told) == doubted


def test_changing_text_columns_are_not_taken_for_robots(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [f"{0.01 * k:.2f},{'up' if k < 10 else 'down'},1" for k in range(20)]
    (path := tmp_path / "a.csv").write_text("\n".join(["t,robot,z", *rows]))
    (table := tmp_path / "a.toml").write_text(TABLE)
    mapped_csv.load_content(path, Options(columns=table))
    assert "in turns" not in capsys.readouterr().err
