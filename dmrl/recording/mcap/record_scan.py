"""Read a whole MCAP file record by record, for files without an index."""

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
from dmrl.recording.mcap.chunk import loose, of_channels, scanned, unpacked
from dmrl.recording.mcap.file import Bounded, too_large
from dmrl.recording.mcap.message_batch import Block


@dataclass(slots=True)
class Walked:
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
    blocks: list[Block] = field(default_factory=list)
    metadata: dict[str, list[dict[str, str]]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)

    def counts(self) -> Counter[int]:
        """Count the messages of every channel id."""
        found: Counter[int] = Counter()
        for block in self.blocks:
            for number, count in zip(*np.unique(block.channel, return_counts=True), strict=True):
                found[int(number)] += int(count)
        return found


def walked(path: Path, stream: Bounded) -> Walked:
    """Read everything in a complete recording, with or without an index.

    Raises
    ------
    RecordingError, McapError, CRCValidationError
        If it is corrupt, or decompresses to more than the limit for its size.
    """
    stream.seek(0)
    walk, schemas, messages, size = Walked(), dict[int, Schema](), list[Message](), 0
    records = StreamReader(
        stream, emit_chunks=True, validate_crcs=True, record_size_limit=stream.size
    ).records
    for record in records:
        if isinstance(record, Chunk):
            size += record.uncompressed_size
            if size > limits.unpacked_bytes(stream.size):
                raise too_large(path, f"it unpacks to more than {size / 1e6:.0f} MB")
            scan = scanned(unpacked(path, record, stream.tell()))
            for definition in scan.definitions():
                _define(walk, schemas, definition)
            walk.blocks.append(of_channels(scan.block, walk.channels, walk.channels))
        elif isinstance(record, Message):
            messages.append(record)
        elif isinstance(record, Statistics):
            _compare(record, walk, messages)
        else:
            _define(walk, schemas, record)
    if messages:
        walk.blocks.append(of_channels(loose(messages), walk.channels, walk.channels))
    return walk


def _define(walk: Walked, schemas: dict[int, Schema], record: McapRecord) -> None:
    match record:
        case Schema():
            if schemas.setdefault(record.id, record) != record:
                raise McapError(f"schema {record.id} is defined twice, as two kinds")
        case McapChannel():
            channel = channel_of(record.id, {record.id: record}, schemas)
            if walk.channels.setdefault(record.id, channel) != channel:
                raise McapError(f"channel {record.id} is defined twice, as two topics")
        case Metadata():
            walk.metadata.setdefault(record.name, []).append(dict(record.metadata))
        case Attachment():
            walk.attachments[record.name] = record.data


def _compare(said: Statistics, walk: Walked, messages: list[Message]) -> None:
    found = walk.counts() + Counter(message.channel_id for message in messages)
    if said.message_count != found.total():
        raise McapError(f"{found.total()} of {said.message_count} messages are there")


def channel_of(
    number: int, channels: dict[int, McapChannel], schemas: dict[int, Schema]
) -> Channel:
    """Build the channel of a channel id from its Channel and Schema records.

    Raises
    ------
    McapError
        If the channel's schema is not among them.
    """
    channel = channels[number]
    schema = schemas.get(channel.schema_id)
    if schema is None and channel.schema_id != 0:
        raise McapError(f"no schema for {channel.topic}")
    metadata = tuple(sorted(channel.metadata.items()))
    if schema is None:
        return Channel(channel.topic, "", b"", "", channel.message_encoding, metadata)
    return Channel(
        channel.topic, schema.name, schema.data, schema.encoding, channel.message_encoding, metadata
    )
