"""A disk that fails at the n-th operation, for every n and every stage that writes."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from .conftest import Count, cases_of, ended, unchanged
from .disk import KILL, REFUSALS, Disk, small_files
from .works import WORKS, Inputs, Work, clear, contents

SLOW = [pytest.param(work, id=work.name, marks=pytest.mark.slow) for work in WORKS]
QUICK = [pytest.param(work, id=work.name) for work in WORKS if work.name in ("trim", "recover")]
# Python 3.12 says that threads of the parent are not in the child; it needs none of them.
pytestmark = pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")

KILLS = 50


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("outputs")


def reference(inputs: Inputs, work: Work, folder: Path) -> tuple[dict[str, bytes], int, float]:
    """What the stage writes undisturbed, with how many operations and in which time."""
    for _ in range(2):  # the first also loads what the stage imports
        clear(folder)
        begun = time.monotonic()
        with Disk(folder) as disk:
            status, said = ended(lambda: work.run(inputs, folder / work.out))
        assert status == 0, said
    return contents(folder / work.out), disk.count, time.monotonic() - begun


def after(
    inputs: Inputs, work: Work, folder: Path, whole: dict[str, bytes], *, refused: bool
) -> bool:
    """Whether the output stands. It is whole if so; else a second run makes it, to the byte."""
    out = folder / work.out
    there = out.exists()
    if work.name == "run":
        there = contents(out) == whole if there else False
    elif there:
        assert contents(out) == whole, "half an output under its final name"
    elif refused:
        assert [path.name for path in folder.iterdir()] == [], "leftovers of a refusal"
    if not there:
        status, said = ended(lambda: work.run(inputs, out))
        assert status == 0, said
        assert contents(out) == whole, "the second run differs"
        assert [path.name for path in folder.iterdir()] == [work.out]
    return there


def broken(inputs: Inputs, work: Work, folder: Path, count: Count, *, quick: bool) -> None:
    """Every operation fails once: with all errors in turn, or, of a slow stage, with the next."""
    whole, operations, _ = reference(inputs, work, folder)
    before = contents(inputs.folder)
    cases = refused = 0
    assert operations > 2
    for k in range(operations):
        for error in REFUSALS[k % len(REFUSALS) :][:1] if quick else REFUSALS:
            clear(folder)
            with Disk(folder, k, error) as disk:
                status, said = ended(lambda: work.run(inputs, folder / work.out))
            assert disk.failed or status == 0
            there = after(inputs, work, folder, whole, refused=status == 1)
            # What fails beside the output (a log, a figure) need not stop the work.
            assert there == (status == 0), f"{disk.failed}: status {status}, {said}"
            cases, refused = cases + 1, refused + status
    unchanged(inputs, before)
    count(
        f"the n-th operation fails: {work.name}",
        cases=cases,
        refused=refused,
        right=cases - refused,
    )


@pytest.mark.parametrize("work", QUICK)
def test_every_operation_may_fail(work: Work, inputs: Inputs, folder: Path, count: Count) -> None:
    broken(inputs, work, folder, count, quick=True)


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("work", SLOW)
def test_every_operation_may_fail_in_every_way(
    work: Work, inputs: Inputs, folder: Path, count: Count
) -> None:
    broken(inputs, work, folder, count, quick=work.slow)


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("work", SLOW)
def test_no_file_may_grow_beyond_what_the_kernel_lets_it(
    work: Work, inputs: Inputs, folder: Path, count: Count
) -> None:
    whole, _, _ = reference(inputs, work, folder)
    largest = max(map(len, whole.values()))
    cases = refused = 0
    for size in np.unique(np.geomspace(1, largest, 12).astype(int) - 1).tolist():
        clear(folder)
        with small_files(size):
            status, said = ended(lambda: work.run(inputs, folder / work.out))
        there = after(inputs, work, folder, whole, refused=status == 1)
        assert there == (status == 0), said
        cases, refused = cases + 1, refused + status
    assert refused
    count(
        "no file may be larger (RLIMIT_FSIZE)", cases=cases, refused=refused, right=cases - refused
    )


def child(work: Callable[[], object]) -> int:
    """Number of a new process that does the work and ends."""
    number = os.fork()
    if number == 0:
        try:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            work()
        finally:
            os._exit(0)
    return number


def killed(inputs: Inputs, work: Work, folder: Path, count: Count, moments: int) -> None:
    whole, operations, duration_s = reference(inputs, work, folder)
    rng = np.random.default_rng(len(work.name))
    dead = found = 0
    for k in range(moments):
        clear(folder)
        if k % 2:
            at = int(rng.integers(operations))

            def dying(at: int = at) -> None:
                with Disk(folder, at, KILL):
                    work.run(inputs, folder / work.out)

            number = child(dying)
        else:
            number = child(lambda: work.run(inputs, folder / work.out))
            time.sleep(float(rng.random()) * duration_s)
            os.kill(number, signal.SIGKILL)
        _, status = os.waitpid(number, 0)
        dead += os.WIFSIGNALED(status)
        found += after(inputs, work, folder, whole, refused=False)
    count(f"kill -9: {work.name}", cases=dead, found=moments - found, right=found)


@pytest.mark.parametrize("work", QUICK)
def test_a_kill_leaves_nothing_half(work: Work, inputs: Inputs, folder: Path, count: Count) -> None:
    killed(inputs, work, folder, count, 6)


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("work", SLOW)
def test_a_kill_at_any_moment_leaves_nothing_half(
    work: Work, inputs: Inputs, folder: Path, count: Count
) -> None:
    killed(inputs, work, folder, count, cases_of(KILLS))
