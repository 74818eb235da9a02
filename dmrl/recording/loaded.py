"""Some topics of a recording, held in memory: read in one pass, however many they are."""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from google.protobuf.message_factory import GetMessageClass

from dmrl.errors import MissingTopic
from dmrl.recording.log_times import log_times
from dmrl.recording.mcap.batch_reader import blocks
from dmrl.recording.mcap.channel import Channel, RawMessage
from dmrl.recording.mcap.message_batch import EMPTY, Block, Ints, joined
from dmrl.recording.mcap.summary_index import TopicInfo, channel_on
from dmrl.recording.protobuf.columns import apart, decoded
from dmrl.recording.protobuf.message_types import descriptor_of, require_types
from dmrl.recording.reader import Stamped, parsed
from dmrl.recording.summary import summary

PART = re.compile(r"\\{\w+\\}")
"""A part of a pattern that is left open, escaped."""


class Contents:
    """A recording, with the bytes of some of its topics.

    They are held as they stand in the file, and decoded when they are asked for. Topics that were
    not named are read once they are asked for, in a pass of their own.

    Parameters
    ----------
    path
        A complete recording.
    wanted
        Topics, and patterns of them as in ``dmrl.topics``: ``/{robot}/labels``. None of them has
        to be there. What is large, such as pictures, is better read with `read`.

    Raises
    ------
    RecordingError
        If the file is not a complete recording, or a topic of dmrl's carries another type.
    """

    def __init__(self, path: Path, *wanted: str) -> None:
        self.path, self.summary = path, summary(path)
        self._held: dict[str, tuple[Block, dict[int, Channel]]] = {}
        patterns = [re.compile(PART.sub("[^/]+", re.escape(want))) for want in wanted]
        names = frozenset(t for t in self.topics if any(p.fullmatch(t) for p in patterns))
        require_types(path, self.topics, names)
        self._read(names)

    def _read(self, names: frozenset[str]) -> None:
        parts: list[Block] = []
        channels: dict[int, Channel] = {}
        for block, own in blocks(self.path, names) if names else ():
            parts.append(block)
            channels = own
        self.hold(names, parts, channels)

    def hold(
        self, names: frozenset[str], parts: Sequence[Block], channels: dict[int, Channel]
    ) -> None:
        """Hold what was read already: all messages of these topics."""
        found = apart(joined(parts).sorted(), channels) if parts else {}
        for topic in names:
            own = {n: channel for n, channel in channels.items() if channel.topic == topic}
            own = own or {0: channel_on(self.path, topic)}  # one without messages
            self._held[topic] = found.get(topic, EMPTY), own

    @property
    def topics(self) -> Mapping[str, TopicInfo]:
        """All topics of the recording, held or not."""
        return self.summary.topics

    @property
    def start_ns(self) -> int:
        """First log time of the recording."""
        return self.summary.start_ns

    def times(self, topic: str) -> Ints:
        """(N,) log times of any topic, sorted, as the index has them; none where it is missing."""
        if topic in self._held:
            return self._held[topic][0].time_ns
        return log_times(self.path, [topic]).get(topic, np.zeros(0, np.int64))

    def table(self, topic: str, fields: Sequence[str] | None = None) -> pa.Table:
        """One topic as an Arrow table; see `columns`. It may have no rows.

        Raises
        ------
        MissingTopic
            If the recording lacks the topic.
        RecordingError
            If a message is not of its type.
        """
        block, channels = self._of(topic)
        return pa.Table.from_batches([decoded(self.path, topic, block, channels, fields)])

    def messages(self, topic: str) -> Iterator[Stamped]:
        """The messages of a topic, decoded, in log-time order; raises what `table` does."""
        block, channels = self._of(topic)
        kinds = {n: GetMessageClass(descriptor_of(self.path, c)) for n, c in channels.items()}
        for number, time_ns, publish_ns, data in block.rows():
            raw = RawMessage(time_ns, publish_ns, channels[number], data)
            yield Stamped(time_ns, topic, parsed(raw, kinds[number], self.path))

    def _of(self, topic: str) -> tuple[Block, dict[int, Channel]]:
        """Messages of a topic, and its channels by number."""
        if topic not in self.topics:
            raise MissingTopic(topic, self.topics, self.path)
        if topic not in self._held:
            require_types(self.path, self.topics, [topic])
            self._read(frozenset([topic]))
        return self._held[topic]
