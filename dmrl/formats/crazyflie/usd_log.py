"""Micro-SD logs of the Crazyflie (cfusdlog, versions 1 and 2).

Little endian: ``0xBC``, u16 version, u16 number of event types; per type u16 id, name, 0,
u16 number of variables, each ``group.name(T)`` and 0, T a letter of ``struct``. Then records:
u16 id, time since boot (version 1: u32 milliseconds, version 2: u64 microseconds), the
values. The last four bytes are the CRC-32 of all before. A log that was cut short, usually by an
empty battery, has no CRC. All its whole records are read, with a warning.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dmrl.errors import SourceError
from dmrl.formats.base import SOURCE_OPTIONS, Content, Format, Options, build_content
from dmrl.formats.clocks import unwrap
from dmrl.formats.crazyflie import log_variables
from dmrl.formats.crazyflie.log_block import LogBlock, unwrap_between_blocks
from dmrl.formats.crazyflie.usd_records import EventType, Rows, gather_records
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import say

MAGIC = 0xBC
VERSIONS = {1: ("<u4", 1_000_000), 2: ("<u8", 1_000)}
"""NumPy type of a time, and nanoseconds of its unit, by version."""
TYPE_CODES = "bBhHiIef"
MAX_EVENT_TYPES = 250
CRC_BYTES = 4


@dataclass(frozen=True, slots=True)
class UsdLog:
    """Content of a file.

    Parameters
    ----------
    version
        Version of the format.
    blocks
        One for each event type that has records.
    warnings
        Problems of the file, a line each.
    """

    version: int
    blocks: tuple[LogBlock, ...]
    warnings: tuple[str, ...]


def can_read(source: Path) -> bool:
    """Return whether a file begins like a micro-SD log, or a folder contains one that does."""
    if source.is_dir():
        return any(can_read(path) for path in source.iterdir() if path.is_file())
    with source.open("rb") as stream:
        head = stream.read(5)
    if len(head) < 5 or head[0] != MAGIC:
        return False
    version, types = struct.unpack_from("<HH", head, 1)
    return version in VERSIONS and 0 < types <= MAX_EVENT_TYPES


def decode_log(data: bytes, what: object = "the log") -> UsdLog:
    """Decode the records of a log to one array per variable.

    Parameters
    ----------
    data
        Content of the file.
    what
        Its name, for errors.

    Raises
    ------
    SourceError
        If it is no micro-SD log, or ends inside its header.
    """
    if not data:
        raise SourceError(f"{what} is empty: the card was full, or removed. Pass another log")
    version, events, body = _parse_header(data, what)
    sealed = len(data) - body >= CRC_BYTES and zlib.crc32(
        memoryview(data)[:-CRC_BYTES]
    ) == int.from_bytes(data[-CRC_BYTES:], "little")
    stop = len(data) - CRC_BYTES * sealed
    rows, end = gather_records(data, body, stop, events)
    warnings = [] if sealed else [f"{what}: no valid CRC at its end; cut short, or damaged"]
    leave_out("bytes that are no whole record", f"{what}: byte {end}", stop - end)
    scale = VERSIONS[version][1]
    blocks = [_build_block(e, rows[e.name], scale) for e in events if len(rows[e.name])]
    if version == 1:
        blocks = unwrap_between_blocks(blocks, scale << 32)
    return UsdLog(version, tuple(blocks), tuple(warnings))


def _parse_header(data: bytes, what: object) -> tuple[int, list[EventType], int]:
    """Parse the version, the event types, and the offset at which the records begin."""
    try:
        magic, version, types = struct.unpack_from("<BHH", data)
        if magic != MAGIC or version not in VERSIONS or not 0 < types <= MAX_EVENT_TYPES:
            raise SourceError(f"{what} is no micro-SD log of version 1 or 2. Pass another file")
        at, events = 5, []
        for _ in range(types):
            (number,) = struct.unpack_from("<H", data, at)
            name, at = _parse_text(data, at + 2)
            (count,) = struct.unpack_from("<H", data, at)
            at += 2
            variables = []
            for _ in range(count):
                text, at = _parse_text(data, at)
                variables.append((text[:-3], text[-2:-1]))
            events.append(EventType(number, name, tuple(variables), VERSIONS[version][0]))
    except (struct.error, ValueError) as e:
        raise SourceError(
            f"{what} is damaged in its header, or ends there: {e}. Pass another log"
        ) from None
    _check_events(events, what)
    return version, events, at


def _parse_text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at)
    return data[at:end].decode("ascii"), end + 1


def _check_events(events: list[EventType], what: object) -> None:
    for event in events:
        names = [name for name, _ in event.variables]
        if not all(
            name.isprintable() and name and code and code in TYPE_CODES
            for name, code in event.variables
        ) or not (event.name.isprintable() and event.name and len(set(names)) == len(names)):
            raise SourceError(
                f"{what}: event {event.name!r} has variables without name or known type in its "
                "header. Pass another log"
            )
    for kind, values in (("id", [e.number for e in events]), ("name", [e.name for e in events])):
        if len(set(values)) < len(values):
            raise SourceError(f"{what}: two events have the same {kind}. Pass another log")


def _build_block(event: EventType, rows: Rows, scale_ns: int) -> LogBlock:
    count = rows["time"]
    # A damaged time may be more than fits.
    most = np.iinfo(np.int64).max // 2 // scale_ns
    ticks = unwrap(count, 32) if event.time == "<u4" else count.clip(max=most).astype(np.int64)
    columns = {name: rows[f"v{k}"] for k, (name, _) in enumerate(event.variables)}
    return LogBlock(event.name, ticks * scale_ns, columns)


def load_content(source: Path, options: Options) -> Content:
    """Load the samples of a log, or of a folder with one log per robot, named after it.

    Parameters
    ----------
    source
        The file or folder.
    options
        ``robot`` is the robot of a single file. ``names`` names the robots ranged to, and those of
        a folder.

    Raises
    ------
    SourceError
        If a log cannot be used. Empty files of a folder are left out and reported.
    """
    logs = _iter_logs(source, options)
    streams = [s for robot, path in logs for s in _load_streams(robot, path, options)]
    return build_content(streams)


def _iter_logs(source: Path, options: Options) -> Iterator[tuple[str, Path]]:
    if not source.is_dir():
        yield options.robot, source
        return
    options.refuse("robot", f"has no effect: the files of {source} are named after robots")
    paths = sorted(p for p in source.iterdir() if p.is_file() and p.name[0] != ".")
    logs = [path for path in paths if path.stat().st_size and can_read(path)]
    if not logs:
        raise SourceError(f"no micro-SD log in {source}. Pass a folder with one file per robot")
    for path in paths:
        if path.stat().st_size == 0:
            leave_out("empty files", path)
        elif path in logs:
            yield options.names.get(path.stem, path.stem), path
    others = [path for path in paths if path.stat().st_size and path not in logs]
    leave_out("files that are no micro-SD log", next(iter(others), source), len(others))


def _load_streams(robot: str, path: Path, options: Options) -> list[log_variables.SampleStream]:
    log = decode_log(path.read_bytes(), path)
    for warning in log.warnings:
        say(warning)
    if not log.blocks:
        raise SourceError(f"{path} has a header, but no whole record. Pass another log")
    return log_variables.build_streams(robot, log.blocks, options.names, path)


FORMAT = Format(
    "cfusdlog",
    "a micro-SD log of a Crazyflie, or a folder of them",
    can_read,
    load_content,
    SOURCE_OPTIONS,
)
