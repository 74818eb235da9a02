"""Third-party text logs with comments, wrapping counters, held values and simulated time."""

import json
from pathlib import Path

import numpy as np
import pytest

from dmrl import boundary
from dmrl.cli import app
from dmrl.recording import read_log_times, read_summary, read_table


def run_case(
    data: Path, name: str, out: Path, capsys: pytest.CaptureFixture[str]
) -> dict[str, int]:
    """Run the command of a case of the real data; return the counts of what it left out."""
    folder = data / "strangers" / name
    if not folder.is_dir():
        pytest.skip(f"no case {name}")
    _, command, *words = (folder / "command.txt").read_text().splitlines()[0].split()
    here = {p.name: str(p) for p in folder.iterdir()} | {"out.mcap": str(out)}
    words = [here.get(word, word) for word in words]
    status = boundary.run_to_status(
        lambda: app([command, *words, "--json"], result_action="return_value")
    )
    told = capsys.readouterr()
    assert status == 0, told.err
    found: dict[str, int] = json.loads(told.out)["left_out"]
    return found


@pytest.mark.parametrize("name", ["comment_lines", "hash_header"])
def test_comments_and_a_commented_header_are_parsed(
    name: str, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_case(data, f"csv-{name}", tmp_path / "a.mcap", capsys) == {}
    topics = read_summary(tmp_path / "a.mcap").topics
    assert {info.count for info in topics.values()} == {200}


def test_a_counter_of_16_bits_that_wraps(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_case(data, "csv-ms_wrap_u16", tmp_path / "a.mcap", capsys) == {}
    time_ns = read_table(tmp_path / "a.mcap", "/cf1/height")["log_time"].to_numpy()
    assert np.diff(time_ns).tolist() == [20_000_000] * 199


def test_held_ranges(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    left_out = run_case(data, "csv-range_held", tmp_path / "a.mcap", capsys)
    assert list(left_out.values()) == [180]
    assert read_summary(tmp_path / "a.mcap").topics["/cf1/range/cf2"].count == 20


@pytest.mark.heavy
def test_simulated_time_from_zero(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rosbags")
    run_case(data, "ros-sim_time_from_zero", tmp_path / "a.mcap", capsys)
    summary = read_summary(tmp_path / "a.mcap")
    assert {info.count for info in summary.topics.values()} == {20}  # images and odometry
    for topic, time_ns in read_log_times(tmp_path / "a.mcap", summary.topics).items():
        assert (time_ns.min(), time_ns.max()) == (0, 1_900_000_000), topic
