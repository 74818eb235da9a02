"""Micro-SD logs of the Crazyflie (cfusdlog, versions 1 and 2).

Little endian: ``0xBC``, u16 version, u16 number of event types; per type u16 id, name, 0,
u16 number of variables, each ``group.name(T)`` and 0, T a letter of ``struct``. Then records:
u16 id, time since boot (version 1: u32 milliseconds, version 2: u64 microseconds), the
values. The last four bytes are the CRC-32 of all before. A log that was cut short, by a flat
battery as a rule, has no CRC: all its whole records are read, with a warning.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
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
TYPES_MAX = 250
CRC_BYTES = 4
PIECE_BYTES = 1 << 17

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
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

    @property
    def dtype(self) -> np.dtype[np.void]:
        """A whole record, packed."""
        values = [(f"v{k}", f"<{code}") for k, (_, code) in enumerate(self.variables)]
        return np.dtype([("id", "<u2"), ("time", self.time), *values])


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
    records = np.frombuffer(data, np.uint8)[: len(data) - CRC_BYTES * sealed]
    found, end = _records(records, body, events)
    warnings = [] if sealed else [f"{what}: no valid CRC at its end; cut short, or damaged"]
    if end < len(records):
        left = len(records) - end
        warnings.append(f"{what}: {left} bytes from byte {end} on are no whole record; left out")
    view = [_rows(records, event, at) for event, at in zip(events, found, strict=True)]
    scale = VERSIONS[version][1]
    blocks = [_block(e, rows, scale) for e, rows in zip(events, view, strict=True) if len(rows)]
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


def _records(data: Bytes, body: int, events: list[Event]) -> tuple[list[Ints], int]:
    """Offsets of the records of each event, and the end of the last whole one.

    Records differ in size, so each begins where the one before it ends. To walk them one by
    one would take most of the time. Instead, all places that hold the id of an event are
    listed; but for chance they are the records, so that following the chain means to jump
    from one chance hit to the next.
    """
    at = _ids(data, body, events)
    # One byte of the ids tells the events apart as a rule, so that a small table will do.
    wide = len({event.number & 0xFF for event in events}) < len(events)
    key = data[at] | data[at + 1].astype(np.uint16) << 8 if wide else data[at]
    mask = 0xFFFF if wide else 0xFF
    sizes, kinds = np.zeros(mask + 1, np.int64), np.zeros(mask + 1, np.uint8)
    for k, event in enumerate(events):
        sizes[event.number & mask], kinds[event.number & mask] = event.dtype.itemsize, k
    keep, end = _chain(at, at + sizes[key], body, len(data))
    kind = kinds[key]
    if not keep.all():
        at, kind = at[keep], kind[keep]
    return [at[np.flatnonzero(kind == k)] for k in range(len(events))], end


def _ids(data: Bytes, body: int, events: list[Event]) -> Ints:
    """Where the id of an event stands, piece by piece: small arrays stay in the cache."""
    by_top: dict[int, list[int]] = {}
    for event in events:
        by_top.setdefault(event.number >> 8, []).append(event.number & 0xFF)
    one, same, found = (np.empty(PIECE_BYTES, bool) for _ in range(3))
    parts = [np.empty(0, np.int64)]
    for start in range(body, len(data) - 1, PIECE_BYTES):
        low = data[start : min(start + PIECE_BYTES, len(data) - 1)]
        high = data[start + 1 : start + 1 + len(low)]
        piece = slice(len(low))
        for k, (top, bottoms) in enumerate(by_top.items()):
            hit = np.equal(low, bottoms[0], out=(same if k else found)[piece])
            for bottom in bottoms[1:]:
                hit |= np.equal(low, bottom, out=one[piece])
            hit &= np.equal(high, top, out=one[piece])
            if k:
                found[piece] |= hit
        parts.append(np.flatnonzero(found[piece]) + start)
    return np.concatenate(parts)


def _chain(at: Ints, target: Ints, start: int, end: int) -> tuple[NDArray[np.bool_], int]:
    """Which places are records, each where the one before it ends, and where the last ends."""
    keep = np.zeros(len(at), bool)
    if not len(at) or at[0] != start:
        return keep, start
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


def _rows(data: Bytes, event: Event, at: NDArray[np.intp]) -> NDArray[np.void]:
    # A view with a stride of one byte gathers unaligned records in one go; as bytes without
    # fields, since those would be copied one by one.
    size = event.dtype.itemsize
    view = np.ndarray((max(len(data) - size + 1, 0),), np.dtype((np.void, size)), data, 0, (1,))
    return view[at].view(event.dtype)


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
