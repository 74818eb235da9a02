"""Recover the messages of a truncated or corrupt recording."""

import struct
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Chunk,
    McapRecord,
    Message,
    Metadata,
    Schema,
)
from mcap.records import Channel as McapChannel
from mcap.summary import Summary as McapSummary

from dmrl.errors import RecordingError
from dmrl.guards import limits
from dmrl.recording.attachments import copy_extras
from dmrl.recording.copying.chunk_copy import Piece, put
from dmrl.recording.mcap import checksums
from dmrl.recording.mcap.batch_reader import tally
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.chunk import loose, scanned, unpacked
from dmrl.recording.mcap.file import DAMAGE, MAGIC, RECORD, Bounded, too_large
from dmrl.recording.mcap.message_batch import Block
from dmrl.recording.mcap.message_index import ENTRY_BYTES
from dmrl.recording.mcap.record_scan import channel_of
from dmrl.recording.mcap.summary_section import places, stated
from dmrl.recording.provenance import METADATA_NAME, Input, Provenance
from dmrl.recording.provenance_inputs import sha256_of_file
from dmrl.recording.recovery import Recovery
from dmrl.recording.summary import Summary
from dmrl.recording.writer import RecordingWriter

INDEX_HEAD = struct.Struct("<HI")  # of a Message Index record: channel id, bytes of entries


class _Indexed(NamedTuple):
    """Number of messages that a message index lists for a channel."""

    channel: int
    messages: int


@dataclass(slots=True)
class _Walk:
    """State while the records of a file are read one after the other."""

    path: Path
    recovery: Recovery
    end: McapSummary  # Summary section, as far as it can be read
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    numbered: dict[int, McapChannel] = field(default_factory=dict)  # Channel records
    metadata: dict[str, list[dict[str, str]]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    found: Counter[int] = field(default_factory=Counter)  # messages by channel id
    skipped: Counter[int] = field(default_factory=Counter)  # in corrupt chunks, by their indexes
    summed: checksums.Sums = field(default_factory=checksums.Sums)
    extras: int = 0  # number of metadata and attachments
    chunks: int = 0
    unpacked: int = 0
    footer: bool = False
    data_ended: bool = False


def recover(path: Path, out: Path) -> Recovery:
    """Write a complete recording with every message that can still be read.

    Chunks that fail their CRC are left out; later chunks are kept.

    Parameters
    ----------
    path
        A truncated or corrupt recording, such as a ``.partial`` file.
    out
        Recording to write.

    Raises
    ------
    RecordingError
        If ``path`` does not begin as a recording, no message can be recovered, or it decompresses
        to more than the limit for its size.
    OutputError
        If ``out`` exists or cannot be written.
    """
    if not path.is_file():
        raise RecordingError(f"no recording {path}. Check the name")
    with Bounded(path) as stream:
        if stream.size < len(MAGIC) or stream.read(len(MAGIC)) != MAGIC:
            raise RecordingError(
                f"{path} does not begin like a recording: nothing to recover. Make it again"
            )
        walk = _Walk(path, Recovery(), _end(path, stream))
        for record in (*walk.end.schemas.values(), *walk.end.channels.values()):
            # A topic is defined in the chunk with its first message. If that chunk is corrupt,
            # later messages would have no topic.
            _define(walk, record)
        pieces = _pieces(stream, walk)
        # dmrl writes the provenance before the first message, so read up to that first.
        first = next(pieces, None)
        if first is None:
            raise RecordingError(f"{path} holds no whole chunk: nothing to recover. Make it again")
        with RecordingWriter(out, _provenance(walk)) as sink:
            for piece in chain([first], pieces):
                sink.chunks.adopt(walk.channels, walk.numbered)
                walk.recovery.messages += put(piece, None, sink)
            copy_extras(Summary({}, 0, 0, walk.metadata, walk.attachments), sink)
    _account(walk)
    return walk.recovery


def _provenance(walk: _Walk) -> Provenance:
    own = None
    if METADATA_NAME in walk.metadata:
        try:
            own = Provenance.from_metadata(walk.metadata[METADATA_NAME][-1])
        except (ValueError, KeyError, TypeError, RecursionError):
            own = None  # corrupt as well; the messages matter more
    source = Input(walk.path.name, sha256_of_file(walk.path), own)
    return Provenance("recover", inputs=(source,))


def _end(path: Path, stream: Bounded, start: int | None = None) -> McapSummary:
    """Read the Summary section at ``start`` or where the Footer points; empty if corrupt."""
    try:
        return stated(path, stream, start)[0] or McapSummary()
    except (RecordingError, *DAMAGE):
        return McapSummary()


def _pieces(stream: Bounded, walk: _Walk) -> Iterator[Piece]:
    """Yield everything that is readable and has a known topic, in file order."""
    damaged = False  # whether the chunk before the next message indexes is corrupt
    for at, record in _records(stream, walk):
        if isinstance(record, Chunk):
            walk.chunks += 1
            block = _unpacked(stream, walk, record, at)
            damaged = block is None
            if block is not None:
                yield from _named(walk, block, record)
        elif isinstance(record, _Indexed):
            if damaged:
                walk.skipped[record.channel] += record.messages
        elif isinstance(record, Message):
            yield from _named(walk, loose([record]), None)
        elif not _copied_sums(record, at):
            _define(walk, record)
        else:
            walk.extras += 1


def _copied_sums(record: McapRecord, at: int) -> bool:
    """Return whether this record contains the checksums of another file."""
    return (
        isinstance(record, Metadata)
        and record.name == checksums.METADATA_NAME
        and not checksums.of_this_file(record.metadata, at)
    )


def _unpacked(stream: Bounded, walk: _Walk, chunk: Chunk, at: int) -> Block | None:
    """Return the messages of a chunk and register its definitions; None if it is corrupt."""
    try:
        scan = scanned(unpacked(walk.path, chunk, at))
        found = list(scan.definitions())
    except (RecordingError, *DAMAGE):
        walk.recovery.damaged_chunks += 1
        return None
    walk.unpacked += len(scan.data)
    if walk.unpacked > limits.unpacked_bytes(stream.size):
        raise too_large(walk.path, "it unpacks to much more than its size")
    for record in found:
        _define(walk, record)
    return scan.block


def _named(walk: _Walk, block: Block, chunk: Chunk | None) -> Iterator[Piece]:
    """Yield the messages of a batch that have a known topic and a valid time."""
    named = np.isin(block.channel, list(walk.channels))
    timed = block.possible
    walk.recovery.nameless += int((~named).sum())
    walk.recovery.timeless += int((named & ~timed).sum())
    good = named & timed
    if not good.all():
        block, chunk = block.take(good), None
    if len(block):
        tally(walk.found, block)
        yield Piece(block, walk.channels, chunk)


def _records(stream: Bounded, walk: _Walk) -> Iterator[tuple[int, McapRecord | _Indexed]]:
    """Yield offset and record up to the footer, skipping corrupt ranges."""
    known = sorted(start for start, _ in places(walk.end))
    at = len(MAGIC)
    while at < stream.size and not walk.footer:
        later = bisect_right(known, at)
        edge = known[later] if later < len(known) else stream.size
        try:
            record, end = _record_at(stream, walk, at, edge)
        except DAMAGE:  # continue at the next record that the Summary section lists
            walk.recovery.lost_bytes += edge - at
            at = edge
            continue
        if record is not None:
            yield at, record
        at = end


def _record_at(
    stream: Bounded, walk: _Walk, at: int, edge: int
) -> tuple[McapRecord | _Indexed | None, int]:
    """Read the record at an offset; return it, or None if it is unused, and its end.

    A record that would end after ``edge``, where a listed record starts, is corrupt.
    """
    stream.seek(at)
    opcode, length = RECORD.unpack(stream.read(RECORD.size))
    end = at + RECORD.size + length
    if end > edge:
        raise McapError("a record overlaps the next listed record")
    record = _parsed(opcode, stream.read(length), walk)
    if opcode == Opcode.DATA_END:
        walk.data_ended = True
        if walk.end.statistics is None:
            walk.end = _end(walk.path, stream, end)
    elif walk.data_ended and opcode in (Opcode.CHUNK, Opcode.MESSAGE):
        walk.recovery.doubtful = True  # not allowed after the data section
    walk.footer |= opcode == Opcode.FOOTER
    return record, end


_KINDS: dict[int, type[Any]] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: McapChannel,
    Opcode.CHUNK: Chunk,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
}


def _parsed(opcode: int, body: bytes, walk: _Walk) -> McapRecord | _Indexed | None:
    """Parse a record from its body; return None for an unused type."""
    if opcode == Opcode.MESSAGE:
        message: Message = Message.read(ReadDataStream(BytesIO(body)), len(body))
        return message
    if opcode == Opcode.MESSAGE_INDEX:
        number, size = INDEX_HEAD.unpack_from(body)
        return _Indexed(number, size // ENTRY_BYTES)
    if opcode not in _KINDS:
        return None
    record: McapRecord = _KINDS[opcode].read(ReadDataStream(BytesIO(body)))
    if isinstance(record, Attachment) and zlib.crc32(body[:-4]) != (
        int.from_bytes(body[-4:], "little") or zlib.crc32(body[:-4])
    ):
        walk.recovery.doubtful = True
    if isinstance(record, Metadata) and record.name != checksums.METADATA_NAME:
        walk.summed.add_metadata(RECORD.pack(opcode, len(body)) + body)
    return record


def _define(walk: _Walk, record: McapRecord) -> None:
    """Register a definition, metadata record or attachment."""
    match record:
        case Schema():
            walk.schemas[record.id] = record
        case McapChannel() if not record.schema_id or record.schema_id in walk.schemas:
            walk.channels[record.id] = channel_of(record.id, {record.id: record}, walk.schemas)
            walk.numbered[record.id] = record
        case Metadata():
            walk.extras += 1
            walk.metadata.setdefault(record.name, []).append(dict(record.metadata))
        case Attachment():
            walk.extras += 1
            walk.attachments[record.name] = record.data


def _account(walk: _Walk) -> None:
    """Complete the report: compare the recovered messages with the file's statistics."""
    recovery, said = walk.recovery, walk.end.statistics
    had = Counter(said.channel_message_counts) if said is not None else walk.found + walk.skipped
    for number, count in sorted((had - walk.found).items()):
        channel = walk.channels.get(number)
        topic = channel.topic if channel else f"channel {number}"
        recovery.missing[topic] = recovery.missing.get(topic, 0) + count
    recovery.counted = said is not None
    if said is not None and said.metadata_count + said.attachment_count != walk.extras:
        recovery.doubtful = True
    crc = walk.metadata.get(checksums.METADATA_NAME)
    if crc and crc[-1].get("metadata") != checksums.text(walk.summed.metadata):
        recovery.doubtful = True
    recovery.whole = (
        walk.footer
        and walk.chunks == (len(walk.end.chunk_indexes) or walk.chunks)
        and not recovery.doubtful
        and not (recovery.damaged_chunks or recovery.lost_bytes)
        and not (recovery.nameless or recovery.timeless)
        and not recovery.missing
        and not walk.found - had  # duplicates, or messages of another recording
    )
