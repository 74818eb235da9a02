"""Inject faults into one workload repeatedly, and count the results."""

import errno
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from .disk import REFUSALS, Ending, Fault
from .workloads import Workload, clear_folder, read_contents

STAYING = (errno.ENOSPC, errno.EIO, errno.EROFS)
"""Errors that persist in every second trial: the disk stays full, broken or read-only."""
RETRY_S = 30.0


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
        Number of runs without faults. The first of two makes the inputs and loads the modules, so
        the second counts only the workload's own operations.
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
            self.before = read_contents(self.out) if self.out.exists() else {}
            self.found = [self.read()]
            self.sound = self.run()
        assert self.sound.status == 0, self.wrong or self.sound.said
        self.whole = read_contents(self.out)
        self.found.append(self.read())
        self._inputs = (inputs, read_contents(inputs))

    def clear(self) -> None:
        """Restore the disk to its first state."""
        clear_folder(self.folder)
        if self.work.before:
            self.disk.prepare(self.work.name, self.folder, self.work.out)

    def read(self) -> dict[str, object]:
        """Return what each other reader finds in the output."""
        return {} if self.work.reads is None else self.work.reads(self.out)

    def run(
        self,
        fault: Fault | None = None,
        *,
        kill_s: float | None = None,
        most_bytes: int | None = None,
    ) -> Ending:
        """Run the workload and return how it ended."""
        given = (self.work.name, self.folder, self.work.out, fault)
        try:
            return self.disk.run(*given, kill_s=kill_s, most_bytes=most_bytes)
        except AssertionError as e:
            self.wrong.append(str(e))
            return Ending(1, "a bug", 0, "", 0.0)

    def break_at(self, operations: range, *, quick: bool = False) -> None:
        """Let each of these operations fail with every error; ``quick``: with one, in turn."""
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
        """Whether the output is complete.

        It has the bytes of the run without faults, or about as many if these always differ.
        """
        found = read_contents(self.out) if self.out.exists() else {}
        # Killed between linking a file and removing its partial name, it has both names.
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
        """Assert that no incomplete output has its final name."""
        if not self.out.exists() or self.done:
            return
        assert self.work.pieces, f"{why}: half an output under its final name"
        for name, data in read_contents(self.out).items():
            unfinished = any(part.endswith(".partial") for part in Path(name).parts)
            wanted = (self.whole.get(name), self.before.get(name))
            assert unfinished or data in wanted, f"{why}: half of {name}"
        for who, found in self.read().items():
            assert found in [known[who] for known in self.found], f"{why}: {who} finds {found}"

    def judge(self, ending: Ending, why: str, *, may_stay: bool, again: bool) -> None:
        """Check the result of a fault; run again if ``again`` is set or partial files are left."""
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
        """Assert that a second run gives the same output as one without faults."""
        until = time.monotonic() + RETRY_S
        while True:
            ending = self.run()
            # The steps of a killed pipeline end soon after it, and then release the output.
            if "is being written by another" not in ending.said or time.monotonic() > until:
                break
            time.sleep(0.05)
        assert ending.status == 0, f"{why}: the second run says {ending.said}"
        assert self.done, f"{why}: the second run differs"
        assert [path.name for path in self.folder.iterdir()] == [self.work.out], why
        self.again += 1

    def add(self, cases: int, refused: int, right: int, again: int, wrong: list[str]) -> None:
        """Add the counts of trials in another process."""
        self.cases, self.refused = self.cases + cases, self.refused + refused
        self.right, self.again = self.right + right, self.again + again
        self.wrong += wrong

    def report(self, what: str, count: Callable[..., None]) -> None:
        """Add the counts to the table; assert that no trial failed and no input changed."""
        assert not self.wrong, "\n".join(self.wrong)
        folder, before = self._inputs
        assert read_contents(folder) == before, "an input was changed"
        cells = {"cases": self.cases, "refused": self.refused, "right": self.right}
        count(f"{what}: {self.work.name}", **cells, found=self.again)
