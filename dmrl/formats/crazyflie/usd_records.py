"""Records of several kinds, each of its own size, one right after the other.

Little endian and packed: u16 id of the kind, time, values. `cfusdlog` says which kinds there are.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

PIECE = 1 << 19
"""Places looked at in one go."""
SAMPLE = 32
"""Records that say which events come together."""

Bytes = NDArray[np.uint8]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Rows = NDArray[np.void]


@dataclass(frozen=True)
class Event:
    """One type of record, as the header describes it.

    Parameters
    ----------
    number
        What its records begin with.
    name
        Such as "fixedFrequency".
    variables
        Name and letter of each.
    time
        NumPy type of the time.
    """

    number: int
    name: str
    variables: tuple[tuple[str, str], ...]
    time: str

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """A whole record, packed."""
        values = [(f"v{k}", f"<{code}") for k, (_, code) in enumerate(self.variables)]
        return np.dtype([("id", "<u2"), ("time", self.time), *values])


Group = tuple[Event, ...]


def records_of(
    data: bytes, body: int, end: int, events: list[Event]
) -> tuple[dict[str, Rows], int]:
    """Records of each event, and where the last whole one ends.

    Parameters
    ----------
    data
        The file.
    body, end
        Where its records begin and end.
    events
        What there is, numbers and names all different.

    Returns
    -------
    rows : dict[str, Rows]
        (N,) records of each event, by its name.
    end : int
        Where the last whole record ends; less than ``end`` where a number is unknown.
    """
    records = np.frombuffer(data, np.uint8)[body:end]
    groups = _together(data, body, events)
    rows, size = _rows_of(records, groups)
    # What the first records promise, all must keep.
    followers = [event for group in groups for event in group[1:]]
    if followers and (
        body + size < end or any((rows[e.name]["id"] != e.number).any() for e in followers)
    ):
        rows, size = _rows_of(records, [(event,) for event in events])
    return rows, body + size


def _together(data: bytes, at: int, events: list[Event]) -> list[Group]:
    """Events that always follow one another, such as a gyroscope and an accelerometer.

    As the first records have it. What is always together is found and gathered as one.
    """
    by_number = {event.number: event for event in events}
    order = _first_numbers(data, at, {event.number: event.dtype.itemsize for event in events})
    after = _always_next(order)
    groups = []
    for number in [event.number for event in events if event.number not in after.values()]:
        group = [number]
        while group[-1] in after:
            group.append(after[group[-1]])
        groups.append(tuple(by_number[number] for number in group))
    return groups


def _first_numbers(data: bytes, at: int, sizes: dict[int, int]) -> list[int]:
    """Numbers of the first records; fewer where one is not known."""
    order: list[int] = []
    while len(order) < SAMPLE and (number := int.from_bytes(data[at : at + 2], "little")) in sizes:
        order.append(number)
        at += sizes[number]
    return order


def _always_next(order: list[int]) -> dict[int, int]:
    """Number to the one that always comes next, and comes after no other."""
    pairs = set(pairwise(order))
    firsts, seconds = [a for a, _ in pairs], [b for _, b in pairs]
    return {
        a: b
        for a, b in pairs
        if firsts.count(a) == 1 == seconds.count(b)
        # Else a chain could close to a ring, which has no first event.
        and b != order[0]
        # What was seen a few times only may be followed by another later.
        and order.count(a) >= SAMPLE // 8
    }


def _rows_of(data: Bytes, groups: list[Group]) -> tuple[dict[str, Rows], int]:
    """Records of each event, and where the last whole group ends.

    Records differ in size, so each begins where the one before it ends. To walk them one by
    one would take most of the time. Instead, all places are listed that hold the id of an
    event and to which the size of another leads; but for chance they are the records, so that
    following the chain means to jump from one chance hit to the next.
    """
    numbers = [group[0].number for group in groups]
    sizes = [sum(event.dtype.itemsize for event in group) for group in groups]
    # Records of even sizes stand at even places: half as many to look at.
    unit = 1 if any(size % 2 for size in sizes) else 2
    at = _places(data, numbers, [size // unit for size in sizes], unit)
    # The low byte of the ids tells the events apart as a rule, so that a small table will do.
    key: NDArray[np.unsignedinteger] = data[::unit][at]
    mask = 0xFF
    if len({number & mask for number in numbers}) < len(numbers):
        key, mask = key | data[1::unit][at] * np.uint16(256), 0xFFFF
    steps = np.zeros(mask + 1, np.int64)
    for number, size in zip(numbers, sizes, strict=True):
        steps[number & mask] = size // unit
    # All keys are in the table; "clip" is faster than to check that.
    keep, end = _chain(at, at + steps.take(key, mode="clip"), len(data) // unit)
    if not keep.all():
        at, key = at[keep], key[keep]
    rows: dict[str, Rows] = {}
    for group, number, size in zip(groups, numbers, sizes, strict=True):
        own = at[np.flatnonzero(key == number & mask)]
        rows |= _of_each(group, _gather(data, own, size, unit))
    return rows, end * unit


def _places(data: Bytes, numbers: list[int], steps: list[int], unit: int) -> Ints:
    """Where one of the ids stands, first or where a step from another leads, in units of bytes."""
    longest = min(PIECE, len(data) // unit)
    found, hit = np.empty((2, longest), bool)
    spare = np.empty(longest * (unit == 1), bool)
    reached = np.zeros(longest + max(steps), bool)
    reached[0] = True
    parts: list[Ints] = []
    for start in range(0, len(data) - 1, PIECE * unit):
        piece = data[start : start + PIECE * unit + 2 - unit]
        count = (len(piece) - 2 + unit) // unit
        if unit == 2:
            piece = np.require(piece[: 2 * count].view("<u2"), requirements="A")
        for k, (number, step) in enumerate(zip(numbers, steps, strict=True)):
            out = (hit if k else found)[:count]
            _hits(piece, number, out, spare[:count])
            reached[step : step + count] |= out
            if k:
                found |= hit
        found &= reached[:longest]
        parts.append(np.flatnonzero(found[:count]) + start // unit)
        reached[: max(steps)] = reached[longest:]
        reached[max(steps) :] = False
    return parts[0] if len(parts) == 1 else np.concatenate([np.empty(0, np.int64), *parts])


def _hits(piece: NDArray[np.unsignedinteger], number: int, out: Bools, spare: Bools) -> None:
    """Where an id stands in a piece of words, or of bytes of which any two may be a word."""
    if piece.itemsize == 2:
        np.equal(piece, number, out=out)
    else:
        np.equal(piece[:-1], number & 0xFF, out=out)
        np.equal(piece[1:], number >> 8, out=spare)
        np.logical_and(out, spare, out=out)


def _chain(at: Ints, target: Ints, end: int) -> tuple[Bools, int]:
    """Which places are records, each where the one before it ends, and where the last ends."""
    keep = np.zeros(len(at), bool)
    if not len(at) or at[0]:
        return keep, 0
    stops = np.append(np.flatnonzero(target[:-1] != at[1:]), len(at) - 1)
    if len(stops) == 1 and target[-1] <= end:
        return ~keep, int(target[-1])
    goals = target[stops]
    onward = np.searchsorted(at, goals)
    reached = at[np.minimum(onward, len(at) - 1)] == goals
    following = np.searchsorted(stops, onward)
    rows = np.stack([stops + 1, goals, onward, reached, following], axis=1).tolist()
    first, k = 0, 0
    while True:
        last, goal, then, found, following_k = rows[k]
        keep[first:last] = True
        if goal > end:  # its last record is cut
            keep[last - 1] = False
            return keep, int(at[last - 1])
        if not found:
            return keep, goal
        first, k = then, following_k


def _gather(data: Bytes, at: Ints, size: int, unit: int) -> NDArray[np.void]:
    # A view with a stride of one unit gathers unaligned records in one go; as bytes without
    # fields, since those would be copied one by one.
    count = max((len(data) - size) // unit + 1, 0)
    return np.ndarray((count,), np.dtype((np.void, size)), data, 0, (unit,))[at]


def _of_each(group: Group, rows: Rows) -> dict[str, Rows]:
    """Records of the events of a group, by name, out of records that hold all of them."""
    offset, each = 0, {}
    for event in group:
        each[event.name] = np.ndarray(len(rows), event.dtype, rows, offset, rows.strides)
        offset += event.dtype.itemsize
    return each
