"""Topics of any messages, by a table that says what their fields mean (`column_map`).

The name of a column is ``TOPIC:FIELD``, such as ``/{robot}/state:pose.position.z`` or
``/uwb:distances.0``. The time may be ``:FIELD``, a field of every topic's messages; without
``[time]``, times are the log times, or those in ROS headers. Topics that the table does not name
are converted as without it. Messages are protobuf, JSON or ROS's.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from dmrl.errors import SourceError
from dmrl.formats.base import SOURCE_OPTIONS, Content, Format, Options, add_names, build_content
from dmrl.formats.files.column_map import Column, read_column_map
from dmrl.formats.files.mapped_csv import iter_robot_streams
from dmrl.formats.files.robot_columns import RobotLog, resolve_robots
from dmrl.formats.files.text_cells import is_number
from dmrl.formats.files.text_table import TextTable
from dmrl.formats.ros import bag
from dmrl.formats.ros.reader import iter_messages, list_topics
from dmrl.ingest import foreign_recording
from dmrl.recording import read_summary
from dmrl.terminal.left_out import leave_out

LOG_TIME = ":log_time"
FIELDS_MAX = 20
"""Fields of a message that an error lists."""
Cells = dict[str, dict[str, list[str]]]
"""Cells by topic and column, as in a text file."""


def can_read(source: Path) -> bool:
    """Return whether a source has topics: an MCAP file or a ROS bag."""
    return bag.can_read(source) or foreign_recording.can_read(source)


def load_content(source: Path, options: Options) -> Content:
    """Load the samples of the topics of a table, and of all topics that it does not name.

    Parameters
    ----------
    source
        A recording or a bag.
    options
        ``columns``, the table; ``robot`` of topics that name none; ``names`` of robots.

    Raises
    ------
    SourceError
        If the table is wrong, or names a topic or a field that the source lacks.
    """
    table = read_column_map(Path(options.columns or ""), time_column=LOG_TIME)
    if fixed := [key for key, column in table.columns.items() if column.value is not None]:
        raise SourceError(f"[{fixed[0]}] value: constants are for text files. Name a field")
    if table.robot_column or table.peer_column:
        raise SourceError(
            f"{options.columns}: [robot] and [peer] are for text files; see {{robot}}"
        )
    options = replace(options, names=add_names(options.names, table.renames), columns=None)
    is_bag = not foreign_recording.can_read(source)
    kinds = {topic: kind for topic, kind, count in _list_topics(source, is_bag=is_bag) if count}
    fields = {name.rpartition(":")[2] for name in table.names}
    names: dict[str, list[str]] = {f"{t}:{f}": [] for t in ("", *kinds) for f in fields}
    logs = resolve_robots(options.robot, TextTable(source, names, []), table)
    used = {name.rpartition(":")[0] for log in logs for name in _list_names(log)} - {""}
    wanted = {
        topic: {n for log in logs for n in _list_names(log) if n.rpartition(":")[0] in ("", topic)}
        for topic in used
    }
    cells = _read_cells(source, wanted, kinds, is_bag=is_bag)
    streams: list[Iterable[Any]] = []
    for log in logs:
        for topic, columns in cells.items():
            if (part := _select_topic(log, topic, columns)) is not None:
                streams += iter_robot_streams(part, options, raw=False)
    if kinds.keys() - used:
        load = bag.load_content if is_bag else foreign_recording.load_content
        streams.append(load(source, options, skip=used).samples)
    return build_content(streams)


def _list_topics(source: Path, *, is_bag: bool) -> list[tuple[str, str, int]]:
    if is_bag:
        return list_topics(source)
    return [(t, info.schema, info.count) for t, info in read_summary(source).topics.items()]


def _list_names(log: RobotLog) -> Iterator[str]:
    yield from (column.name for column in (*log.columns.values(), *log.ranges.values()))


def _read_cells(
    source: Path, columns: Mapping[str, set[str]], kinds: Mapping[str, str], *, is_bag: bool
) -> Cells:
    """Read the fields of messages, by topic and column.

    Raises
    ------
    SourceError
        If no message of a topic has a number in a field.
    """
    cells: Cells = {topic: {name: [] for name in names} for topic, names in columns.items()}
    last: dict[str, Any] = {}
    for topic, time_ns, message in _iter_objects(source, columns, kinds, is_bag=is_bag):
        last[topic] = message
        for name, column in cells[topic].items():
            path = name.rpartition(":")[2].split(".")
            column.append(str(time_ns) if name == LOG_TIME else _find_cell(message, path))
    for topic, held in cells.items():
        for name, column in held.items():
            if not any(is_number(cell) for cell in column):
                wrong = f"{source}: no message on {topic} has a number in {name}"
                raise SourceError(f"{wrong}. {_suggest_field(name, last.get(topic))}")
    return cells


def _iter_objects(
    source: Path, topics: Iterable[str], kinds: Mapping[str, str], *, is_bag: bool
) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, time and decoded message; messages that cannot be decoded are left out."""
    found: Iterable[tuple[str, int, Any]]
    if is_bag:
        wanted = {(topic, kinds[topic]) for topic in topics}
        found = ((m.topic, m.bag_ns, m.decoded) for m in iter_messages(source, wanted))
    else:
        raws = foreign_recording.read_topics(source, topics)
        found = ((raw.topic, raw.time_ns, foreign_recording.parse(raw, source)) for raw in raws)
    for topic, time_ns, message in found:
        if message is None:
            leave_out(f"messages on {topic} that cannot be decoded", source)
        else:
            stamp_ns = bag.header_time_ns(message)
            yield topic, time_ns if stamp_ns is None else stamp_ns, message


def _find_cell(value: Any, path: Sequence[str]) -> str:
    """Return the text of a field, of an item of a list, or of a part of it; empty: there is none.

    A time of ROS or protobuf is a number of nanoseconds. Cells that are not numbers are counted
    when they are parsed.
    """
    for part in path:
        if isinstance(value, Mapping):
            value = value.get(part)
        elif part.isdigit() and hasattr(value, "__getitem__"):
            value = value[int(part)] if int(part) < len(value) else None
        else:
            value = getattr(value, part, None)
    seconds, nanos = (
        next((getattr(value, name) for name in names if hasattr(value, name)), None)
        for names in (("seconds", "sec"), ("nanos", "nanosec"))
    )
    if seconds is not None and nanos is not None:
        value = seconds * 1_000_000_000 + nanos
    return "" if value is None else str(value)


def _suggest_field(name: str, message: Any) -> str:
    """Return the way out of a field without numbers: the fields of a message."""
    if isinstance(message, Mapping):
        known = list(map(str, message))
    elif hasattr(message, "DESCRIPTOR"):
        known = [field.name for field in message.DESCRIPTOR.fields]
    else:
        known = list(getattr(message, "__dict__", ()))
    return f"Name another field: {', '.join(known[:FIELDS_MAX])}" if known else "Name another field"


def _select_topic(log: RobotLog, topic: str, cells: Mapping[str, list[str]]) -> RobotLog | None:
    """Return the part of a robot's log that one topic has; None if it has nothing of it."""

    def select(columns: Mapping[str, Column]) -> dict[str, Column]:
        return {key: c for key, c in columns.items() if c.name.rpartition(":")[0] == topic}

    columns, ranges = select(log.columns), select(log.ranges)
    if not (columns or ranges):
        return None
    lines = list(range(len(next(iter(cells.values())))))
    path = Path(f"{log.text.path}: {topic}")
    text = replace(log.text, path=path, columns=dict(cells), lines=lines)
    return RobotLog(log.robot, text, {"time": log.columns["time"]} | columns, ranges, frozenset())


FORMAT = Format(
    "topics",
    "topics and a table of their fields",
    can_read,
    load_content,
    SOURCE_OPTIONS | {"bits", "columns"},
)
