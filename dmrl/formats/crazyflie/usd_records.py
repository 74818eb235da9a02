"""Packed records of several event types, each type of its own size, gathered with NumPy.

A record is little endian: u16 id of its event, time, values. `usd_log` reads the event types.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Rows = NDArray[np.void]


@dataclass(frozen=True)
class EventType:
    """One type of record: its id, name, (name, ``struct`` letter) of each variable, time type."""

    number: int
    name: str
    variables: tuple[tuple[str, str], ...]
    time: str

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """Packed type of a whole record."""
        values = [(f"v{k}", f"<{code}") for k, (_, code) in enumerate(self.variables)]
        return np.dtype([("id", "<u2"), ("time", self.time), *values])


def gather_records(
    data: bytes, body: int, end: int, events: list[EventType]
) -> tuple[dict[str, Rows], int]:
    """Return the (N,) records of each event by name, and the end of the last whole record.

    Each record begins where the one before it ends. A walk in Python takes 3 to 4 times as long,
    so all possible starts are listed at once, and only the wrong ones are left to skip.

    Parameters
    ----------
    data
        The file.
    body, end
        Offsets at which its records begin and end.
    events
        Event types, with different numbers and names.
    """
    records = np.frombuffer(data, np.uint8)[body:end]
    starts = _list_possible_starts(records, events)
    ids = records[starts] | records[starts + 1].astype(np.uint16) << 8
    sizes = np.zeros(1 << 16, np.int64)
    sizes[[event.number for event in events]] = [event.dtype.itemsize for event in events]
    starts, size = _follow_chain(starts, starts + sizes[ids], len(records))
    ids = records[starts] | records[starts + 1].astype(np.uint16) << 8
    return {e.name: _gather(records, starts[ids == e.number], e.dtype) for e in events}, body + size


def _list_possible_starts(records: NDArray[np.uint8], events: list[EventType]) -> Ints:
    """Return the offsets with the id of an event to which the size of another record leads."""
    count = max(len(records) - 1, 0)
    is_id = np.zeros(count, bool)
    is_next = np.zeros(count + max(event.dtype.itemsize for event in events), bool)
    is_next[0] = True
    for event in events:
        hits = (records[:count] == event.number & 0xFF) & (records[1:] == event.number >> 8)
        is_id |= hits
        is_next[event.dtype.itemsize :][:count] |= hits
    return np.flatnonzero(is_id & is_next[:count])


def _follow_chain(starts: Ints, ends: Ints, length: int) -> tuple[Ints, int]:
    """Return the starts that follow one another from offset 0, and the end of the last record."""
    breaks = np.append(np.flatnonzero(ends[:-1] != starts[1:]), len(starts) - 1)
    kept, first, end = [starts[:0]], 0, 0
    while first < len(starts) and starts[first] == end:
        last = breaks[np.searchsorted(breaks, first)]
        kept.append(starts[first : last + 1])
        first, end = int(np.searchsorted(starts, ends[last])), int(ends[last])
    chain = np.concatenate(kept)
    return (chain, end) if end <= length else (chain[:-1], int(chain[-1]))  # the last one is cut


def _gather(records: NDArray[np.uint8], starts: Ints, kind: np.dtype[np.void]) -> Rows:
    # One take from a view with a stride of one byte; with fields, each would be copied alone.
    count = max(len(records) - kind.itemsize + 1, 0)
    view = np.ndarray((count,), np.dtype((np.void, kind.itemsize)), records, 0, (1,))
    return view[starts].view(kind)
