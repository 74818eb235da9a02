"""Run commands on a disk that can fail, in children of one process that has all modules loaded.

The process is started once, with disk.c preloaded, and forks for each command. So a trial takes no
longer than the command's own work. Processes that a command starts are on the same disk.
"""

import ctypes
import errno
import json
import mmap
import os
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

REFUSALS = (errno.ENOSPC, errno.EIO, errno.EROFS, errno.EFBIG, errno.EINTR)
KILL = 0
"""Stands for an errno: the process is killed at that operation."""
TESTS = Path(__file__).parents[1]
START = """
import sys, types
tests = types.ModuleType("tests")
tests.__path__ = [sys.argv[1]]
sys.modules["tests"] = tests
from tests.faults.server import main
main(sys.argv[2])
"""


class Orders(ctypes.Structure):
    """The struct of disk.c, in memory that all processes share."""

    _fields_ = (
        ("count", ctypes.c_int64),
        ("fail_at", ctypes.c_int64),
        ("error", ctypes.c_int32),
        ("stays", ctypes.c_int32),
        ("folder", ctypes.c_char * 1024),
        ("failed", ctypes.c_char * 1024),
    )

    def order(self, folder: Path, fault: "Fault | None") -> None:
        """Start to count operations below a folder, and let one fail."""
        self.count, self.failed = 0, b""
        self.fail_at = -1 if fault is None else fault.at
        self.error = 0 if fault is None else fault.error
        self.stays = fault is not None and fault.stays
        self.folder = os.fsencode(folder) + b"/"

    def rest(self) -> None:
        """Stop counting operations and let none fail."""
        self.folder, self.fail_at = b"", -1


@dataclass(frozen=True, slots=True)
class Fault:
    """An operation that fails, and how.

    Parameters
    ----------
    at
        Number of the operation, from 0.
    error
        The errno that the operation returns, or `KILL`.
    stays
        Whether all later operations fail too.
    """

    at: int
    error: int
    stays: bool = False

    def __str__(self) -> str:
        name = errno.errorcode.get(self.error, "kill -9")
        return f"operation {self.at}: {name}{', and from there on' if self.stays else ''}"


@dataclass(frozen=True, slots=True)
class Ending:
    """The end of a command: its exit status, or minus the signal's number, and last error line.

    ``operations`` counts those on the disk, ``failed`` names the one that failed.
    """

    status: int
    said: str
    operations: int
    failed: str
    seconds: float


class Disk:
    """A process that runs commands, and lets operations below a folder fail.

    Parameters
    ----------
    folder
        Folder for the inputs, a log, and the compiled disk.c.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.inputs = folder, folder / "inputs"
        library = folder / "disk.so"
        compiler = shutil.which("cc") or shutil.which("gcc") or "cc"
        source = Path(__file__).with_name("disk.c")
        line = [compiler, "-O1", "-shared", "-fPIC", "-o", str(library), str(source), "-ldl"]
        subprocess.run(line, check=True)
        orders = folder / "orders"
        orders.write_bytes(bytes(ctypes.sizeof(Orders)))
        with orders.open("r+b") as stream:
            self._map = mmap.mmap(stream.fileno(), 0)
        self.orders = Orders.from_buffer(self._map)
        self.orders.fail_at = -1
        told = {"LD_PRELOAD": str(library), "DMRL_TEST_DISK": str(orders), "OMP_NUM_THREADS": "1"}
        told |= {"CUDA_VISIBLE_DEVICES": "", "TERM": "dumb"}
        self.log = (folder / "log").open("wb")
        self._process = subprocess.Popen(
            [sys.executable, "-c", START, str(TESTS), str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.log,
            env=os.environ | told,
        )

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
        """Run a workload of `workloads.WORKLOADS` in a process of its own.

        Parameters
        ----------
        work
            Name of the workload.
        folder
            The disk that fails; the output goes there.
        out
            Name of the output.
        fault
            The operation that fails. None: no operation fails.
        kill_s
            Kill the process after this time, seconds.
        most_bytes
            The kernel lets no file grow beyond this size, bytes.

        Raises
        ------
        AssertionError
            If it ends with a traceback, prints more than one line of error, or hangs.
        """
        given = {"work": work, "out": str(folder / out), "most_bytes": most_bytes}
        self.orders.order(folder, fault)
        answer = self.ask("server:run_work", kill_s=kill_s, **given)
        self.orders.rest()
        failed = os.fsdecode(self.orders.failed).replace(str(folder), "")
        assert "fault" not in answer, f"{work}, {fault}: {failed}: {answer['fault']}"
        status, said = answer["value"] or (-signal.SIGKILL, "")
        return Ending(status, said, self.orders.count, failed, answer["seconds"])

    def prepare(self, work: str, folder: Path, out: str) -> None:
        """Make what a workload needs before it starts."""
        self.call("server:prepare_work", work=work, out=str(folder / out))

    def call(self, call: str, **given: Any) -> Any:
        """Call a function ``module:name`` of these tests in a child, and return its result.

        Raises
        ------
        AssertionError
            If it raises or hangs.
        """
        answer = self.ask(call, **given)
        assert "fault" not in answer, answer["fault"]
        return answer["value"]

    def ask(self, call: str, *, kill_s: float | None = None, **given: Any) -> dict[str, Any]:
        """Call a function ``module:name`` of these tests in a child; return the child's answer.

        It has the result as "value", or the traceback as "fault".
        """
        told = {"call": call, "kill_s": kill_s, "given": given}
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(told).encode() + b"\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        assert line, f"the process has died, see {self.log.name}"
        answer: dict[str, Any] = json.loads(line)
        self.rss_kb: int = answer["rss_kb"]
        return answer

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()
        self.log.close()


@contextmanager
def limit_file_size(size: int | None) -> Iterator[None]:
    """Limit the size of every file that this process writes, bytes; beyond it, EFBIG."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    if size is not None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
