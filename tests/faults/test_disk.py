"""A disk that fails at the n-th operation, for every n and every command that writes."""

import errno
import time
from pathlib import Path

import numpy as np
import pytest

from dmrl.cli import COMMANDS

from .conftest import SHARE, Count, cases_of
from .disk import KILL, REFUSALS, Disk, Ending, Fault
from .works import RECORD, WORKS, Work, clear, contents

SLOW = [pytest.param(work, id=work.name, marks=pytest.mark.slow) for work in WORKS]
QUICK = [pytest.param(work, id=work.name) for work in WORKS if work.name == "trim"]
KILLS = 50
SIZES = 8
STAYING = (errno.ENOSPC, errno.EIO, errno.EROFS)
"""Of these every second stays: the disk is full, broken or read-only from there on."""
PATIENCE_S = 30.0
WRITES_NOTHING = {"check", "doctor", "fake-drone", "find", "info"}
IS_A_RUN = {"demo"}
"""It is `dmrl run demo`."""


class Broken:
    """One work that is broken again and again: what it gives undisturbed, and what was counted."""

    def __init__(self, work: Work, disk: Disk, folder: Path) -> None:
        self.work, self.disk, self.folder = work, disk, folder
        self.out = folder / work.out
        self.cases = self.refused = self.right = self.again = 0
        self.wrong: list[str] = []
        for _ in range(2):  # the first makes the inputs, and loads what the command imports
            self.clear()
            self.before = contents(self.out) if self.out.exists() else {}
            self.sound = self.run()
        assert self.sound.status == 0, self.sound.said
        self.whole = contents(self.out)
        self.inputs = contents(disk.folder / "inputs")

    def clear(self) -> None:
        """The disk as it was before."""
        clear(self.folder)
        if self.work.before:
            self.disk.prepare(self.work.name, self.folder, self.work.out)

    def run(
        self,
        fault: Fault | None = None,
        *,
        kill_s: float | None = None,
        most_bytes: int | None = None,
    ) -> Ending:
        try:
            return self.disk.run(
                self.work.name,
                self.folder,
                self.work.out,
                fault,
                kill_s=kill_s,
                most_bytes=most_bytes,
            )
        except AssertionError as e:
            self.wrong.append(str(e))
            return Ending(1, "a bug", 0, "", 0.0)

    @property
    def done(self) -> bool:
        """Whether the output stands, and is what it should be."""
        found = contents(self.out) if self.out.exists() else {}
        # Cut off between its two names, a file keeps both.
        twins = {name for name in found if found.get(f"{name}.partial") == found[name]}
        found = {
            n: data
            for n, data in found.items()
            if n.removesuffix(".partial") not in twins or n in twins
        }
        if self.work.same:
            return found == self.whole
        sizes = [sum(map(len, one.values())) for one in (found, self.whole)]
        return abs(sizes[0] - sizes[1]) < 0.1 * sizes[1]

    def refuse_half(self, why: object) -> None:
        """Nothing, if what stands under its final name is whole."""
        if not self.out.exists() or self.done:
            return
        assert self.work.pieces, f"{why}: half an output under its final name"
        for name, data in contents(self.out).items():
            unfinished = any(part.endswith(".partial") for part in Path(name).parts)
            wanted = (self.whole.get(name), self.before.get(name))
            assert unfinished or data in wanted, f"{why}: half of {name}"

    def judge(self, ending: Ending, why: str, *, may_stay: bool, again: bool) -> None:
        """What came of a disturbance; then, or where anything is left of it, once more."""
        self.cases += 1
        try:
            self._judge(ending, why, may_stay=may_stay, again=again)
        except AssertionError as e:
            self.wrong.append(str(e).splitlines()[0])

    def _judge(self, ending: Ending, why: str, *, may_stay: bool, again: bool) -> None:
        self.refused += ending.status == 1
        assert ending.status in (0, 1, -9), f"{why}: status {ending.status}, {ending.said}"
        self.refuse_half(why)
        left = sorted(path.name for path in self.folder.iterdir())
        if ending.status == 0:
            assert self.done, f"{why}: status 0, and no output"
        if self.done:
            self.right += 1
        if ending.status == 1:
            mine = {self.work.out} if self.work.pieces or self.done else set()
            assert may_stay or self.work.keeps or set(left) <= mine, f"{why}: {left} is left over"
        if not self.done and (again or left):
            self.run_again(why)

    def run_again(self, why: str) -> None:
        """The second run gives the bytes of an undisturbed one."""
        until = time.monotonic() + PATIENCE_S
        while True:
            ending = self.run()
            # Steps of a pipeline that was killed end soon after it.
            if "is being written by another" not in ending.said or time.monotonic() > until:
                break
            time.sleep(0.05)
        assert ending.status == 0, f"{why}: the second run says {ending.said}"
        assert self.done, f"{why}: the second run differs"
        assert [path.name for path in self.folder.iterdir()] == [self.work.out], why
        self.again += 1

    def report(self, what: str, count: Count) -> None:
        """A row of the table, if nothing was wrong."""
        assert not self.wrong, "\n".join(self.wrong)
        assert contents(self.disk.folder / "inputs") == self.inputs
        cells = {"cases": self.cases, "refused": self.refused, "right": self.right}
        count(f"{what}: {self.work.name}", **cells, found=self.again)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The disk; inputs are elsewhere."""
    return tmp_path / "disk"


def test_every_command_that_writes_is_broken() -> None:
    broken = {work.of for work in (*WORKS, RECORD)}
    assert broken == COMMANDS.keys() - WRITES_NOTHING - IS_A_RUN


@pytest.mark.slow
def test_what_a_library_writes_in_c_comes_to_the_disk(disk: Disk, folder: Path) -> None:
    """Arrow opens and writes the tables of a dataset without Python."""
    broken = Broken(next(work for work in WORKS if work.name == "dataset"), disk, folder)
    failed = []
    for at in range(broken.sound.operations):
        broken.clear()
        failed.append(broken.run(Fault(at, errno.EIO)).failed)
        if ".arrow" in failed[-1] and failed[-1].startswith("write"):
            return
    raise AssertionError(failed)


def broken_everywhere(broken: Broken, count: Count, *, quick: bool) -> None:
    """Every operation fails once: with all errors in turn, or, of a slow command, with the next."""
    assert broken.sound.operations > 2
    for k in range(broken.sound.operations):
        for number, error in enumerate(REFUSALS):
            if quick and number != k % len(REFUSALS):
                continue
            fault = Fault(k, error, stays=error in STAYING and (k + number) % 2 == 1)
            broken.clear()
            ending = broken.run(fault)
            why = f"{broken.work.name}, {fault}, {ending.failed}"
            again = number == k % len(REFUSALS)
            broken.judge(ending, why, may_stay=fault.stays and error != errno.ENOSPC, again=again)
    broken.report("the n-th operation fails", count)


@pytest.mark.parametrize("work", QUICK)
def test_every_operation_may_fail(work: Work, disk: Disk, folder: Path, count: Count) -> None:
    broken_everywhere(Broken(work, disk, folder), count, quick=True)


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("work", SLOW)
def test_every_operation_may_fail_in_every_way(
    work: Work, disk: Disk, folder: Path, count: Count
) -> None:
    broken_everywhere(Broken(work, disk, folder), count, quick=work.slow or SHARE < 1)


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("work", SLOW)
def test_no_file_may_grow_beyond_what_the_kernel_lets_it(
    work: Work, disk: Disk, folder: Path, count: Count
) -> None:
    broken = Broken(work, disk, folder)
    largest = max(map(len, broken.whole.values()))
    for size in np.unique(np.geomspace(1, largest, SIZES).astype(int) - 1).tolist():
        broken.clear()
        ending = broken.run(most_bytes=size)
        broken.judge(ending, f"no file over {size} bytes", may_stay=False, again=True)
    assert broken.refused
    broken.report("no file may be larger (RLIMIT_FSIZE)", count)


def killed(broken: Broken, count: Count, moments: int) -> None:
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


@pytest.mark.parametrize("work", QUICK)
def test_a_kill_leaves_nothing_half(work: Work, disk: Disk, folder: Path, count: Count) -> None:
    killed(Broken(work, disk, folder), count, 6)


@pytest.mark.timeout(3000)
@pytest.mark.parametrize("work", SLOW)
def test_a_kill_at_any_moment_leaves_nothing_half(
    work: Work, disk: Disk, folder: Path, count: Count
) -> None:
    killed(Broken(work, disk, folder), count, cases_of(KILLS))
