"""Open a recording once for several reads, each with a position of its own."""

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dmrl.storage.remote import RemotePath

_SHARED: dict[Path, int] = {}
"""Descriptors of the recordings that `share_file` holds open in this process."""


@contextmanager
def share_file(path: Path) -> Iterator[None]:
    """Serve all reads of a recording in the block from one open file.

    A file in a bucket, or one that cannot be opened, is left to the reads: each reports its error.

    Parameters
    ----------
    path
        The recording.
    """
    if path in _SHARED or isinstance(path, RemotePath) or not path.is_file():
        yield
        return
    try:
        _SHARED[path] = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        yield
        return
    try:
        yield
    finally:
        os.close(_SHARED.pop(path))


def open_raw(path: Path) -> io.RawIOBase:
    """Open a file for reading: its shared descriptor, if there is one."""
    shared = _SHARED.get(path)
    return io.FileIO(path, "r") if shared is None else _SharedReader(shared)


class _SharedReader(io.RawIOBase):
    """Read an open file from a position of its own; it may outlive the block that shares it."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = os.dup(descriptor)
        self._position = 0

    def close(self) -> None:
        if not self.closed:
            os.close(self._descriptor)
        super().close()

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._descriptor

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        size = os.fstat(self._descriptor).st_size if whence == io.SEEK_END else 0
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: size}[whence]
        self._position = start + offset
        return self._position

    def readinto(self, buffer: "bytearray | memoryview", /) -> int:  # type: ignore[override]
        count = os.preadv(self._descriptor, [buffer], self._position)
        self._position += count
        return count
