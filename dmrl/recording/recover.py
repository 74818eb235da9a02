"""Bringing back what a killed or damaged recording still holds."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Attachment, Chunk, Footer, McapRecord, Message, Metadata, Schema
from mcap.records import Channel as McapChannel
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from dmrl.errors import RecordingError
from dmrl.recording.blocks import unpacked
from dmrl.recording.extras import copy_extras
from dmrl.recording.index import MAGIC, Summary, channel_of
from dmrl.recording.inputs import sha256_of_file
from dmrl.recording.provenance import METADATA_NAME, Input, Provenance
from dmrl.recording.writer import Channel, RawMessage, RecordingWriter


@dataclass(slots=True)
class Recovery:
    """What was brought back.

    Parameters
    ----------
    messages
        Messages written, bit-exact.
    damaged_chunks
        Chunks within the file that failed their CRC and were left out.
    nameless
        Messages left out because what defines their topic was in a damaged chunk.
    lost_bytes
        Bytes after the last whole record.
    whole
        Whether the file has its footer and nothing was lost.
    """

    messages: int = 0
    damaged_chunks: int = 0
    nameless: int = 0
    lost_bytes: int = 0
    whole: bool = False


@dataclass(slots=True)
class _Walk:
    """State while the records of a file are read one after the other."""

    path: Path
    recovery: Recovery
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: dict[str, list[dict[str, str]]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)


def recover(path: Path, out: Path) -> Recovery:
    """Write a complete recording with every message before the damage.

    Chunks in the middle that fail their CRC are left out; what follows them is kept.

    Parameters
    ----------
    path
        A recording that was cut short or damaged, ``.partial`` for instance.
    out
        Recording to write.

    Raises
    ------
    RecordingError
        If ``path`` does not begin as a recording, or no message can be brought back.
    OutputError
        If ``out`` exists or cannot be written.
    """
    if not path.is_file():
        raise RecordingError(f"no recording {path}. Check the name")
    recovery = Recovery()
    with path.open("rb") as stream:
        if stream.read(len(MAGIC)) != MAGIC:
            raise RecordingError(
                f"{path} does not begin as a recording: nothing to recover. Make it again"
            )
        walk = _Walk(path, recovery)
        _take_summary(stream, walk)
        stream.seek(0)
        messages = _messages(stream, walk)
        # Our provenance stands before the first message: it is known once that is reached.
        first = next(messages, None)
        if first is None:
            raise RecordingError(f"{path} holds no whole chunk: nothing to recover. Make it again")
        with RecordingWriter(out, _provenance(walk)) as sink:
            sink.write_raw(first)
            recovery.messages = 1
            for raw in messages:
                sink.write_raw(raw)
                recovery.messages += 1
            copy_extras(Summary({}, 0, 0, walk.metadata, walk.attachments), sink)
    return recovery


def _provenance(walk: _Walk) -> Provenance:
    own = None
    if METADATA_NAME in walk.metadata:
        try:
            own = Provenance.from_metadata(walk.metadata[METADATA_NAME][-1])
        except (ValueError, KeyError, TypeError):
            own = None  # damaged like the rest; the messages are what is wanted
    source = Input(walk.path.name, sha256_of_file(walk.path), own)
    return Provenance("recover", inputs=(source,))


def _take_summary(stream: BinaryIO, walk: _Walk) -> None:
    """Definitions of topics as the end of a whole file repeats them.

    A topic is defined in the chunk that has its first message. If that is damaged, all later ones
    would be nameless.
    """
    stream.seek(0)
    try:
        found = make_reader(stream).get_summary()
    except (McapError, CRCValidationError, struct.error, OSError, MemoryError, ValueError):
        return  # cut short: there is none
    for record in (*found.schemas.values(), *found.channels.values()) if found else ():
        for _ in _take(record, walk):
            pass


def _messages(stream: BinaryIO, walk: _Walk) -> Iterator[RawMessage]:
    for record in _records(stream, walk):
        if not isinstance(record, Chunk):
            yield from _take(record, walk)
            continue
        try:
            unpacked(walk.path, record, stream.tell())
        except RecordingError:
            walk.recovery.damaged_chunks += 1
            continue
        for inner in breakup_chunk(record):
            yield from _take(inner, walk)


def _records(stream: BinaryIO, walk: _Walk) -> Iterator[McapRecord]:
    """Whole records up to the footer or the damage; notes what is lost behind it."""
    good = len(MAGIC)
    try:
        for record in StreamReader(stream, emit_chunks=True).records:
            good = stream.tell()
            if isinstance(record, Footer):
                walk.recovery.whole = not walk.recovery.damaged_chunks
                return
            yield record
    except (McapError, CRCValidationError, struct.error, OSError, MemoryError, ValueError):
        walk.recovery.lost_bytes = walk.path.stat().st_size - good


def _take(record: McapRecord, walk: _Walk) -> Iterator[RawMessage]:
    match record:
        case Schema():
            walk.schemas[record.id] = record
        case McapChannel() if not record.schema_id or record.schema_id in walk.schemas:
            walk.channels[record.id] = channel_of(record.id, {record.id: record}, walk.schemas)
        case Metadata():
            walk.metadata.setdefault(record.name, []).append(dict(record.metadata))
        case Attachment():
            walk.attachments[record.name] = record.data
        case Message():
            channel = walk.channels.get(record.channel_id)
            if channel is None:
                walk.recovery.nameless += 1
            else:
                yield RawMessage(record.log_time, record.publish_time, channel, record.data)
