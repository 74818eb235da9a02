"""Hold some topics of a recording in memory, read in one pass."""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from google.protobuf.message_factory import GetMessageClass

from dmrl.errors import MissingTopic
from dmrl.images.codec import is_decodable, read_size
from dmrl.recording.log_times import read_log_times
from dmrl.recording.mcap.batch_reader import iter_batches, join_batches
from dmrl.recording.mcap.channel import Channel, RawMessage
from dmrl.recording.mcap.message_batch import EMPTY_BATCH, Ints, MessageBatch, concatenate_all
from dmrl.recording.protobuf.columns import decode_by_topic, decode_topic, group_by_topic
from dmrl.recording.protobuf.message_types import find_channel_descriptor, require_types
from dmrl.recording.reader import Stamped, parse_message, read, select_topics
from dmrl.recording.summary import TopicInfo, read_channel, read_summary

PLACEHOLDER = re.compile(r"\\{\w+\\}")
"""A placeholder of a topic pattern, escaped."""


class LoadedRecording:
    """A recording with the messages of some topics in memory.

    Messages are kept encoded and decoded on request, but for those of ``columns``. Other topics are
    read on request, each in a pass of its own.

    Parameters
    ----------
    path
        A complete recording.
    wanted
        Topics, or patterns as in ``dmrl.topics``: ``/{robot}/labels``. They may be missing.
        Read large topics, such as images, with `read` instead.
    columns
        Patterns of further topics, and the fields to which their messages are decoded as they are
        read. Columns take a third of the memory of messages.

    Raises
    ------
    RecordingError
        If the file is not a complete recording, or one of dmrl's topics carries another type.
    """

    def __init__(
        self, path: Path, *wanted: str, columns: Mapping[str, Sequence[str]] | None = None
    ) -> None:
        self.path, self.summary = path, read_summary(path)
        self._messages: dict[str, tuple[MessageBatch, dict[int, Channel]]] = {}
        self._fields = {
            topic: tuple(fields)
            for pattern, fields in (columns or {}).items()
            for topic in self._match(pattern)
        }
        self._columns: dict[str, list[pa.RecordBatch]] = {topic: [] for topic in self._fields}
        names = frozenset(topic for pattern in wanted for topic in self._match(pattern))
        require_types(path, self.topics, names | self._fields.keys())
        self._load_topics(names - self._fields.keys(), self._fields)

    def _match(self, pattern: str) -> list[str]:
        expression = re.compile(PLACEHOLDER.sub("[^/]+", re.escape(pattern)))
        return [topic for topic in self.topics if expression.fullmatch(topic)]

    def _load_topics(self, names: frozenset[str], fields: Mapping[str, Sequence[str]]) -> None:
        """Keep the messages of some topics, and the columns of others."""
        parts: list[MessageBatch] = []
        channels: dict[int, Channel] = {}
        every = names | fields.keys()
        for batch, channels in join_batches(iter_batches(self.path, every)) if every else ():
            kept = [n for n, channel in channels.items() if channel.topic in names]
            parts.append(batch.select_channels(kept).compact() if fields else batch)
            decoded = batch.select_channels(channels.keys() - set(kept))
            for topic, made in decode_by_topic(self.path, decoded, channels, fields).items():
                self._columns[topic].append(made)
        self.add_topics(names, parts, channels)

    def add_topics(
        self, names: frozenset[str], parts: list[MessageBatch], channels: dict[int, Channel]
    ) -> None:
        """Keep all messages of these topics, which were read already; empty the list of them."""
        batches = group_by_topic(concatenate_all(parts).sort_by_time(), channels) if parts else {}
        for topic in names:
            own = {n: channel for n, channel in channels.items() if channel.topic == topic}
            own = own or {0: read_channel(self.path, topic)}  # the topic has no messages
            self._messages[topic] = batches.get(topic, EMPTY_BATCH), own

    @property
    def topics(self) -> Mapping[str, TopicInfo]:
        """All topics of the recording, in memory or not."""
        return self.summary.topics

    @property
    def start_ns(self) -> int:
        """First log time of the recording, nanoseconds."""
        return self.summary.start_ns

    def get_times(self, topic: str) -> Ints:
        """Return the (N,) sorted log times of any topic from the index; empty if it is missing."""
        if topic in self._messages:
            return self._messages[topic][0].time_ns
        return read_log_times(self.path, [topic]).get(topic, np.zeros(0, np.int64))

    def get_table(self, topic: str, fields: Sequence[str] | None = None) -> pa.Table:
        """Return one topic as an Arrow table, possibly without rows; see `iter_columns`.

        Decoded columns are handed over. Asked for again, their topic is read again.

        Raises
        ------
        MissingTopic
            If the recording lacks the topic.
        RecordingError
            If a message is not of its type.
        """
        held = fields is not None and self._fields.get(topic) == tuple(fields)
        if held and (decoded := self._columns.pop(topic, None)):
            return pa.Table.from_batches(decoded)
        batch, channels = self._get_messages(topic)
        return pa.Table.from_batches([decode_topic(self.path, topic, batch, channels, fields)])

    def iter_messages(self, topic: str) -> Iterator[Stamped]:
        """Yield the decoded messages of a topic in log-time order; raise as `get_table`."""
        batch, channels = self._get_messages(topic)
        kinds = {
            n: GetMessageClass(find_channel_descriptor(self.path, c)) for n, c in channels.items()
        }
        for number, time_ns, publish_ns, data in batch.iter_rows():
            raw = RawMessage(time_ns, publish_ns, channels[number], data)
            yield Stamped(time_ns, topic, parse_message(raw, kinds[number], self.path))

    def matching(self, *wanted: str) -> frozenset[str]:
        """Return the topics that names and patterns ask for; raise what `match_topics` does."""
        found = select_topics(self.path, self.topics, wanted)
        require_types(self.path, self.topics, found)
        return found

    def first(self, topic: str) -> Stamped | None:
        """Return the first message of a topic, and load no other; None if it has none."""
        return next(read(self.path, topic), None)

    def read_image_size(self, topic: str) -> tuple[int, int] | None:
        """Return width and height of the first decodable image of a topic; None without one."""
        every = (image.message.data for image in read(self.path, topic))
        first = next(filter(is_decodable, every), None)
        return None if first is None else read_size(first)[:2]

    def _get_messages(self, topic: str) -> tuple[MessageBatch, dict[int, Channel]]:
        """Return the messages of a topic, and its channels by channel id."""
        if topic not in self.topics:
            raise MissingTopic(topic, self.topics, self.path)
        if topic not in self._messages:
            require_types(self.path, self.topics, [topic])
            self._load_topics(frozenset([topic]), {})
        return self._messages[topic]
