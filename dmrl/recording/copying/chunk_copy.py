"""Copy messages from recording to recording by the chunk, without a loop over messages.

A chunk is copied compressed if all of it is selected, it holds only images or only numbers, and
its channels have the same ids in the output. Otherwise its selected records are copied as slices.
Each chunk's CRC and indexes are verified first.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from mcap.records import Chunk, ChunkIndex
from numpy.typing import NDArray

from dmrl.recording.mcap.batch_reader import count_messages, select_chunks
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.chunks.chunk import ParsedChunk
from dmrl.recording.mcap.chunks.chunk_reader import locate_chunk, read_chunk_for_copy
from dmrl.recording.mcap.file import open_mcap
from dmrl.recording.mcap.message_batch import MAX_TIME_NS, MessageBatch
from dmrl.recording.mcap.message_count import check_counts
from dmrl.recording.mcap.message_index import MessageIndex
from dmrl.recording.mcap.record_scan import scan_file
from dmrl.recording.mcap.summary_section import read_summary_section
from dmrl.recording.summary import Definitions, read_summary
from dmrl.recording.writer import RecordingWriter


@dataclass(frozen=True, slots=True)
class CopyUnit:
    """A chunk of a recording, or the messages outside of chunks.

    Parameters
    ----------
    batch
        All messages of the unit.
    channels
        By channel id; may contain further channels of the recording.
    chunk
        The compressed chunk with exactly these messages. None: they must be copied as slices.
    others
        Other records of the chunk.
    index
        Verified message indexes of the chunk, or None.
    """

    batch: MessageBatch
    channels: Mapping[int, Channel]
    chunk: Chunk | None = None
    others: ParsedChunk | None = None
    index: MessageIndex | None = None

    @property
    def start_ns(self) -> int:
        """First log time, nanoseconds."""
        return int(self.batch.time_ns.min(initial=MAX_TIME_NS))


@dataclass(frozen=True, slots=True)
class TopicSelection:
    """Selection of messages by topic and time.

    Parameters
    ----------
    topics
        Topics to copy.
    low_ns, high_ns
        Log times to copy, in [low_ns, high_ns), nanoseconds.
    """

    topics: frozenset[str]
    low_ns: int = 0
    high_ns: int = MAX_TIME_NS

    def mask_rows(self, unit: CopyUnit) -> NDArray[np.bool_]:
        """Return an (N,) mask of the selected messages of a unit."""
        batch, present = unit.batch, unit.batch.list_channel_ids()
        topics = {number: unit.channels[number].topic for number in present}
        in_range = np.asarray((batch.time_ns >= self.low_ns) & (batch.time_ns < self.high_ns))
        if in_range.all() and self.topics.issuperset(topics.values()):
            return in_range
        mine = batch.mask_channels([n for n, topic in topics.items() if topic in self.topics])
        return np.asarray(mine & in_range)


def copy_messages(path: Path, selection: TopicSelection, sink: RecordingWriter) -> int:
    """Copy messages into another recording, and return how many.

    Raises
    ------
    RecordingError
        If the file is not a complete recording, or a chunk is corrupt.
    OutputError
        If the output cannot be written.
    """
    adopt_channels(path, selection.topics, sink)
    return sum(write_unit(piece, selection, sink) for piece in iter_units(path, selection))


def adopt_channels(path: Path, topics: Collection[str], sink: RecordingWriter) -> None:
    """Keep the ids of a recording's channels of some topics in the output, where they are free.

    Its channels without messages are kept as well, and its schemas without channels.
    """
    adopt_definitions(read_summary(path).definitions, topics, sink)


def adopt_definitions(
    found: Definitions, topics: Collection[str] | None, sink: RecordingWriter
) -> None:
    """Do what `adopt_channels` does for definitions that were read (topics None: for all)."""
    kept = {n: c for n, c in found.channels.items() if topics is None or c.topic in topics}
    sink.chunk_writer.registry.adopt_channels(kept, found.channel_records)
    unused = [channel for n, channel in kept.items() if n in found.unused]
    needed = {record.schema_id for record in found.channel_records.values()}
    schemas = [schema for number, schema in found.schemas.items() if number not in needed]
    sink.chunk_writer.registry.keep_definitions(unused, schemas)


def write_unit(unit: CopyUnit, selection: TopicSelection | None, sink: RecordingWriter) -> int:
    """Copy the selected messages of a unit (None: all), and return how many."""
    batch = unit.batch
    count = len(batch)
    if selection is not None:
        rows = selection.mask_rows(unit)
        count = int(rows.sum())
        if not rows.all():
            batch, unit = batch.take(rows), replace(unit, chunk=None)
    whole, others = unit.chunk, unit.others
    if len(batch) and not (
        whole is not None
        and others is not None
        and sink.chunk_writer.append_chunk(whole, batch, others, unit.channels, unit.index)
    ):
        sink.chunk_writer.append_batch(batch, unit.channels)
    return count


def iter_units(path: Path, selection: TopicSelection) -> Iterator[CopyUnit]:
    """Yield the chunks with selected messages, each decompressed once and verified.

    They come by time, as far as the messages of every topic keep their order.

    Raises
    ------
    RecordingError
        If the file is not a complete recording, or a chunk is corrupt.
    """
    with open_mcap(path) as stream:
        summary = read_summary_section(stream)
        if summary is None:
            walk = scan_file(stream)
            yield from (CopyUnit(block, walk.channels) for block in walk.batches)
            return
        channels = summary.channels_by_id
        counts: Counter[int] = Counter()
        kept = {n: channel for n, channel in channels.items() if channel.topic in selection.topics}
        near = select_chunks(summary, kept.keys(), selection.low_ns, selection.high_ns)
        chunks = _sort_by_time(near)
        stream.expect_reads([locate_chunk(index) for index in chunks])
        for index in chunks:
            chunk, batch, others, messages = read_chunk_for_copy(stream, index, summary)
            count_messages(counts, batch)
            yield CopyUnit(batch, channels, chunk, others, messages)
        if (selection.low_ns, selection.high_ns) == (0, MAX_TIME_NS):
            check_counts(summary.statistics, kept, counts)


def _sort_by_time(chunks: Iterable[ChunkIndex]) -> list[ChunkIndex]:
    """Sort chunks by their first log time, but keep the file's order of those with a shared topic.

    In a file that was written topic by topic, the chunk with the last messages of one topic and the
    first of the next begins earlier than the one before it.
    """
    latest: dict[int, int] = {}
    keyed = []
    for chunk in sorted(chunks, key=lambda chunk: chunk.chunk_start_offset):
        topics = chunk.message_index_offsets
        start_ns = max([chunk.message_start_time, *(latest.get(n, 0) for n in topics)])
        latest.update(dict.fromkeys(topics, start_ns))
        keyed.append((start_ns, chunk))
    return [chunk for _, chunk in sorted(keyed, key=lambda item: item[0])]
