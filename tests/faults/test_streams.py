"""A closed or full standard output gives a one-line error, and finished output stays."""

from pathlib import Path

import pytest

from .conftest import Count
from .disk import Disk
from .fault_trials import FaultTrials
from .workloads import READS, WORKLOADS, Workload, clear_folder

STREAMS = ("full", "closed")
QUICK = ("info", "find as JSON")


def check_without_stdout(name: str, disk: Disk, folder: Path, count: Count) -> None:
    """Assert that a command that only prints reports in one line that it cannot."""
    clear_folder(folder)
    for stream in STREAMS:
        given = {"work": name, "out": str(folder / "none"), "stream": stream}
        status, said = disk.call("server:run_without_stdout", **given)
        assert status == 1, (stream, said)
        assert "standard output" in said, said
        assert not list(folder.iterdir())
        count("standard output closed or full", cases=1, refused=1)


@pytest.mark.heavy
@pytest.mark.parametrize("name", QUICK)
def test_full_or_closed_stdout_gives_one_line_error(
    name: str, disk: Disk, tmp_path: Path, count: Count
) -> None:
    check_without_stdout(name, disk, tmp_path / "disk", count)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(READS.keys() - set(QUICK)))
def test_full_or_closed_stdout_of_each_reading_command_gives_one_line_error(
    name: str, disk: Disk, tmp_path: Path, count: Count
) -> None:
    check_without_stdout(name, disk, tmp_path / "disk", count)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("work", WORKLOADS, ids=lambda work: work.name)
def test_command_with_unwritable_stdout_completes_or_leaves_nothing(
    work: Workload, disk: Disk, tmp_path: Path, count: Count
) -> None:
    trials = FaultTrials(work, disk, tmp_path / "disk", disk.inputs)
    for stream in STREAMS:
        trials.clear()
        given = {"work": work.name, "out": str(trials.out), "stream": stream}
        status, said = disk.call("server:run_without_stdout", **given)
        assert status == 0 or (status == 1 and "standard output" in said), (stream, said)
        assert trials.done, (stream, said, sorted(tmp_path.rglob("*")))
        count("standard output closed or full", cases=1, refused=status, right=1)
