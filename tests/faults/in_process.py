"""Inject faults into workloads one after the other, in a single child process of server.py."""

import mmap
import os
import signal
import time
from pathlib import Path
from typing import Any

from .disk import Ending, Fault, Orders, limit_file_size
from .ending import run_to_end
from .fault_trials import FaultTrials
from .inputs import Inputs
from .workloads import find_workload

HANG_S = 300


class InProcess:
    """Run workloads in this process, on the disk of disk.c.

    Parameters
    ----------
    inputs
        Inputs of the workloads.
    """

    def __init__(self, inputs: Inputs) -> None:
        self.inputs = inputs
        with Path(os.environ["DMRL_TEST_DISK"]).open("r+b") as stream:
            self._map = mmap.mmap(stream.fileno(), 0)
        self.orders = Orders.from_buffer(self._map)

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
        """Run a workload as `Disk.run` does, without killing it."""
        assert kill_s is None
        begun_s = time.monotonic()
        signal.alarm(HANG_S)  # ends this process
        run = find_workload(work).run
        self.orders.order(folder, fault)
        try:
            with limit_file_size(most_bytes):
                status, output = run_to_end(lambda: run(self.inputs, folder / out))
        except AssertionError as e:
            raise AssertionError(f"{work}, {fault}: {e}") from e
        finally:
            self.orders.rest()
        failed = os.fsdecode(self.orders.failed).replace(str(folder), "")
        return Ending(status, output, self.orders.count, failed, time.monotonic() - begun_s)

    def prepare(self, work: str, folder: Path, out: str) -> None:
        """Make what a workload needs before it starts."""
        before = find_workload(work).before
        if before is not None:
            before(self.inputs, folder / out)


def break_at(
    inputs: Inputs, work: str, folder: str, first: int, last: int, quick: bool
) -> dict[str, Any]:
    """Let each of these operations of a workload fail; return the counts for `FaultTrials.add`."""
    trials = FaultTrials(
        find_workload(work), InProcess(inputs), Path(folder), inputs.folder, times=1
    )
    trials.break_at(range(first, last), quick=quick)
    return {
        "cases": trials.cases,
        "refused": trials.refused,
        "right": trials.right,
        "again": trials.again,
        "wrong": trials.wrong,
    }
