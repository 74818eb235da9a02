"""Let the n-th disk operation fail, for every n and every command that writes."""

import errno
from pathlib import Path

import numpy as np
import pytest

from dmrl.cli import COMMANDS

from .conftest import SHARE, Count, scale_cases
from .disk import KILL, Disk, Fault
from .fault_trials import FaultTrials
from .workloads import RECORD, WORKLOADS, Workload, find_workload

SLOW = [pytest.param(work, id=work.name, marks=pytest.mark.slow) for work in WORKLOADS]
QUICK = [pytest.param(work, id=work.name) for work in WORKLOADS if work.name == "trim"]
KILLS = 50
SIZES = 8
OPERATIONS_PER_PROCESS = 12
"""Operations that one process breaks, with every error, before a new one starts."""
WRITES_NOTHING = {"check", "doctor", "fake-drone", "find", "info"}
IS_A_RUN = {"demo"}
"""Commands that run a pipeline: `dmrl demo` is `dmrl run demo`."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return the folder of the disk that fails; the inputs lie elsewhere."""
    return tmp_path / "disk"


def test_every_command_that_writes_has_a_workload() -> None:
    covered = {work.of for work in (*WORKLOADS, RECORD)}
    assert covered == set(COMMANDS) - WRITES_NOTHING - IS_A_RUN


@pytest.mark.slow
def test_writes_of_c_libraries_reach_the_faulty_disk(disk: Disk, folder: Path) -> None:
    """Arrow opens and writes the tables of a dataset without Python."""
    trials = FaultTrials(find_workload("dataset"), disk, folder, disk.inputs)
    failed = []
    for at in range(trials.sound.operations):
        trials.clear()
        failed.append(trials.run(Fault(at, errno.EIO)).failed)
        if ".arrow" in failed[-1] and failed[-1].startswith("write"):
            return
    raise AssertionError(failed)


@pytest.mark.heavy
@pytest.mark.parametrize("work", [pytest.param(work, id=work.name) for work in WORKLOADS])
def test_every_command_succeeds_without_faults(work: Workload, disk: Disk, folder: Path) -> None:
    """The slow tests need this; it shows early that a workload no longer fits its command."""
    assert FaultTrials(work, disk, folder, disk.inputs).whole


def break_every_operation(trials: FaultTrials, disk: Disk, count: Count, *, quick: bool) -> None:
    """Let every operation fail with each error; ``quick``: with one of them, in turn.

    One process tries many of them, as a program that uses dmrl might.
    """
    assert trials.sound.operations > 2
    for first in range(0, trials.sound.operations, OPERATIONS_PER_PROCESS):
        last = min(first + OPERATIONS_PER_PROCESS, trials.sound.operations)
        given = {"work": trials.work.name, "folder": str(trials.folder), "quick": quick}
        trials.add(**disk.call("in_process:break_at", first=first, last=last, **given))
    trials.report("the n-th operation fails", count)


@pytest.mark.parametrize("work", QUICK)
@pytest.mark.heavy
def test_every_operation_may_fail(work: Workload, disk: Disk, folder: Path, count: Count) -> None:
    break_every_operation(FaultTrials(work, disk, folder, disk.inputs), disk, count, quick=True)


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("work", SLOW)
def test_every_operation_may_fail_in_every_way(
    work: Workload, disk: Disk, folder: Path, count: Count
) -> None:
    break_every_operation(
        FaultTrials(work, disk, folder, disk.inputs), disk, count, quick=SHARE < 1
    )


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("work", SLOW)
def test_file_size_limit_of_the_kernel_is_reported(
    work: Workload, disk: Disk, folder: Path, count: Count
) -> None:
    trials = FaultTrials(work, disk, folder, disk.inputs)
    largest = max(map(len, trials.whole.values()))
    for size in np.unique(np.geomspace(1, largest, SIZES).astype(int) - 1).tolist():
        trials.clear()
        ending = trials.run(most_bytes=size)
        trials.judge(ending, f"no file over {size} bytes", may_stay=False, again=True)
    assert trials.refused
    trials.report("no file may be larger (RLIMIT_FSIZE)", count)


def kill_at_random(trials: FaultTrials, count: Count, moments: int) -> None:
    """Kill the command at a random operation and at a random time, in turn."""
    rng = np.random.default_rng(len(trials.work.name))
    for k in range(moments):
        trials.clear()
        if k % 2:
            fault = Fault(int(rng.integers(trials.sound.operations)), KILL)
            ending, why = trials.run(fault), str(fault)
        else:
            kill_s = float(rng.random()) * trials.sound.seconds
            ending, why = trials.run(kill_s=kill_s), f"killed after {kill_s:.3f} s"
        trials.judge(ending, why, may_stay=True, again=True)
    trials.report("kill -9", count)


@pytest.mark.heavy
@pytest.mark.parametrize("work", QUICK)
def test_killed_command_leaves_no_partial_output(
    work: Workload, disk: Disk, folder: Path, count: Count
) -> None:
    kill_at_random(FaultTrials(work, disk, folder, disk.inputs), count, 6)


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("work", SLOW)
def test_command_killed_at_any_operation_leaves_no_partial_output(
    work: Workload, disk: Disk, folder: Path, count: Count
) -> None:
    kill_at_random(FaultTrials(work, disk, folder, disk.inputs), count, scale_cases(KILLS))
