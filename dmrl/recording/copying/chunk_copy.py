"""Copy messages from recording to recording by the chunk, without a loop over messages.

A chunk is copied compressed if all of it is selected, it holds only images or only numbers, and
its channels have the same ids in the output. Otherwise its selected records are copied as slices.
Each chunk's CRC and indexes are verified first.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from mcap.records import Chunk, ChunkIndex
from mcap.summary import Summary as McapSummary
from numpy.typing import NDArray

from dmrl.recording.mcap.batch_reader import chunks_between, compare, tally
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.chunk_reader import place_of, whole_chunk
from dmrl.recording.mcap.file import opened
from dmrl.recording.mcap.message_batch import EVER_NS, Block
from dmrl.recording.mcap.message_index import MessageIndex
from dmrl.recording.mcap.record_scan import channel_of, walked
from dmrl.recording.mcap.summary_index import mcap_summary
from dmrl.recording.writer import RecordingWriter


@dataclass(frozen=True, slots=True)
class Piece:
    """A chunk of a recording, or the messages outside of chunks.

    Parameters
    ----------
    batch
        All messages of the unit.
    channels
        By channel id; may contain further channels of the recording.
    chunk
        The compressed chunk with exactly these messages. None: they must be copied as slices.
    index
        Verified message indexes of the chunk, or None.
    """

    block: Block
    channels: Mapping[int, Channel]
    chunk: Chunk | None = None
    index: MessageIndex | None = None

    @property
    def start_ns(self) -> int:
        """First log time, nanoseconds."""
        return int(self.block.time_ns.min(initial=EVER_NS))


@dataclass(frozen=True, slots=True)
class Wanted:
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
    high_ns: int = EVER_NS

    def rows(self, piece: Piece) -> NDArray[np.bool_]:
        """Return an (N,) mask of the selected messages of a unit."""
        block, present = piece.block, piece.block.numbers()
        topics = {number: piece.channels[number].topic for number in present}
        of_time = np.asarray((block.time_ns >= self.low_ns) & (block.time_ns < self.high_ns))
        if of_time.all() and self.topics.issuperset(topics.values()):
            return of_time
        mine = block.among([n for n, topic in topics.items() if topic in self.topics])
        return np.asarray(mine & of_time)


def copy(path: Path, wanted: Wanted, sink: RecordingWriter) -> int:
    """Copy messages into another recording, and return how many.

    Raises
    ------
    RecordingError
        If the file is not a complete recording, or a chunk is corrupt.
    OutputError
        If the output cannot be written.
    """
    adopt(path, wanted.topics, sink)
    return sum(put(piece, wanted, sink) for piece in pieces(path, wanted))


def adopt(path: Path, topics: Collection[str], sink: RecordingWriter) -> None:
    """Assign the channel ids of a recording to its topics in the output, where they are free."""
    with opened(path) as stream:
        summary = mcap_summary(path, stream)
        if summary is not None:
            channels = _channels(summary)
            kept = {n: channel for n, channel in channels.items() if channel.topic in topics}
            sink.chunks.adopt(kept, summary.channels)


def put(piece: Piece, wanted: Wanted | None, sink: RecordingWriter) -> int:
    """Copy the selected messages of a unit (None: all), and return how many."""
    block = piece.block
    count = len(block)
    if wanted is not None:
        rows = wanted.rows(piece)
        count = int(rows.sum())
        if not rows.all():
            block, piece = block.take(rows), replace(piece, chunk=None)
    whole, channels = piece.chunk, piece.channels
    if whole is not None and sink.chunks.append_chunk(whole, block, channels, piece.index):
        return count
    if len(block):
        sink.chunks.append(block, piece.channels)
    return count


def pieces(path: Path, wanted: Wanted) -> Iterator[Piece]:
    """Yield the chunks with selected messages, by time, each decompressed once and verified.

    Raises
    ------
    RecordingError
        If the file is not a complete recording, or a chunk is corrupt.
    """
    with opened(path) as stream:
        summary = mcap_summary(path, stream)
        if summary is None:
            walk = walked(path, stream)
            yield from (Piece(block, walk.channels) for block in walk.blocks)
            return
        channels = _channels(summary)
        found: Counter[int] = Counter()
        chunks = _chunks(summary, channels, wanted)
        stream.expect([place_of(index) for index in chunks])
        for index in chunks:
            chunk, block, messages = whole_chunk(path, stream, index, channels, summary)
            tally(found, block)
            yield Piece(block, channels, chunk, messages)
        if (wanted.low_ns, wanted.high_ns) == (0, EVER_NS):
            kept = {n: channel for n, channel in channels.items() if channel.topic in wanted.topics}
            compare(path, summary, kept, found)


def _channels(summary: McapSummary) -> dict[int, Channel]:
    return {n: channel_of(n, summary.channels, summary.schemas) for n in summary.channels}


def _chunks(
    summary: McapSummary, channels: Mapping[int, Channel], wanted: Wanted
) -> list[ChunkIndex]:
    """Return the chunks that may contain selected messages, by time."""
    mine = {n for n, channel in channels.items() if channel.topic in wanted.topics}
    found = chunks_between(summary, mine, wanted.low_ns, wanted.high_ns)
    return sorted(found, key=lambda chunk: (chunk.message_start_time, chunk.chunk_start_offset))
