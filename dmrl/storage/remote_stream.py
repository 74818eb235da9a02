"""Read a remote file by byte ranges, fetching only the ranges that are read."""

import io
from collections.abc import Iterator, Sequence
from typing import Any

from dmrl.errors import StorageError
from dmrl.storage.system import translate_errors

PREFETCH_BYTES_MAX, PREFETCH_RANGES_MAX = 16 << 20, 64
"""Bytes and ranges that are prefetched at a time, in parallel."""
BUFFER_BYTES = 512
"""Buffer size of small reads. Larger ranges are fetched unbuffered."""
WHOLE_FILE_STEP_BYTES = 8 << 20
"""Bytes per request when a whole file is read."""

ByteRange = tuple[int, int]
"""Start and size of a range, bytes."""


class RangeReader(io.RawIOBase):
    """A file that is read by byte ranges.

    Parameters
    ----------
    system
        fsspec file system.
    name
        Name of the file in the file system.
    url
        Name of the file in errors.
    info
        Properties of the file: its size, bytes, and its version, to which all reads belong.
    """

    def __init__(self, system: Any, name: str, url: str, info: dict[str, Any]) -> None:
        super().__init__()
        self._system, self._name, self._url = system, name, url
        self.size = int(info.get("size") or 0)
        checks = getattr(system, "checks_version", False)
        self._more = {"version": info.get("ETag")} if checks else {}
        self._at = 0
        self._expected: list[ByteRange] = []
        self._prefetched: dict[ByteRange, bytes] = {}

    def expect_reads(self, places: Sequence[ByteRange]) -> None:
        """Register the next reads, in order, so that they are fetched in groups."""
        self._expected, self._prefetched = list(reversed(places)), {}

    def iter_blocks(self) -> Iterator[bytes]:
        """Yield the whole file, block by block."""
        for start in range(0, self.size, WHOLE_FILE_STEP_BYTES):
            yield self.fetch(start, WHOLE_FILE_STEP_BYTES)

    def should_fetch(self, start: int, size: int) -> bool:
        """Return whether a range should be fetched unbuffered: it is large, or registered."""
        place = start, size
        expected = bool(self._expected) and self._expected[-1] == place
        return size > BUFFER_BYTES or place in self._prefetched or expected

    def fetch(self, start: int, size: int) -> bytes:
        """Return the bytes of a range; fewer at the end of the file."""
        size = max(0, min(size, self.size - start))
        if not size:
            return b""
        place = start, size
        if place not in self._prefetched and self._expected and self._expected[-1] == place:
            self._prefetch()
        if place in self._prefetched:
            return self._prefetched.pop(place)
        with translate_errors(self._url):
            data = self._system.cat_file(self._name, start=start, end=start + size, **self._more)
        return self._check_length(data, size)

    def _check_length(self, data: bytes, size: int) -> bytes:
        """Return the bytes that a server sent for a range.

        Raises
        ------
        StorageError
            If their number is wrong.
        """
        if len(data) != size:
            raise StorageError(
                f"{self._url}: the server sent {len(data)} bytes instead of {size}. Copy the file, "
                "and check it"
            )
        return bytes(data)

    def _prefetch(self) -> None:
        """Fetch the next registered ranges in parallel."""
        group: list[ByteRange] = []
        while self._expected and len(group) < PREFETCH_RANGES_MAX:
            if (
                group
                and sum(size for _, size in group) + self._expected[-1][1] > PREFETCH_BYTES_MAX
            ):
                break
            group.append(self._expected.pop())
        starts, ends = [s for s, _ in group], [s + n for s, n in group]
        with translate_errors(self._url):
            found = self._system.cat_ranges(
                [self._name] * len(group), starts, ends, on_error="raise", **self._more
            )
        self._prefetched = {
            place: self._check_length(data, place[1])
            for place, data in zip(group, found, strict=True)
        }

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        """Move the stream position, and return it."""
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self.size}[whence]
        return self._at

    def readinto(self, buffer: Any, /) -> int:
        """Read into a buffer, and return the number of bytes."""
        data = self.fetch(self._at, len(buffer))
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)
