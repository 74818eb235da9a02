"""Hold many messages as arrays of offsets into the bytes that contain them."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]

MESSAGE_PREFIX_BYTES = 31
"""Size of a Message record up to its payload.

Contains opcode, length, channel id, sequence, log time and publish time.
"""
ROWS_AT_A_TIME = 10_000
"""Messages that are converted to Python objects at a time."""
MAX_TIME_NS = int(np.iinfo(np.int64).max)
"""End of the range of log times, nanoseconds. Serves as an open upper limit."""


def gather(data: Bytes | bytes, dtype: np.dtype[Any] | str, at: Ints) -> NDArray[Any]:
    """Gather values of a type from byte offsets, aligned or not.

    Parameters
    ----------
    data
        Bytes.
    dtype
        Type of a value. A structured type gathers adjacent fields at once.
    at
        (N,) offset of each value, at least its size before the end.
    """
    kind = np.dtype(dtype)
    return _view_every_byte(data, kind)[at].view(kind)


def scatter(data: Bytes, at: Ints, values: NDArray[Any]) -> None:
    """Write (N,) values to the byte offsets from which `gather` reads them."""
    _view_every_byte(data, values.dtype)[at] = values.view(_to_void_dtype(values.dtype))


def _view_every_byte(data: Bytes | bytes, kind: np.dtype[Any]) -> NDArray[Any]:
    """Return the data as overlapping values, one starting at every byte."""
    return np.ndarray((max(len(data) - kind.itemsize + 1, 0),), _to_void_dtype(kind), data, 0, (1,))


def _to_void_dtype(kind: np.dtype[Any]) -> np.dtype[Any]:
    """Return a void type of the same size. NumPy would copy a structured type field by field."""
    return np.dtype(f"V{kind.itemsize}")


@dataclass(frozen=True, slots=True)
class MessageBatch:
    """Messages whose records are in one byte array.

    Parameters
    ----------
    data
        The bytes.
    channel, time_ns, publish_ns
        (N,) channel id, log time and publish time of each message, nanoseconds.
    start, end
        (N,) range of each payload in ``data``. The prefix of its record is directly before it.
    """

    data: Bytes
    channel: Ints
    time_ns: Ints
    publish_ns: Ints
    start: Ints
    end: Ints

    def __len__(self) -> int:
        return len(self.start)

    def take(self, rows: Ints | NDArray[np.bool_] | slice) -> "MessageBatch":
        """Return a batch of these rows over the same bytes."""
        return MessageBatch(self.data, *(column[rows] for column in self._columns))

    @property
    def _columns(self) -> tuple[Ints, ...]:
        return self.channel, self.time_ns, self.publish_ns, self.start, self.end

    @property
    def time_span_ns(self) -> tuple[int, int]:
        """First and last log time of a batch that is not empty, nanoseconds."""
        return int(self.time_ns.min()), int(self.time_ns.max())

    @property
    def has_valid_times(self) -> NDArray[np.bool_]:
        """(N,) whether the times fit signed 64 bits, and log times are below `MAX_TIME_NS`."""
        return np.asarray(
            (self.time_ns >= 0) & (self.publish_ns >= 0) & (self.time_ns < MAX_TIME_NS)
        )

    def list_channel_ids(self) -> list[int]:
        """Return the ids of the channels that have messages in this batch."""
        found: list[int] = np.flatnonzero(np.bincount(self.channel)).tolist()
        return found

    def select_channels(self, channels: Collection[int]) -> "MessageBatch":
        """Return a batch of some channels over the same bytes."""
        return self.take(self.mask_channels(channels))

    def mask_channels(self, channels: Collection[int]) -> NDArray[np.bool_]:
        """Return an (N,) mask of the messages of some channels."""
        chosen = np.zeros(max(max(channels, default=0), int(self.channel.max(initial=0))) + 1, bool)
        chosen[list(channels)] = True
        return np.asarray(chosen[self.channel])

    def iter_rows(self) -> Iterator[tuple[int, int, int, bytes]]:
        """Yield channel id, log time, publish time and payload of every message."""
        view = self.data.data
        for first in range(0, len(self), ROWS_AT_A_TIME):
            part = slice(first, first + ROWS_AT_A_TIME)
            rows = zip(*(column[part].tolist() for column in self._columns), strict=True)
            for number, time_ns, publish_ns, start, end in rows:
                yield number, time_ns, publish_ns, bytes(view[start:end])

    def compact(self) -> "MessageBatch":
        """Copy the batch without bytes between its records."""
        records, at = self.copy_records()
        return replace(self, data=records, start=at[:-1] + MESSAGE_PREFIX_BYTES, end=at[1:])

    def copy_records(self) -> tuple[Bytes, Ints]:
        """Copy the records into one array; return it and the (N + 1,) offsets of their bounds."""
        first = self.start - MESSAGE_PREFIX_BYTES
        at = np.concatenate([[0], np.cumsum(self.end - first)])
        # Adjacent records are copied together.
        breaks = np.flatnonzero(first[1:] != self.end[:-1]) + 1
        starts = np.concatenate([[0], breaks])[: len(self)]
        ends = np.concatenate([breaks, [len(self)]])[: len(self)] - 1
        runs = zip(first[starts].tolist(), self.end[ends].tolist(), strict=True)
        view = self.data.data
        return np.frombuffer(bytearray().join(view[a:b] for a, b in runs), np.uint8), at

    def sort_by_time(self, last: Collection[int] = ()) -> "MessageBatch":
        """Return the batch sorted by log time.

        The sort is stable, but at equal times messages of the channels ``last`` come last.
        """
        step_ns = np.diff(self.time_ns)
        if len(self) < 2 or step_ns.min() > 0 or (not last and step_ns.min() >= 0):
            return self
        if not last:
            return self.take(np.argsort(self.time_ns, kind="stable"))
        return self.take(np.lexsort((self.mask_channels(last), self.time_ns)))


def concatenate(first: MessageBatch | None, second: MessageBatch) -> MessageBatch:
    """Join two batches over one byte array, keeping all bytes."""
    return second if first is None or not len(first) else _join([first, second])


def concatenate_all(batches: list[MessageBatch]) -> MessageBatch:
    """Join batches over one byte array; leave out unused bytes where they are the larger part.

    The list is emptied, so that the bytes of each batch are freed when they are copied.
    """
    for k, batch in enumerate(batches):
        if 2 * int((batch.end - batch.start).sum()) < len(batch.data):
            batches[k] = batch.compact()
    return _join(batches)


def _join(parts: list[MessageBatch]) -> MessageBatch:
    shift = np.cumsum([0, *(len(part.data) for part in parts)])
    channel = np.concatenate([part.channel for part in parts])
    time_ns = np.concatenate([part.time_ns for part in parts])
    publish_ns = np.concatenate([part.publish_ns for part in parts])
    start = np.concatenate([part.start + k for part, k in zip(parts, shift, strict=False)])
    end = np.concatenate([part.end + k for part, k in zip(parts, shift, strict=False)])
    data = np.empty(shift[-1], np.uint8)
    while parts:
        part = parts.pop()
        data[shift[len(parts)] : shift[len(parts) + 1]] = part.data
    return MessageBatch(data, channel, time_ns, publish_ns, start, end)


_NO_INTS: Ints = np.empty(0, np.int64)
EMPTY_BATCH = MessageBatch(np.empty(0, np.uint8), _NO_INTS, _NO_INTS, _NO_INTS, _NO_INTS, _NO_INTS)
