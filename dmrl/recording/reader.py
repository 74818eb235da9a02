"""Read messages of a recording in log-time order, one at a time or as Arrow columns."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass

from dmrl.errors import MissingTopic
from dmrl.recording.mcap.batch_reader import iter_batches, join_batches
from dmrl.recording.mcap.channel import Channel, RawMessage
from dmrl.recording.mcap.file import corrupt_error
from dmrl.recording.mcap.message_batch import EMPTY_BATCH
from dmrl.recording.protobuf.columns import decode_by_topic, decode_topic
from dmrl.recording.protobuf.message_types import find_channel_descriptor, require_types
from dmrl.recording.summary import TopicInfo, read_channel, read_summary


@dataclass(frozen=True, slots=True)
class Stamped:
    """A decoded message with its log time (nanoseconds) and topic."""

    time_ns: int
    topic: str
    message: Any


def match_topics(path: Path, wanted: Sequence[str]) -> frozenset[str]:
    """Return the topics of a recording that match some names and patterns.

    Parameters
    ----------
    path
        A recording.
    wanted
        Topics, or patterns in which ``*`` matches one part: ``/*/labels``.

    Raises
    ------
    MissingTopic
        If a name or pattern matches nothing.
    RecordingError
        If one of dmrl's topics carries another message type.
    """
    topics = read_summary(path).topics
    found = select_topics(path, topics, wanted)
    require_types(path, topics, found)
    return found


def select_topics(
    path: Path, topics: Mapping[str, TopicInfo], wanted: Sequence[str]
) -> frozenset[str]:
    """Return the topics that names and patterns ask for, of any message type.

    Raises
    ------
    MissingTopic
        If a name or pattern matches nothing.
    """
    found: set[str] = set()
    for want in wanted:
        hits = {want} & topics.keys()
        if "*" in want:
            pattern = re.compile(re.escape(want).replace(r"\*", "[^/]+"))
            hits = {t for t in topics if pattern.fullmatch(t)}
        if not hits:
            raise MissingTopic(want, topics, path)
        found |= hits
    return frozenset(found)


def read_raw(
    path: Path, *topics: str, start_ns: int | None = None, end_ns: int | None = None
) -> Iterator[RawMessage]:
    """Yield undecoded messages in log-time order.

    Parameters
    ----------
    path
        A complete recording.
    topics
        Topics or patterns to read. None given: all.
    start_ns, end_ns
        Read log times in [start_ns, end_ns) only, nanoseconds.

    Raises
    ------
    MissingTopic
        Before the first message, if a topic matches nothing.
    RecordingError
        If the file is not a complete recording.
    """
    names = match_topics(path, topics) if topics else None
    for batch, channels in iter_batches(path, names, start_ns=start_ns, end_ns=end_ns):
        for number, time_ns, publish_ns, data in batch.iter_rows():
            yield RawMessage(time_ns, publish_ns, channels[number], data)


def read(
    path: Path, *topics: str, start_ns: int | None = None, end_ns: int | None = None
) -> Iterator[Stamped]:
    """Yield decoded messages in log-time order, with a few chunks in memory.

    Parameters
    ----------
    path
        A complete recording.
    topics
        Topics or patterns (``/*/labels``) to read. None given: all.
    start_ns, end_ns
        Read log times in [start_ns, end_ns) only, nanoseconds.

    Raises
    ------
    MissingTopic
        Before the first message, if a topic matches nothing.
    RecordingError
        If the file is not a complete recording, or a message is not of its type.
    """
    names = match_topics(path, topics) if topics else None
    classes: dict[Channel, Any] = {}
    for batch, channels in iter_batches(path, names, start_ns=start_ns, end_ns=end_ns):
        known: dict[int, tuple[str, Any]] = {}  # by number: hashing a channel takes long
        for number, time_ns, _, data in batch.iter_rows():
            if number not in known:
                channel = channels[number]
                if channel not in classes:
                    classes[channel] = GetMessageClass(find_channel_descriptor(path, channel))
                known[number] = channel.topic, classes[channel]
            topic, kind = known[number]
            try:
                message = kind.FromString(data)
            except DecodeError as e:
                raise corrupt_error(path, f"{topic} at {time_ns} ns: {e}") from e
            yield Stamped(time_ns, topic, message)


def parse_message(raw: RawMessage, kind: Any, path: Path) -> Any:
    """Parse the payload of a message; raise RecordingError if it is not of the class."""
    try:
        return kind.FromString(raw.data)
    except DecodeError as e:
        raise corrupt_error(path, f"{raw.topic} at {raw.time_ns} ns: {e}") from e


def iter_columns(
    path: Path,
    topic: str,
    *,
    fields: Sequence[str] | None = None,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> Iterator[pa.RecordBatch]:
    """Yield one topic as Arrow columns in log-time order, about a batch per chunk.

    Parameters
    ----------
    path
        A complete recording.
    topic
        A topic, not a pattern.
    fields
        Fields of the message to decode. None: all.
    start_ns, end_ns
        Read log times in [start_ns, end_ns) only, nanoseconds.

    Yields
    ------
    pa.RecordBatch
        ``log_time`` and ``publish_time`` (int64, nanoseconds), then a column per field:
        sub-messages are structs, repeated fields lists, enums int32.

    Raises
    ------
    MissingTopic
        If the recording lacks the topic.
    RecordingError
        If the file is not a complete recording, or a message is not of its type.
    """
    for batch, channels in iter_batches(
        path, match_topics(path, [topic]), start_ns=start_ns, end_ns=end_ns
    ):
        yield decode_topic(path, topic, batch, channels, fields)


def iter_topic_batches(
    path: Path,
    fields: Mapping[str, Sequence[str] | None],
    *,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> Iterator[dict[str, pa.RecordBatch]]:
    """Yield several topics as Arrow columns in one pass, one time range after another.

    Parameters
    ----------
    path
        A complete recording.
    fields
        Topics, and the fields of each to decode (None: all). Missing topics are left out.
    start_ns, end_ns
        Read log times in [start_ns, end_ns) only, nanoseconds.

    Yields
    ------
    dict
        Topic to columns as in `iter_columns`, for topics with messages in the time range.

    Raises
    ------
    RecordingError
        If the file is not a complete recording, or a message is not of its type.
    """
    present = read_summary(path).topics
    names = frozenset(topic for topic in fields if topic in present)
    require_types(path, present, names)
    batches = iter_batches(path, names, start_ns=start_ns, end_ns=end_ns)
    for batch, channels in join_batches(batches):
        yield decode_by_topic(path, batch, channels, fields)


def read_table(
    path: Path,
    topic: str,
    *,
    fields: Sequence[str] | None = None,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> pa.Table:
    """Read one topic into an Arrow table, possibly without rows; see ``iter_columns``."""
    names = match_topics(path, [topic])
    batches = join_batches(iter_batches(path, names, start_ns=start_ns, end_ns=end_ns))
    decoded = [decode_topic(path, topic, *each, fields) for each in batches]
    if not decoded:
        channels = {0: read_channel(path, topic)}
        decoded = [decode_topic(path, topic, EMPTY_BATCH, channels, fields)]
    return pa.Table.from_batches(decoded)
