"""Read a whole MCAP file record by record, where its Summary section is absent or incomplete."""

from dataclasses import dataclass, field

from mcap.exceptions import McapError
from mcap.records import Attachment, Chunk, McapRecord, Message, Metadata, Schema, Statistics
from mcap.records import Channel as McapChannel
from mcap.stream_reader import StreamReader

from dmrl.guards import limits
from dmrl.recording.mcap.channel import ChannelTable
from dmrl.recording.mcap.chunks.chunk import (
    batch_from_messages,
    decompress,
    parse_records,
    select_channels,
)
from dmrl.recording.mcap.file import BoundedReader, BudgetError
from dmrl.recording.mcap.message_batch import MessageBatch


@dataclass(slots=True)
class ScannedFile:
    """The content of a recording.

    Parameters
    ----------
    schemas, channel_records
        Schema and Channel records, by id.
    channels
        By channel id.
    batches
        Messages, in file order.
    metadata
        By name.
    attachments
        In file order.
    statistics
        The Statistics record, if there is one.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channel_records: dict[int, McapChannel] = field(default_factory=dict)
    channels: ChannelTable = field(default_factory=ChannelTable)
    batches: list[MessageBatch] = field(default_factory=list)
    metadata: dict[str, list[dict[str, str]]] = field(default_factory=dict)
    attachments: list[Attachment] = field(default_factory=list)
    statistics: Statistics | None = None


def scan_file(stream: BoundedReader) -> ScannedFile:
    """Read everything in a complete recording, with or without an index.

    Raises
    ------
    McapError, CRCValidationError
        If it is corrupt, or decompresses to more than the limit for its size.
    """
    stream.seek(0)
    content, messages, size = ScannedFile(), list[Message](), 0
    records = StreamReader(
        stream, emit_chunks=True, validate_crcs=True, record_size_limit=stream.size
    ).records
    for record in records:
        if isinstance(record, Chunk):
            size += record.uncompressed_size
            if size > limits.max_unpacked_bytes(stream.size):
                raise BudgetError(f"it decompresses to more than {size / 1e6:.0f} MB")
            scan = parse_records(decompress(record, stream.tell()))
            for definition in scan.iter_definitions():
                _register_record(content, definition)
            content.batches.append(select_channels(scan.batch, content.channels, content.channels))
        elif isinstance(record, Message):
            messages.append(record)
        else:
            _register_record(content, record)
    if messages:
        content.batches.append(
            select_channels(batch_from_messages(messages), content.channels, content.channels)
        )
    return content


def _register_record(scanned: ScannedFile, record: McapRecord) -> None:
    match record:
        case Schema():
            if scanned.schemas.setdefault(record.id, record) != record:
                raise McapError(f"schema {record.id} is defined twice, as two kinds")
        case McapChannel():
            if scanned.channel_records.setdefault(record.id, record) != record:
                raise McapError(f"channel {record.id} is defined twice, as two topics")
            scanned.channels.define(record, scanned.schemas)
        case Metadata():
            scanned.metadata.setdefault(record.name, []).append(dict(record.metadata))
        case Attachment():
            scanned.attachments.append(record)
        case Statistics():
            scanned.statistics = record
