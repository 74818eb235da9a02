"""What convert leaves out is counted in one place: stderr, --json, provenance, --strict."""

import json
from pathlib import Path

import pytest

from dmrl import boundary
from dmrl.cli import app
from dmrl.recording import read_summary

from ..formats import plain_usd


def main(words: list[str]) -> int:
    """Exit status of the command."""
    return boundary.run_to_status(lambda: app(words, result_action="return_value"))


@pytest.fixture
def cut_log(tmp_path: Path) -> Path:
    """A micro-SD log without its last eleven bytes."""
    path = tmp_path / "log00"
    path.write_bytes(
        plain_usd.encode(
            {1: ("state", [("stateEstimate.z", "f")])},
            [(1, 1000 * k, (0.01 * k,)) for k in range(50)],
        )[:-11]
    )
    return path


def test_counts_are_in_json_provenance_and_info(
    cut_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.mcap"
    assert main(["convert", str(cut_log), str(out), "--json"]) == 0
    told = capsys.readouterr()
    counts = json.loads(told.out)["left_out"]
    ((reason, count),) = counts.items()
    assert reason == "bytes that are no whole record" and count > 0
    assert f"left out: {count} {reason} (first at {cut_log}: byte" in told.err
    made = read_summary(out).provenance
    assert made is not None and made.left_out == counts
    assert main(["info", str(out)]) == 0
    assert f"left out: {count} {reason}" in capsys.readouterr().out


def test_strict_leaves_nothing_behind(
    cut_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.mcap"
    assert main(["convert", str(cut_log), str(out), "--strict"]) == 1
    assert "--strict" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log00"]


def test_flags_without_effect_are_errors(
    cut_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.mcap"
    for flags, named in (
        (["--width-px", "320", "--height-px", "224"], "--width-px and --height-px"),
        (["--camera", "aideck"], "--camera"),
        (["--raw"], "--raw"),
        (["--rate-hz", "20"], "--rate-hz"),
        (["--labels", "labels.csv"], "--labels"),
    ):
        assert main(["convert", str(cut_log), str(out), *flags]) == 1
        assert f"{named} has no effect on a micro-SD log" in capsys.readouterr().err
        assert not out.exists()
    assert main(["convert", str(cut_log), str(out)]) == 0
    capsys.readouterr()
    assert main(["convert", str(out), str(tmp_path / "t"), "--to", "parquet", "--raw"]) == 1
    assert "--raw has no effect with --to parquet" in capsys.readouterr().err
