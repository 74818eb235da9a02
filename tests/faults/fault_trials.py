"""Inject faults into one workload again and again, and count the results."""

import errno
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from .disk import REFUSALS, Ending, Fault
from .workloads import Workload, clear, contents

STAYING = (errno.ENOSPC, errno.EIO, errno.EROFS)
"""Of these every second stays: the disk is full, broken or read-only from there on."""
PATIENCE_S = 30.0


class Runner(Protocol):
    """Runner of workloads on a disk that fails: `Disk` in child processes, or `InProcess`."""

    def run(
        self,
        work: str,
        folder: Path,
        out: str,
        fault: Fault | None = None,
        *,
        kill_s: float | None = None,
        most_bytes: int | None = None,
    ) -> Ending:
        """Run a workload and return how it ended."""

    def prepare(self, work: str, folder: Path, out: str) -> None:
        """Make what a workload needs before it starts."""


class FaultTrials:
    """A workload, its outputs without faults, and the counts of its trials.

    Parameters
    ----------
    work
        The workload.
    disk
        Runner of the workload.
    folder
        The disk.
    inputs
        A folder that no workload may change.
    times
        How often it is run without faults: twice, where the first makes the inputs, and loads what
        the command imports.
    """

    def __init__(
        self, work: Workload, disk: Runner, folder: Path, inputs: Path, times: int = 2
    ) -> None:
        self.work, self.disk, self.folder = work, disk, folder
        self.out = folder / work.out
        self.cases = self.refused = self.right = self.again = 0
        self.wrong: list[str] = []
        for _ in range(times):
            self.clear()
            self.before = contents(self.out) if self.out.exists() else {}
            self.found = [self.read()]
            self.sound = self.run()
        assert self.sound.status == 0, self.wrong or self.sound.said
        self.whole = contents(self.out)
        self.found.append(self.read())
        self._inputs = (inputs, contents(inputs))

    def clear(self) -> None:
        """Restore the disk to its first state."""
        clear(self.folder)
        if self.work.before:
            self.disk.prepare(self.work.name, self.folder, self.work.out)

    def read(self) -> dict[str, object]:
        """What others find in the output."""
        return {} if self.work.reads is None else self.work.reads(self.out)

    def run(
        self,
        fault: Fault | None = None,
        *,
        kill_s: float | None = None,
        most_bytes: int | None = None,
    ) -> Ending:
        """How the work ended."""
        given = (self.work.name, self.folder, self.work.out, fault)
        try:
            return self.disk.run(*given, kill_s=kill_s, most_bytes=most_bytes)
        except AssertionError as e:
            self.wrong.append(str(e))
            return Ending(1, "a bug", 0, "", 0.0)

    def break_at(self, operations: range, *, quick: bool = False) -> None:
        """Each of these operations fails with every error; ``quick``: with the next in turn."""
        for k in operations:
            for number, error in enumerate(REFUSALS):
                again = number == k % len(REFUSALS)
                if quick and not again:
                    continue
                fault = Fault(k, error, stays=error in STAYING and (k + number) % 2 == 1)
                self.clear()
                ending = self.run(fault)
                why = f"{self.work.name}, {fault}, {ending.failed}"
                may_stay = fault.stays and error != errno.ENOSPC
                self.judge(ending, why, may_stay=may_stay, again=again)

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
        for who, found in self.read().items():
            assert found in [known[who] for known in self.found], f"{why}: {who} finds {found}"

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

    def add(self, cases: int, refused: int, right: int, again: int, wrong: list[str]) -> None:
        """Count what was broken elsewhere."""
        self.cases, self.refused = self.cases + cases, self.refused + refused
        self.right, self.again = self.right + right, self.again + again
        self.wrong += wrong

    def report(self, what: str, count: Callable[..., None]) -> None:
        """A row of the table, if nothing was wrong."""
        assert not self.wrong, "\n".join(self.wrong)
        folder, before = self._inputs
        assert contents(folder) == before, "an input was changed"
        cells = {"cases": self.cases, "refused": self.refused, "right": self.right}
        count(f"{what}: {self.work.name}", **cells, found=self.again)
