"""A disk that fails, or a process that dies, at one operation.

Python's own ways to the disk are replaced: what opens a file for writing, writes, syncs, links,
renames, makes a folder. Libraries that write in C (Arrow's tables) go by it; the kernel's limit on
the size of a file stops them too, see `small_files`.
"""

import errno
import io
import os
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pytest

CALLS = ("fsync", "link", "mkdir", "rename", "replace", "open")
REFUSALS = (errno.ENOSPC, errno.EIO, errno.EROFS, errno.EFBIG, errno.EINTR)
KILL = 0
"""In place of an errno: the process dies there."""


class Disk:
    """Fails the n-th operation below a folder.

    Parameters
    ----------
    folder
        Operations elsewhere go through.
    fail_at
        Number of the one that fails, from 0. None: all go through and are counted.
    error
        What the system says, an errno; or `KILL`.
    """

    def __init__(self, folder: Path, fail_at: int | None = None, error: int = KILL) -> None:
        self.folder, self.fail_at, self.error = folder, fail_at, error
        self.count = 0
        self.failed = ""
        self._patch = pytest.MonkeyPatch()

    def step(self, what: str, name: object) -> None:
        """One operation: it fails if it is its turn."""
        self.count += 1
        if self.count - 1 != self.fail_at:
            return
        if self.error == KILL:
            os.kill(os.getpid(), signal.SIGKILL)
        self.failed = f"{what} {name}: {errno.errorcode[self.error]}"
        raise OSError(self.error, os.strerror(self.error), str(name))

    def mine(self, file: object) -> Path | None:
        """The file, if it lies in the folder."""
        try:
            if isinstance(file, int):
                path = Path(f"/proc/self/fd/{file}").readlink()
            else:
                path = Path(os.fsdecode(file))  # type: ignore[arg-type]
        except (OSError, TypeError):
            return None
        return path if path.is_relative_to(self.folder) else None

    def __enter__(self) -> Self:
        for name in CALLS:
            self._patch.setattr(os, name, self._counted(name, getattr(os, name)))
        real_open = io.open
        disk = self

        class FileIO(io.FileIO):
            def __init__(self, file: Any, mode: str = "r", *rest: Any, **named: Any) -> None:
                writes = mode.strip("bt") != "r" and disk.mine(file) is not None
                if writes:
                    disk.step("open", file)
                super().__init__(file, mode, *rest, **named)
                self.watched = writes

            def write(self, data: Any) -> int:
                if self.watched:
                    disk.step("write", self.name)
                return super().write(data)

        def opened(
            file: Any, mode: str = "r", buffering: int = -1, *rest: Any, **named: Any
        ) -> Any:
            if mode.strip("bt") == "r" or disk.mine(file) is None:
                return real_open(file, mode, buffering, *rest, **named)
            raw = FileIO(file, mode.replace("b", "").replace("t", ""), named.get("closefd", True))
            both = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
            if "b" in mode:
                return both
            text = {k: named[k] for k in ("encoding", "errors", "newline") if k in named}
            text |= dict(zip(("encoding", "errors", "newline"), rest, strict=False))
            return io.TextIOWrapper(both, **text)

        self._patch.setattr(io, "FileIO", FileIO)
        self._patch.setattr(io, "open", opened)
        self._patch.setattr("builtins.open", opened)
        return self

    def _counted(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(path: Any, *rest: Any, **named: Any) -> Any:
            reads = name == "open" and not (rest and rest[0] & (os.O_WRONLY | os.O_RDWR))
            if not reads and self.mine(path) is not None:
                self.step(name, path)
            return real(path, *rest, **named)

        return call

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._patch.undo()


@contextmanager
def small_files(size: int) -> Iterator[None]:
    """The kernel lets no file of this process grow beyond ``size`` bytes: EFBIG, C or not."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    told = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, told)
