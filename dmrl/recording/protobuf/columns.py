"""Split message batches by topic and decode them to Arrow columns."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from google.protobuf.descriptor import Descriptor

from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.file import damaged
from dmrl.recording.mcap.message_batch import Block
from dmrl.recording.protobuf.decode import decode
from dmrl.recording.protobuf.message_types import descriptor_of, one_type
from dmrl.recording.protobuf.wire_values import WireError


def by_topic(
    path: Path,
    block: Block,
    channels: Mapping[int, Channel],
    fields: Mapping[str, Sequence[str] | None],
) -> dict[str, pa.RecordBatch]:
    """Decode the messages of a batch to columns, by topic."""
    return {
        topic: decoded(path, topic, mine, channels, fields[topic])
        for topic, mine in apart(block, channels).items()
    }


def apart(block: Block, channels: Mapping[int, Channel]) -> dict[str, Block]:
    """Split a batch by topic, keeping the order of the messages."""
    topics = sorted({channels[number].topic for number in block.numbers()})
    place = np.full(max(channels, default=0) + 1, -1, np.int64)
    for number, channel in channels.items():
        if channel.topic in topics:
            place[number] = topics.index(channel.topic)
    key = place[block.channel]
    order = np.argsort(key, kind="stable")
    ends = np.searchsorted(key[order], np.arange(len(topics)), side="right")
    rows = np.split(order, ends[:-1])
    return {topic: block.take(own) for topic, own in zip(topics, rows, strict=False)}


def decoded(
    path: Path,
    topic: str,
    block: Block,
    channels: Mapping[int, Channel],
    fields: Sequence[str] | None,
) -> pa.RecordBatch:
    """Decode the messages of one topic to columns.

    Raises
    ------
    RecordingError
        If the topic has several message types, or a message is not of its type.
    """
    numbers = block.numbers()
    own = [n for n, channel in channels.items() if channel.topic == topic]
    kinds = {descriptor_of(path, channels[number]) for number in numbers or own}
    return _decoded(path, topic, block, one_type(path, topic, kinds), fields)


def _decoded(
    path: Path, topic: str, block: Block, kind: Descriptor, fields: Sequence[str] | None
) -> pa.RecordBatch:
    try:
        return batch_of(block, kind, fields)
    except WireError as e:
        raise damaged(path, f"{topic}: {e}") from e


def batch_of(block: Block, kind: Descriptor, fields: Sequence[str] | None) -> pa.RecordBatch:
    """Decode messages of one type to columns, log time and publish time first."""
    body = decode(block.data, block.start, block.end, kind, fields)
    times = {"log_time": pa.array(block.time_ns), "publish_time": pa.array(block.publish_ns)}
    return pa.RecordBatch.from_pydict(times | body)
