"""A disk that fails at the n-th operation, for every n and every command that writes."""

import errno
from pathlib import Path

import numpy as np
import pytest

from dmrl.cli import COMMANDS

from .conftest import SHARE, Count, cases_of
from .disk import KILL, Disk, Fault
from .fault_trials import FaultTrials
from .workloads import RECORD, WORKLOADS, Workload, find_workload

SLOW = [pytest.param(work, id=work.name, marks=pytest.mark.slow) for work in WORKLOADS]
QUICK = [pytest.param(work, id=work.name) for work in WORKLOADS if work.name == "trim"]
KILLS = 50
SIZES = 8
AT_ONCE = 12
"""Operations that a process goes through, with every error, before a fresh one."""
WRITES_NOTHING = {"check", "doctor", "fake-drone", "find", "info"}
IS_A_RUN = {"demo"}
"""It is `dmrl run demo`."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The disk; inputs are elsewhere."""
    return tmp_path / "disk"


def test_every_command_that_writes_is_broken() -> None:
    broken = {work.of for work in (*WORKLOADS, RECORD)}
    assert broken == set(COMMANDS) - WRITES_NOTHING - IS_A_RUN


@pytest.mark.slow
def test_writes_of_c_libraries_reach_the_faulty_disk(disk: Disk, folder: Path) -> None:
    """Arrow opens and writes the tables of a dataset without Python."""
    broken = FaultTrials(find_workload("dataset"), disk, folder, disk.inputs)
    failed = []
    for at in range(broken.sound.operations):
        broken.clear()
        failed.append(broken.run(Fault(at, errno.EIO)).failed)
        if ".arrow" in failed[-1] and failed[-1].startswith("write"):
            return
    raise AssertionError(failed)


@pytest.mark.heavy
@pytest.mark.parametrize("work", [pytest.param(work, id=work.name) for work in WORKLOADS])
def test_every_command_succeeds_without_faults(work: Workload, disk: Disk, folder: Path) -> None:
    """What the slow ones begin with: a work that its command has outgrown is seen early."""
    assert FaultTrials(work, disk, folder, disk.inputs).whole


def broken_everywhere(broken: FaultTrials, disk: Disk, count: Count, *, quick: bool) -> None:
    """Every operation fails once with each error; ``quick``: with the next of them in turn.

    One process goes through many of them, as a program that uses dmrl would.
    """
    assert broken.sound.operations > 2
    for first in range(0, broken.sound.operations, AT_ONCE):
        last = min(first + AT_ONCE, broken.sound.operations)
        given = {"work": broken.work.name, "folder": str(broken.folder), "quick": quick}
        broken.add(**disk.call("in_process:break_at", first=first, last=last, **given))
    broken.report("the n-th operation fails", count)


@pytest.mark.parametrize("work", QUICK)
@pytest.mark.heavy
def test_every_operation_may_fail(work: Workload, disk: Disk, folder: Path, count: Count) -> None:
    broken_everywhere(FaultTrials(work, disk, folder, disk.inputs), disk, count, quick=True)


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("work", SLOW)
def test_every_operation_may_fail_in_every_way(
    work: Workload, disk: Disk, folder: Path, count: Count
) -> None:
    broken_everywhere(FaultTrials(work, disk, folder, disk.inputs), disk, count, quick=SHARE < 1)


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("work", SLOW)
def test_file_size_limit_of_the_kernel_is_reported(
    work: Workload, disk: Disk, folder: Path, count: Count
) -> None:
    broken = FaultTrials(work, disk, folder, disk.inputs)
    largest = max(map(len, broken.whole.values()))
    for size in np.unique(np.geomspace(1, largest, SIZES).astype(int) - 1).tolist():
        broken.clear()
        ending = broken.run(most_bytes=size)
        broken.judge(ending, f"no file over {size} bytes", may_stay=False, again=True)
    assert broken.refused
    broken.report("no file may be larger (RLIMIT_FSIZE)", count)


def killed(broken: FaultTrials, count: Count, moments: int) -> None:
    """Kill it at a random operation, and at a random moment, in turn."""
    rng = np.random.default_rng(len(broken.work.name))
    for k in range(moments):
        broken.clear()
        if k % 2:
            fault = Fault(int(rng.integers(broken.sound.operations)), KILL)
            ending, why = broken.run(fault), str(fault)
        else:
            kill_s = float(rng.random()) * broken.sound.seconds
            ending, why = broken.run(kill_s=kill_s), f"killed after {kill_s:.3f} s"
        broken.judge(ending, why, may_stay=True, again=True)
    broken.report("kill -9", count)


@pytest.mark.heavy
@pytest.mark.parametrize("work", QUICK)
def test_killed_command_leaves_no_partial_output(
    work: Workload, disk: Disk, folder: Path, count: Count
) -> None:
    killed(FaultTrials(work, disk, folder, disk.inputs), count, 6)


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("work", SLOW)
def test_command_killed_at_any_operation_leaves_no_partial_output(
    work: Workload, disk: Disk, folder: Path, count: Count
) -> None:
    killed(FaultTrials(work, disk, folder, disk.inputs), count, cases_of(KILLS))
