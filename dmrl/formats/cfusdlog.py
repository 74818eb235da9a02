"""Micro-SD logs of the Crazyflie (cfusdlog, versions 1 and 2).

Little endian: ``0xBC``, u16 version, u16 number of event types; per type u16 id, name, 0,
u16 number of variables, each ``group.name(T)`` and 0, T a letter of ``struct``. Then records:
u16 id, time since boot (version 1: u32 milliseconds, version 2: u64 microseconds), the
values. The last four bytes are the CRC-32 of all before. A log that was cut short, by a flat
battery as a rule, has no CRC: all its whole records are read, with a warning.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.errors import SourceError
from dmrl.formats import crazyflie_log
from dmrl.formats.counters import unwrap
from dmrl.formats.flight_sample import in_order
from dmrl.formats.log_block import Block
from dmrl.formats.sample import Content, Format, Options
from dmrl.progress import say

MAGIC = 0xBC
VERSIONS = {1: ("<u4", 1_000_000), 2: ("<u8", 1_000)}
"""Type and nanoseconds of a time, by version."""
CODES = "bBhHiIef"
SAMPLE = 32
"""Records that say which events come together."""
TYPES_MAX = 250
CRC_BYTES = 4
PIECE = 1 << 19
"""Places looked at in one go: they stay in the cache."""

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


@dataclass(frozen=True, slots=True)
class Log:
    """What a file holds.

    Parameters
    ----------
    version
        Of the format.
    blocks
        One for each event type that has records.
    warnings
        What is wrong with the file, a line each.
    """

    version: int
    blocks: tuple[Block, ...]
    warnings: tuple[str, ...]


def recognises(source: Path) -> bool:
    """Whether a file begins like such a log, or a folder holds one that does."""
    if source.is_dir():
        return any(recognises(path) for path in source.iterdir() if path.is_file())
    with source.open("rb") as stream:
        head = stream.read(5)
    if len(head) < 5 or head[0] != MAGIC:
        return False
    version, types = struct.unpack_from("<HH", head, 1)
    return version in VERSIONS and 0 < types <= TYPES_MAX


def decode(data: bytes, what: object = "the log") -> Log:
    """Records of a log, as one array per variable.

    Parameters
    ----------
    data
        The file.
    what
        Its name, for errors.

    Raises
    ------
    SourceError
        If it is no such log, or ends inside its header.
    """
    if not data:
        raise SourceError(f"{what} is empty: the card was full, or removed. Name another log")
    version, events, body = _header(data, what)
    sealed = len(data) - body >= CRC_BYTES and zlib.crc32(
        memoryview(data)[:-CRC_BYTES]
    ) == int.from_bytes(data[-CRC_BYTES:], "little")
    stop = len(data) - CRC_BYTES * sealed
    rows, end = _records(data, body, stop, events)
    warnings = [] if sealed else [f"{what}: no valid CRC at its end; cut short, or damaged"]
    if left := stop - end:
        warnings.append(f"{what}: {left} bytes from byte {end} on are no whole record; left out")
    scale = VERSIONS[version][1]
    blocks = [_block(e, rows[e.name], scale) for e in events if len(rows[e.name])]
    return Log(version, tuple(blocks), tuple(warnings))


def _header(data: bytes, what: object) -> tuple[int, list[Event], int]:
    """Version, event types, and where the records begin."""
    try:
        magic, version, types = struct.unpack_from("<BHH", data)
        if magic != MAGIC or version not in VERSIONS or not 0 < types <= TYPES_MAX:
            raise SourceError(f"{what} is no micro-SD log of version 1 or 2. Name another file")
        at, events = 5, []
        for _ in range(types):
            (number,) = struct.unpack_from("<H", data, at)
            name, at = _text(data, at + 2)
            (count,) = struct.unpack_from("<H", data, at)
            at += 2
            variables = []
            for _ in range(count):
                text, at = _text(data, at)
                variables.append((text[:-3], text[-2:-1]))
            events.append(Event(number, name, tuple(variables), VERSIONS[version][0]))
    except (struct.error, ValueError) as e:
        raise SourceError(
            f"{what} is damaged in its header, or ends there: {e}. Name another log"
        ) from None
    _check(events, what)
    return version, events, at


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at)
    return data[at:end].decode("ascii"), end + 1


def _check(events: list[Event], what: object) -> None:
    for event in events:
        names = [name for name, _ in event.variables]
        if not all(
            name.isprintable() and name and code and code in CODES for name, code in event.variables
        ) or not (event.name.isprintable() and event.name and len(set(names)) == len(names)):
            raise SourceError(
                f"{what}: event {event.name!r} has variables without name or known type in its "
                "header. Name another log"
            )
    for kind, values in (("id", [e.number for e in events]), ("name", [e.name for e in events])):
        if len(set(values)) < len(values):
            raise SourceError(f"{what}: two events have the same {kind}. Name another log")


def _records(
    data: bytes, body: int, end: int, events: list[Event]
) -> tuple[dict[str, Rows], int]:
    """Records of each event, by its name, and where the last whole one ends."""
    records = np.frombuffer(data, np.uint8)[body:end]
    groups = _together(data, body, events)
    rows, size = _rows_of(records, groups)
    followers = [event for group in groups for event in group[1:]]
    if followers and (
        body + size < end or any((rows[e.name]["id"] != e.number).any() for e in followers)
    ):
        rows, size = _rows_of(records, [(event,) for event in events])
    return rows, body + size


def _together(data: bytes, at: int, events: list[Event]) -> list[Group]:
    """Events of which one always follows the other, such as a gyroscope and an accelerometer.

    As the first records have it. What is always together is found and gathered as one.
    """
    by_number = {event.number: event for event in events}
    order: list[int] = []
    while len(order) < SAMPLE and (
        event := by_number.get(int.from_bytes(data[at : at + 2], "little"))
    ):
        order.append(event.number)
        at += event.dtype.itemsize
    firsts, seconds = Counter(order[:-1]), Counter(order[1:])
    after = {
        a: b
        for (a, b), count in Counter(pairwise(order)).items()
        if SAMPLE // 8 <= count == firsts[a] == seconds[b] and b != order[0]
    }
    groups = []
    for number in [event.number for event in events if event.number not in after.values()]:
        group = [number]
        while group[-1] in after:
            group.append(after[group[-1]])
        groups.append(tuple(by_number[number] for number in group))
    return groups


def _rows_of(data: Bytes, groups: list[Group]) -> tuple[dict[str, Rows], int]:
    """Records of each event, and where the last whole group ends.

    Records differ in size, so each begins where the one before it ends. To walk them one by
    one would take most of the time. Instead, all places that hold the id of an event are
    listed; but for chance they are the records, so that following the chain means to jump
    from one chance hit to the next.
    """
    numbers = [group[0].number for group in groups]
    sizes = [sum(event.dtype.itemsize for event in group) for group in groups]
    # Records of even sizes stand at even places: half as many to look at.
    unit = 1 if any(size % 2 for size in sizes) else 2
    at = _places(data, numbers, unit)
    # The low byte of the ids tells the events apart as a rule, so that a small table will do.
    key, mask = data[::unit][at], 0xFF
    if len({number & mask for number in numbers}) < len(numbers):
        key, mask = key | data[1::unit][at].astype(np.uint16) << 8, 0xFFFF
    steps = np.zeros(mask + 1, np.int64)
    for number, size in zip(numbers, sizes, strict=True):
        steps[number & mask] = size // unit
    # All keys are in the table; "clip" is faster than to check that.
    keep, end = _chain(at, at + steps.take(key, mode="clip"), len(data) // unit)
    if not keep.all():
        at, key = at[keep], key[keep]
    rows: dict[str, Rows] = {}
    for group, number, size in zip(groups, numbers, sizes, strict=True):
        found = _gather(data, at[np.flatnonzero(key == number & mask)], size, unit)
        offset = 0
        for event in group:
            rows[event.name] = np.ndarray(len(found), event.dtype, found, offset, (size,))
            offset += event.dtype.itemsize
    return rows, end * unit


def _places(data: Bytes, numbers: list[int], unit: int) -> Ints:
    """Where one of the ids stands, in units of so many bytes."""
    spare, hit, found = np.empty((3, min(PIECE, len(data) // unit)), bool)
    parts = [np.empty(0, np.int64)]
    for start in range(0, len(data) - 1, PIECE * unit):
        piece = data[start : start + PIECE * unit + 2 - unit]
        count = (len(piece) - 2 + unit) // unit
        if unit == 2:
            piece = np.require(piece[: 2 * count].view("<u2"), requirements="A")
        _hits(piece, numbers[0], found[:count], spare[:count])
        for number in numbers[1:]:
            _hits(piece, number, hit[:count], spare[:count])
            found |= hit
        parts.append(np.flatnonzero(found[:count]) + start // unit)
    return np.concatenate(parts)


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


def _block(event: Event, rows: NDArray[np.void], scale_ns: int) -> Block:
    count = rows["time"]
    ticks = unwrap(count, 32) if event.time == "<u4" else count.astype(np.int64)
    columns = {name: rows[f"v{k}"] for k, (name, _) in enumerate(event.variables)}
    return Block(event.name, ticks * scale_ns, columns)


def content(source: Path, options: Options) -> Content:
    """Samples of a log, or of a folder with one log per robot, named after it.

    Parameters
    ----------
    source
        The file or folder.
    options
        ``robot`` names the robot of a single file; ``names`` the robots ranged to.

    Raises
    ------
    SourceError
        If a log cannot be used. A folder's empty files are left out, with a line that says so.
    """
    streams = [s for robot, path in _files(source, options) for s in _streams(robot, path, options)]
    return Content(in_order(streams))


def _files(source: Path, options: Options) -> Iterator[tuple[str, Path]]:
    if not source.is_dir():
        yield options.robot, source
        return
    paths = sorted(p for p in source.iterdir() if p.is_file() and p.name[0] != ".")
    for path in paths:
        if path.stat().st_size == 0:
            say(f"{path} is empty; left out")
        elif recognises(path):
            yield path.stem, path
        else:
            say(f"{path} is no micro-SD log; left out")
    if not any(path.stat().st_size and recognises(path) for path in paths):
        raise SourceError(f"no micro-SD log in {source}. Name a folder with one file per robot")


def _streams(robot: str, path: Path, options: Options) -> list[crazyflie_log.Stream]:
    log = decode(path.read_bytes(), path)
    for warning in log.warnings:
        say(warning)
    if not log.blocks:
        raise SourceError(f"{path} has a header, but no whole record. Name another log")
    return crazyflie_log.streams(robot, log.blocks, options.names, path)


FORMAT = Format(
    "cfusdlog", "a micro-SD log of a Crazyflie, or a folder of them", recognises, content
)
