"""Split message batches by topic and decode them to Arrow columns."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from google.protobuf.descriptor import Descriptor

from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.file import corrupt_error
from dmrl.recording.mcap.message_batch import MessageBatch
from dmrl.recording.protobuf.decode import decode
from dmrl.recording.protobuf.message_types import find_channel_descriptor, require_one_type
from dmrl.recording.protobuf.wire_values import WireError


def decode_by_topic(
    path: Path,
    batch: MessageBatch,
    channels: Mapping[int, Channel],
    fields: Mapping[str, Sequence[str] | None],
) -> dict[str, pa.RecordBatch]:
    """Decode the messages of a batch to columns, by topic."""
    return {
        topic: decode_topic(path, topic, mine, channels, fields[topic])
        for topic, mine in group_by_topic(batch, channels).items()
    }


def group_by_topic(batch: MessageBatch, channels: Mapping[int, Channel]) -> dict[str, MessageBatch]:
    """Split a batch by topic, keeping the order of the messages."""
    topics = sorted({channels[number].topic for number in batch.list_channel_ids()})
    place = np.full(max(channels, default=0) + 1, -1, np.int64)
    for number, channel in channels.items():
        if channel.topic in topics:
            place[number] = topics.index(channel.topic)
    key = place[batch.channel]
    order = np.argsort(key, kind="stable")
    ends = np.searchsorted(key[order], np.arange(len(topics)), side="right")
    rows = np.split(order, ends[:-1])
    return {topic: batch.take(own) for topic, own in zip(topics, rows, strict=False)}


def decode_topic(
    path: Path,
    topic: str,
    batch: MessageBatch,
    channels: Mapping[int, Channel],
    fields: Sequence[str] | None,
) -> pa.RecordBatch:
    """Decode the messages of one topic to columns.

    Raises
    ------
    RecordingError
        If the topic has several message types, or a message is not of its type.
    """
    numbers = batch.list_channel_ids()
    own = [n for n, channel in channels.items() if channel.topic == topic]
    kinds = {find_channel_descriptor(path, channels[number]) for number in numbers or own}
    return _decode_batch(path, topic, batch, require_one_type(path, topic, kinds), fields)


def _decode_batch(
    path: Path, topic: str, batch: MessageBatch, kind: Descriptor, fields: Sequence[str] | None
) -> pa.RecordBatch:
    try:
        return to_record_batch(batch, kind, fields)
    except WireError as e:
        raise corrupt_error(path, f"{topic}: {e}") from e


def to_record_batch(
    batch: MessageBatch, kind: Descriptor, fields: Sequence[str] | None
) -> pa.RecordBatch:
    """Decode messages of one type to columns, log time and publish time first."""
    body = decode(batch.data, batch.start, batch.end, kind, fields)
    times = {"log_time": pa.array(batch.time_ns), "publish_time": pa.array(batch.publish_ns)}
    return pa.RecordBatch.from_pydict(times | body)
