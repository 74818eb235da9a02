"""Open a recording once for several reads, each with a position of its own, and hash it.

Bytes that are read after a file was hashed must be those that were hashed: a disk, a cable or a
memory may flip a bit in one of two reads.
"""

import hashlib
import io
import os
import zlib
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dmrl.errors import RecordingError
from dmrl.storage.remote import RemotePath

BLOCK_BYTES = 1 << 16
"""Bytes that have a checksum each, so that a later read can be compared."""

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


FileIdentity = tuple[int, int, int, int]
_SUMS: dict[Path, tuple[FileIdentity, "array[int]"]] = {}
"""Checksums of the blocks of each file that was hashed, and which file it was."""


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal; later reads of `open_raw` are compared with it.

    Other readers do not compare. So a file that is no recording is read twice.

    Raises
    ------
    RecordingError
        If two reads differ.
    """
    digest, sums = hashlib.sha256(), array("L")
    with io.FileIO(_SHARED.get(path, path), closefd=path not in _SHARED) as file:
        identity, at = _identify(file.fileno()), 0
        while block := os.pread(file.fileno(), BLOCK_BYTES, at):
            digest.update(block)
            sums.append(zlib.crc32(block))
            at += len(block)
    _SUMS[path] = identity, sums
    if path.suffix != ".mcap":
        with open_raw(path) as again:
            while again.read(1 << 20):
                pass
        del _SUMS[path]
    return digest.hexdigest()


def _identify(descriptor: int) -> FileIdentity:
    found = os.fstat(descriptor)
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


def open_raw(path: Path) -> io.RawIOBase:
    """Open a file for reading: its shared descriptor, if there is one."""
    shared = _SHARED.get(path)
    if shared is None and path not in _SUMS:
        return io.FileIO(path, "r")
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC) if shared is None else os.dup(shared)
    identity, sums = _SUMS.get(path, (None, None))
    return _Reader(path, descriptor, sums if identity == _identify(descriptor) else None)


class _Reader(io.RawIOBase):
    """Read an open file from a position of its own; it may outlive the block that shares it.

    Parameters
    ----------
    path
        Its name in errors.
    descriptor
        The open file, which is closed with the reader.
    sums
        Checksum of each block; None: not known.
    """

    def __init__(self, path: Path, descriptor: int, sums: "array[int] | None") -> None:
        self._path, self._descriptor, self._sums = path, descriptor, sums
        self._position, self._block, self._data = 0, -1, b""

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

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        size = os.fstat(self._descriptor).st_size if whence == io.SEEK_END else 0
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: size}[whence]
        self._position = start + offset
        return self._position

    def readinto(self, buffer: "bytearray | memoryview", /) -> int:  # type: ignore[override]
        if self._sums is None:
            count = os.preadv(self._descriptor, [buffer], self._position)
        else:
            view, count = memoryview(buffer).cast("B"), 0
            while count < len(view):
                number, start = divmod(self._position + count, BLOCK_BYTES)
                data = self._read_block(number)[start : start + len(view) - count]
                if not data:
                    break
                view[count : count + len(data)] = data
                count += len(data)
        self._position += count
        return count

    def _read_block(self, number: int) -> bytes:
        """Return a block as it was hashed.

        Raises
        ------
        RecordingError
            If it is read otherwise, also a second time.
        """
        assert self._sums is not None
        if number == self._block or number >= len(self._sums):
            return self._data if number == self._block else b""
        for _ in range(2):
            data = os.pread(self._descriptor, BLOCK_BYTES, number * BLOCK_BYTES)
            if zlib.crc32(data) == self._sums[number]:
                self._block, self._data = number, data
                return data
        raise RecordingError(
            f"{self._path}: two reads of byte {number * BLOCK_BYTES} and later differ. Check the "
            "disk, and run it again"
        )
