"""Read a whole MCAP file record by record, where its Summary section is absent or incomplete."""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Attachment, Chunk, McapRecord, Message, Metadata, Schema, Statistics
from mcap.records import Channel as McapChannel
from mcap.stream_reader import StreamReader

from dmrl.guards import limits
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.chunk import (
    batch_from_messages,
    decompress,
    parse_records,
    select_channels,
)
from dmrl.recording.mcap.file import BoundedReader, over_budget_error
from dmrl.recording.mcap.message_batch import MessageBatch


@dataclass(slots=True)
class ScannedFile:
    """The content of a recording.

    Parameters
    ----------
    channels
        By channel id.
    batches
        Messages, in file order.
    metadata, attachments
        By name.
    """

    channels: dict[int, Channel] = field(default_factory=dict)
    batches: list[MessageBatch] = field(default_factory=list)
    metadata: dict[str, list[dict[str, str]]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)

    def count_messages(self) -> Counter[int]:
        """Count the messages of every channel id."""
        found: Counter[int] = Counter()
        for batch in self.batches:
            for number, count in zip(*np.unique(batch.channel, return_counts=True), strict=True):
                found[int(number)] += int(count)
        return found


def scan_file(path: Path, stream: BoundedReader) -> ScannedFile:
    """Read everything in a complete recording, with or without an index.

    Raises
    ------
    RecordingError, McapError, CRCValidationError
        If it is corrupt, or decompresses to more than the limit for its size.
    """
    stream.seek(0)
    content, schemas, messages, size = ScannedFile(), dict[int, Schema](), list[Message](), 0
    records = StreamReader(
        stream, emit_chunks=True, validate_crcs=True, record_size_limit=stream.size
    ).records
    for record in records:
        if isinstance(record, Chunk):
            size += record.uncompressed_size
            if size > limits.max_unpacked_bytes(stream.size):
                raise over_budget_error(path, f"it unpacks to more than {size / 1e6:.0f} MB")
            scan = parse_records(decompress(path, record, stream.tell()))
            for definition in scan.iter_definitions():
                _register_definition(content, schemas, definition)
            content.batches.append(select_channels(scan.batch, content.channels, content.channels))
        elif isinstance(record, Message):
            messages.append(record)
        elif isinstance(record, Statistics):
            _check_message_count(record, content, messages)
        else:
            _register_definition(content, schemas, record)
    if messages:
        content.batches.append(
            select_channels(batch_from_messages(messages), content.channels, content.channels)
        )
    return content


def _register_definition(
    scanned: ScannedFile, schemas: dict[int, Schema], record: McapRecord
) -> None:
    match record:
        case Schema():
            if schemas.setdefault(record.id, record) != record:
                raise McapError(f"schema {record.id} is defined twice, as two kinds")
        case McapChannel():
            channel = build_channel(record.id, {record.id: record}, schemas)
            if scanned.channels.setdefault(record.id, channel) != channel:
                raise McapError(f"channel {record.id} is defined twice, as two topics")
        case Metadata():
            scanned.metadata.setdefault(record.name, []).append(dict(record.metadata))
        case Attachment():
            scanned.attachments[record.name] = record.data


def _check_message_count(
    statistics: Statistics, scanned: ScannedFile, messages: list[Message]
) -> None:
    found = scanned.count_messages() + Counter(message.channel_id for message in messages)
    if statistics.message_count != found.total():
        raise McapError(f"{found.total()} of {statistics.message_count} messages are there")


def build_channel(
    channel_id: int, channels: dict[int, McapChannel], schemas: dict[int, Schema]
) -> Channel:
    """Build the channel of a channel id from its Channel and Schema records.

    Raises
    ------
    McapError
        If the channel's schema is not among them.
    """
    channel = channels[channel_id]
    schema = schemas.get(channel.schema_id)
    if schema is None and channel.schema_id != 0:
        raise McapError(f"no schema for {channel.topic}")
    metadata = tuple(sorted(channel.metadata.items()))
    if schema is None:
        return Channel(channel.topic, "", b"", "", channel.message_encoding, metadata)
    return Channel(
        channel.topic, schema.name, schema.data, schema.encoding, channel.message_encoding, metadata
    )
