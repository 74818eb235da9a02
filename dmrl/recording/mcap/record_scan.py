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

    def add_record(self, record: McapRecord) -> str:
        """Add a record; return how it contradicts an earlier one, or an empty text."""
        wrong = ""
        match record:
            case Schema():
                if self.schemas.get(record.id, record) != record:
                    wrong = f"schema {record.id}, {record.name}, is defined twice"
                self.schemas[record.id] = record
            case McapChannel():
                if self.channel_records.get(record.id, record) != record:
                    wrong = f"channel {record.id}, {record.topic}, is defined twice"
                self.channels.define(record, self.schemas)
                self.channel_records[record.id] = record
            case Metadata():
                self.metadata.setdefault(record.name, []).append(dict(record.metadata))
            case Attachment():
                self.attachments.append(record)
            case Statistics():
                self.statistics = record
        return wrong


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
                _add_or_refuse(content, definition)
            content.batches.append(select_channels(scan.batch, content.channels, content.channels))
        elif isinstance(record, Message):
            messages.append(record)
        else:
            _add_or_refuse(content, record)
    if more := stream.size - stream.tell():
        raise McapError(f"{more} bytes follow its end, as where two files were joined")
    if messages:
        content.batches.append(
            select_channels(batch_from_messages(messages), content.channels, content.channels)
        )
    return content


def _add_or_refuse(scanned: ScannedFile, record: McapRecord) -> None:
    if wrong := scanned.add_record(record):
        raise McapError(wrong)
