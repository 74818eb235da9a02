"""Read the records of a damaged recording one by one, and skip corrupt ones."""

import struct
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Chunk, McapRecord, Message, Metadata, Schema
from mcap.records import Channel as McapChannel
from mcap.summary import Summary as McapSummary

from dmrl.errors import RecordingError
from dmrl.recording.mcap import checksums
from dmrl.recording.mcap.extra_records import has_valid_crc
from dmrl.recording.mcap.file import CORRUPTION_ERRORS, MAGIC, RECORD_STRUCT, BoundedReader
from dmrl.recording.mcap.message_index import ENTRY_BYTES
from dmrl.recording.mcap.record_scan import ScannedFile
from dmrl.recording.mcap.summary_section import read_raw_section

MESSAGE_INDEX_HEADER = struct.Struct("<HI")
"""Of a Message Index record: channel id, bytes of entries."""


class IndexedCount(NamedTuple):
    """Number of messages that a message index lists for a channel."""

    channel: int
    messages: int


@dataclass(slots=True)
class Recovery:
    """Report about a recovered recording.

    Parameters
    ----------
    messages
        Messages written, bit-exact.
    damaged_chunks
        Chunks that were left out because they failed their CRC.
    nameless
        Messages left out because the definition of their topic was in a corrupt chunk.
    timeless
        Messages left out because their time is beyond the year 2262.
    lost_bytes
        Bytes outside of complete records: after the last one, or before the next listed one.
    missing
        Messages that were not read, by topic, as far as the file lists them. Their topic is
        "unknown" where the file states only how many there were. ``nameless`` and ``timeless``
        messages are not among them.
    counted
        Whether ``missing`` covers the whole file: its Statistics record was readable.
    contradictions
        False statements of the file about itself, a phrase each.
    doubtful
        Whether metadata or attachments are missing or fail their checksum. They are kept as they
        are.
    whole
        Whether the file has its footer and nothing was lost.
    """

    messages: int = 0
    damaged_chunks: int = 0
    nameless: int = 0
    timeless: int = 0
    lost_bytes: int = 0
    missing: dict[str, int] = field(default_factory=dict)
    counted: bool = False
    contradictions: list[str] = field(default_factory=list)
    doubtful: bool = False
    whole: bool = False


@dataclass(slots=True, kw_only=True)
class RecoveryState(ScannedFile):
    """State while the records of a file are read one after the other."""

    path: Path
    recovery: Recovery
    summary_section: McapSummary  # Summary section, as far as it can be read
    incomplete: dict[int, str] = field(default_factory=dict)  # topics without their schema
    counts: Counter[int] = field(default_factory=Counter)  # messages by channel id
    left_out: Counter[int] = field(default_factory=Counter)  # readable, of no topic or valid time
    skipped: Counter[int] = field(default_factory=Counter)  # in corrupt chunks, by their indexes
    running_checksums: checksums.Checksums = field(default_factory=checksums.Checksums)
    extras: int = 0  # number of metadata and attachments
    chunks: int = 0
    unpacked: int = 0
    footer: bool = False
    data_ended: bool = False


def read_listed_section(path: Path, stream: BoundedReader, start: int | None = None) -> McapSummary:
    """Read the Summary section at ``start`` or where the Footer points; empty if corrupt."""
    try:
        return read_raw_section(stream, start)[0] or McapSummary()
    except (RecordingError, *CORRUPTION_ERRORS):
        return McapSummary()


def iter_records(
    stream: BoundedReader, state: RecoveryState
) -> Iterator[tuple[int, McapRecord | IndexedCount]]:
    """Yield offset and record up to the footer, skipping corrupt ranges.

    Another recording that was joined to the file's end is read, too.
    """
    listed_offsets = sorted(_iter_listed_offsets(stream, state.summary_section))
    at = len(MAGIC)
    while at < stream.size and not state.footer:
        later = bisect_right(listed_offsets, at)
        edge = listed_offsets[later] if later < len(listed_offsets) else stream.size
        try:
            record, end = _parse_record_at(stream, state, at, edge)
        except CORRUPTION_ERRORS:  # continue at the next record that the Summary section lists
            state.recovery.lost_bytes += edge - at
            at = edge
            continue
        if record is not None:
            yield at, record
        at = end
        if state.footer and at + len(MAGIC) < stream.size:
            stream.seek(at)
            if stream.read(2 * len(MAGIC)) == 2 * MAGIC:
                state.footer, state.data_ended, at = False, False, at + 2 * len(MAGIC)
            else:
                state.recovery.lost_bytes += stream.size - at - len(MAGIC)


def _iter_listed_offsets(stream: BoundedReader, section: McapSummary) -> Iterator[int]:
    """Yield the offsets that the Summary section lists, where there is such a record."""
    listed = [
        *(
            (Opcode.CHUNK, one.chunk_start_offset, one.chunk_length)
            for one in section.chunk_indexes
        ),
        *((Opcode.METADATA, one.offset, one.length) for one in section.metadata_indexes),
        *((Opcode.ATTACHMENT, one.offset, one.length) for one in section.attachment_indexes),
    ]
    for opcode, at, length in listed:
        if at + length <= stream.size and length >= RECORD_STRUCT.size:
            stream.seek(at)
            head = stream.read(RECORD_STRUCT.size)
            if head == RECORD_STRUCT.pack(opcode, length - RECORD_STRUCT.size):
                yield at


def _parse_record_at(
    stream: BoundedReader, state: RecoveryState, at: int, edge: int
) -> tuple[McapRecord | IndexedCount | None, int]:
    """Read the record at an offset; return it, or None if it is unused, and its end.

    A record that would end after ``edge``, where a listed record starts, is corrupt.
    """
    stream.seek(at)
    opcode, length = RECORD_STRUCT.unpack(stream.read(RECORD_STRUCT.size))
    end = at + RECORD_STRUCT.size + length
    if end > edge:
        raise McapError("a record overlaps the next listed record")
    record = _parse_record(opcode, stream.read(length), state)
    if opcode == Opcode.DATA_END:
        state.data_ended = True
        if state.summary_section.statistics is None:
            state.summary_section = read_listed_section(state.path, stream, end)
    elif state.data_ended and opcode in (Opcode.CHUNK, Opcode.MESSAGE):
        state.recovery.doubtful = True  # not allowed after the data section
    state.footer |= opcode == Opcode.FOOTER
    return record, end


_RECORD_TYPES: dict[int, type[Any]] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: McapChannel,
    Opcode.CHUNK: Chunk,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
}


def _parse_record(
    opcode: int, body: bytes, state: RecoveryState
) -> McapRecord | IndexedCount | None:
    """Parse a record from its body; return None for an unused type."""
    if opcode == Opcode.MESSAGE:
        message: Message = Message.read(ReadDataStream(BytesIO(body)), len(body))
        return message
    if opcode == Opcode.MESSAGE_INDEX:
        number, size = MESSAGE_INDEX_HEADER.unpack_from(body)
        return IndexedCount(number, size // ENTRY_BYTES)
    if opcode not in _RECORD_TYPES:
        return None
    record: McapRecord = _RECORD_TYPES[opcode].read(ReadDataStream(BytesIO(body)))
    if isinstance(record, Attachment) and not has_valid_crc(record, body):
        state.recovery.doubtful = True
    if isinstance(record, Metadata) and record.name != checksums.METADATA_NAME:
        state.running_checksums.add_metadata(RECORD_STRUCT.pack(opcode, len(body)) + body)
    return record
