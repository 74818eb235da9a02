"""Recover the messages of a truncated or corrupt recording."""

from collections import Counter
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np
from mcap.records import Attachment, Chunk, McapRecord, Message, Metadata
from mcap.records import Channel as McapChannel

from dmrl.errors import RecordingError
from dmrl.guards import limits
from dmrl.recording import recovery_scan
from dmrl.recording.copying.chunk_copy import CopyUnit, adopt_definitions, write_unit
from dmrl.recording.mcap import checksums
from dmrl.recording.mcap.batch_reader import count_messages
from dmrl.recording.mcap.chunks.chunk import (
    ParsedChunk,
    batch_from_messages,
    decompress,
    parse_records,
)
from dmrl.recording.mcap.file import CORRUPTION_ERRORS, MAGIC, BoundedReader, over_budget_error
from dmrl.recording.mcap.message_batch import MessageBatch
from dmrl.recording.provenance import METADATA_NAME, Input, Provenance
from dmrl.recording.provenance_inputs import hash_file
from dmrl.recording.recovery_scan import Recovery, RecoveryState
from dmrl.recording.summary import Definitions, Summary
from dmrl.recording.writer import RECIPE_NAME, RecordingWriter


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
    with BoundedReader(path) as stream:
        if stream.size < len(MAGIC) or stream.read(len(MAGIC)) != MAGIC:
            raise RecordingError(
                f"{path} does not begin like a recording: nothing to recover. Make it again"
            )
        section = recovery_scan.read_listed_section(path, stream)
        state = RecoveryState(path=path, recovery=Recovery(), summary_section=section)
        for record in (*section.schemas.values(), *section.channels.values()):
            # A topic is defined in the chunk with its first message. If that chunk is corrupt,
            # later messages would have no topic.
            _register_record(state, record)
        pieces = _iter_units(stream, state)
        # dmrl writes the provenance before the first message, so read up to that first.
        first = next(pieces, None)
        if first is None and _is_worthless(state):
            raise RecordingError(f"{path} holds no whole chunk: nothing to recover. Make it again")
        with RecordingWriter(out, _build_provenance(state)) as sink:
            for piece in chain([first] if first else [], pieces):
                sink.chunk_writer.registry.adopt_channels(state.channels, state.channel_records)
                state.recovery.messages += write_unit(piece, None, sink)
            unused = state.channels.keys() - (+state.counts).keys()
            definitions = Definitions(state.schemas, state.channel_records, state.channels, unused)
            adopt_definitions(definitions, None, sink)
            sink.copy_extras(Summary({}, 0, 0, state.metadata, state.attachments))
    _complete_report(state)
    return state.recovery


def _is_worthless(state: RecoveryState) -> bool:
    """Return whether a damaged file without messages has nothing that dmrl does not make itself."""
    damaged = state.recovery.damaged_chunks or state.recovery.lost_bytes or not state.footer
    extras = {*state.metadata, *(one.name for one in state.attachments)}
    return bool(damaged) and extras <= {METADATA_NAME, RECIPE_NAME}


def _build_provenance(state: RecoveryState) -> Provenance:
    own = None
    if METADATA_NAME in state.metadata:
        try:
            own = Provenance.from_metadata(state.metadata[METADATA_NAME][-1])
        except (ValueError, KeyError, TypeError, RecursionError):
            own = None  # corrupt as well; the messages matter more
    source = Input(state.path.name, hash_file(state.path), own)
    return Provenance("recover", inputs=(source,))


def _iter_units(stream: BoundedReader, state: RecoveryState) -> Iterator[CopyUnit]:
    """Yield everything that is readable and has a known topic, in file order."""
    damaged = False  # whether the chunk before the next message indexes is corrupt
    for at, record in recovery_scan.iter_records(stream, state):
        if isinstance(record, Chunk):
            state.chunks += 1
            scan = _load_chunk(stream, state, record, at)
            damaged = scan is None
            if scan is not None:
                yield from _iter_valid_units(state, scan.batch, record, scan)
        elif isinstance(record, recovery_scan.IndexedCount):
            if damaged:
                state.skipped[record.channel] += record.messages
        elif isinstance(record, Message):
            yield from _iter_valid_units(state, batch_from_messages([record]))
        elif not _is_foreign_checksum(record, at):
            _register_record(state, record)
        else:
            state.extras += 1


def _is_foreign_checksum(record: McapRecord, at: int) -> bool:
    """Return whether this record contains the checksums of another file."""
    return (
        isinstance(record, Metadata)
        and record.name == checksums.METADATA_NAME
        and not checksums.belongs_to_file(record.metadata, at)
    )


def _load_chunk(
    stream: BoundedReader, state: RecoveryState, chunk: Chunk, at: int
) -> ParsedChunk | None:
    """Return the records of a chunk and register its definitions; None if it is corrupt."""
    try:
        scan = parse_records(decompress(chunk, at))
        found = list(scan.iter_definitions())
    except (RecordingError, *CORRUPTION_ERRORS):
        state.recovery.damaged_chunks += 1
        return None
    state.unpacked += len(scan.data)
    if state.unpacked > limits.max_unpacked_bytes(stream.size):
        raise over_budget_error(state.path, "it decompresses to much more than its size")
    for record in found:
        _register_record(state, record)
    return scan


def _iter_valid_units(
    state: RecoveryState,
    batch: MessageBatch,
    chunk: Chunk | None = None,
    others: ParsedChunk | None = None,
) -> Iterator[CopyUnit]:
    """Yield the messages of a batch that have a known topic and a valid time."""
    named = np.isin(batch.channel, list(state.channels))
    timed = batch.has_valid_times
    state.recovery.nameless += int((~named).sum())
    state.recovery.timeless += int((named & ~timed).sum())
    good = named & timed
    if not good.all():
        count_messages(state.left_out, batch.take(~good))
        batch, chunk = batch.take(good), None
    if len(batch):
        count_messages(state.counts, batch)
        yield CopyUnit(batch, state.channels, chunk, others)


def _register_record(state: RecoveryState, record: McapRecord) -> None:
    """Register a definition, metadata or an attachment."""
    if isinstance(record, McapChannel):
        if record.schema_id and record.schema_id not in state.schemas:
            state.incomplete[record.id] = record.topic
            return
        state.incomplete.pop(record.id, None)
    if wrong := state.add_record(record):
        state.recovery.contradictions.append(wrong)
    state.extras += isinstance(record, Metadata | Attachment)


def _complete_report(state: RecoveryState) -> None:
    """Complete the report: compare the recovered messages with the file's statistics."""
    recovery, section = state.recovery, state.summary_section
    statistics, found = section.statistics, state.counts.total()
    stated = Counter(statistics.channel_message_counts) if statistics is not None else None
    had = stated or state.counts + state.skipped
    for number, count in sorted((had - state.counts - state.left_out).items()):
        channel = state.channels.get(number)
        topic = channel.topic if channel else f"channel {number}"
        recovery.missing[topic] = recovery.missing.get(topic, 0) + count
    lost = sorted(set(state.incomplete.values()))
    recovery.contradictions += [f"the schema of {topic} is missing" for topic in lost]
    recovery.counted = statistics is not None
    if statistics is not None:
        unread = statistics.message_count - found - state.left_out.total()
        unknown = unread - sum(recovery.missing.values())
        if unknown > 0:
            recovery.missing["unknown"] = unknown
        if state.counts - had or unknown < 0:  # duplicates, or messages of another recording
            recovery.contradictions.append(
                f"its statistics disagree: {statistics.message_count} messages"
            )
        if statistics.metadata_count + statistics.attachment_count != state.extras:
            recovery.doubtful = True
    if section.chunk_indexes and len(section.chunk_indexes) != state.chunks:
        recovery.contradictions.append(
            f"its summary lists {len(section.chunk_indexes)} chunks, but it has {state.chunks}"
        )
    crc = state.metadata.get(checksums.METADATA_NAME)
    if crc and crc[-1].get("metadata") != checksums.format_crc(state.running_checksums.metadata):
        recovery.doubtful = True
    recovery.whole = (
        state.footer
        and not (recovery.doubtful or recovery.contradictions)
        and not (recovery.damaged_chunks or recovery.lost_bytes)
        and not (recovery.nameless or recovery.timeless or recovery.missing)
    )
