"""Split message batches by topic and decode them to Arrow columns."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from google.protobuf.descriptor import Descriptor

from dmrl.errors import UnreadableTopic
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.message_batch import MessageBatch
from dmrl.recording.protobuf.arrow_arrays import to_arrow
from dmrl.recording.protobuf.decode import decode
from dmrl.recording.protobuf.message_types import find_channel_descriptor
from dmrl.recording.protobuf.wire_format import WireError
from dmrl.terminal.progress import say_once

TIMES = {"log_time": "time_ns", "publish_time": "publish_ns"}
"""Columns in front of the fields, and the times of a batch that they hold."""


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
    """Decode the messages of one topic to columns, log time and publish time first.

    If the topic's channels have several message types, the columns are those of all types, null
    where a message's type lacks the field. A field that no common column can hold, or that has the
    name of a time, gets underscores behind its name.

    Raises
    ------
    RecordingError
        If a message is not of its type.
    """
    own = {n: c for n, c in channels.items() if c.topic == topic}
    kinds = {n: find_channel_descriptor(path, c) for n, c in own.items()}
    chosen = list(dict.fromkeys(kinds.values()))
    if len(chosen) == 1:
        return _decode_batch(path, topic, batch, chosen[0], fields)
    parts, rows = [], []
    for kind in chosen:
        these = np.flatnonzero(np.isin(batch.channel, [n for n, k in kinds.items() if k is kind]))
        parts.append(_decode_batch(path, topic, batch.take(these), kind, fields))
        rows.append(these)
    order = to_arrow(np.argsort(np.concatenate(rows)))
    joined = pa.concat_tables(_align_names(topic, parts), promote_options="permissive")
    return joined.take(order).combine_chunks().to_batches(max_chunksize=None)[0]


def _align_names(topic: str, parts: Sequence[pa.RecordBatch]) -> list[pa.Table]:
    """Rename columns whose types cannot be joined with the column of that name before them."""
    taken: dict[str, pa.DataType] = {}
    tables = []
    for part in parts:
        names = []
        for field in part.schema:
            name = field.name
            while name in taken and not _can_join(taken[name], field.type):
                name += "_"
            if name != field.name:
                say_once(f"{topic}: {field.name} has several types: one of them is {name}")
            taken.setdefault(name, field.type)
            names.append(name)
        tables.append(pa.Table.from_batches([part]).rename_columns(names))
    return tables


def _can_join(one: pa.DataType, other: pa.DataType) -> bool:
    """Return whether a column can hold the values of both types, each of them exactly."""
    if one == other:
        return True
    if pa.types.is_floating(one) != pa.types.is_floating(other):
        return False
    try:
        parts = [pa.schema([("", kind)]) for kind in (one, other)]
        pa.unify_schemas(parts, promote_options="permissive")
    except (pa.ArrowTypeError, pa.ArrowInvalid):
        return False
    return True


def _decode_batch(
    path: Path, topic: str, batch: MessageBatch, kind: Descriptor, fields: Sequence[str] | None
) -> pa.RecordBatch:
    """Decode messages of one type to columns, log time and publish time first."""
    try:
        body = decode(batch.data, batch.start, batch.end, kind, fields)
    except WireError as e:
        raise UnreadableTopic(path, topic, f"has messages that are not of its type ({e})") from e
    columns = {name: to_arrow(getattr(batch, of)) for name, of in TIMES.items()}
    for name, values in body.items():
        free = name
        while free in columns or (free != name and free in body):
            free += "_"
        if free != name:
            say_once(f"{topic}: the field {name} is column {free}, as {name} is the message's time")
        columns[free] = values
    return pa.RecordBatch.from_pydict(columns)
