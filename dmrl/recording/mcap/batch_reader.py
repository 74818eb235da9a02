"""Iterate over the messages of an MCAP file in batches, chunk by chunk.

A `MessageBatch` holds the bytes of a chunk and, as NumPy arrays, the times and the payload offsets
of its messages. The mcap package would create a Python object for every message instead.
All readers of messages use this module. Decoders work on whole batches.
"""

from collections import Counter
from collections.abc import Iterator, Set
from pathlib import Path

import numpy as np
from mcap.records import ChunkIndex
from mcap.summary import Summary as McapSummary

from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.chunk import of_channels
from dmrl.recording.mcap.chunk_reader import in_chunk, place_of
from dmrl.recording.mcap.file import Bounded, damaged, opened
from dmrl.recording.mcap.message_batch import EMPTY, EVER_NS, Block, concatenate, joined
from dmrl.recording.mcap.record_scan import channel_of, walked
from dmrl.recording.mcap.summary_index import mcap_summary
from dmrl.recording.mcap.summary_section import Section


def blocks(
    path: Path,
    topics: frozenset[str] | None = None,
    *,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> Iterator[tuple[Block, dict[int, Channel]]]:
    """Yield messages in log-time order, some thousands at a time, with channels by channel id.

    Messages of equal log time are ordered: numbers before images, then by position in the file.

    Memory is bounded by the chunks that overlap in time, or by the whole recording if it has no
    chunk index.

    Parameters
    ----------
    path
        A complete recording.
    topics
        Topics to read. None: all.
    start_ns, end_ns
        Read log times in [start_ns, end_ns) only, nanoseconds.

    Raises
    ------
    RecordingError
        If the file is not a complete recording, or a chunk's CRC does not match.
    """
    low = 0 if start_ns is None else start_ns
    high = EVER_NS if end_ns is None else end_ns
    with opened(path) as stream:
        summary = mcap_summary(path, stream)
        if summary is None:
            yield _unindexed(path, stream, topics, low, high)
            return
        channels = {
            number: channel_of(number, summary.channels, summary.schemas)
            for number in summary.channels
            if topics is None or summary.channels[number].topic in topics
        }
        found: Counter[int] = Counter()
        for block in _in_time_order(path, stream, summary, channels, low, high):
            tally(found, block)
            yield block, channels
        if start_ns is None and end_ns is None:
            compare(path, summary, channels, found)


def tally(found: Counter[int], block: Block) -> None:
    """Add the number of messages of a batch to the counts by channel id."""
    for number, count in enumerate(np.bincount(block.channel).tolist()):
        if count:
            found[number] += count


def compare(
    path: Path, summary: McapSummary, channels: dict[int, Channel], found: Counter[int]
) -> None:
    """Raise RecordingError unless the counts of messages equal those of the Statistics record."""
    said = summary.statistics.channel_message_counts if summary.statistics else {}
    for number, channel in channels.items() if said else ():
        if found[number] != said.get(number, 0):
            raise damaged(
                path, f"{channel.topic} has {found[number]} of {said.get(number, 0)} messages"
            )


def in_file_order(path: Path) -> Iterator[tuple[Block, dict[int, Channel]]]:
    """Yield every message in file order, chunk by chunk, unsorted.

    Raises
    ------
    RecordingError
        As ``iter_batches``.
    """
    with opened(path) as stream:
        summary = mcap_summary(path, stream)
        if summary is None:
            walk = walked(path, stream)
            for block in walk.blocks:
                yield block, walk.channels
            return
        channels = {n: channel_of(n, summary.channels, summary.schemas) for n in summary.channels}
        found: Counter[int] = Counter()
        chunks = sorted(summary.chunk_indexes, key=lambda c: c.chunk_start_offset)
        stream.expect([place_of(chunk) for chunk in chunks])
        for chunk in chunks:
            block = in_chunk(path, stream, chunk, channels, summary)
            tally(found, block)
            yield block, channels
        compare(path, summary, channels, found)


def _in_time_order(
    path: Path,
    stream: Bounded,
    summary: Section,
    channels: dict[int, Channel],
    low: int,
    high: int,
) -> Iterator[Block]:
    """Yield batches in log-time order; hold messages back while a later chunk may precede them."""
    chunks = chunks_between(summary, channels.keys(), low, high)
    last = _pictured(channels)
    held: Block | None = None
    stream.expect([place_of(chunk) for chunk in chunks])
    for k, chunk in enumerate(chunks):
        block = in_chunk(path, stream, chunk, channels, summary)
        block = block.take((block.time_ns >= low) & (block.time_ns < high))
        held = concatenate(held, block).sorted(last)
        if k + 1 == len(chunks):
            break
        # A later chunk may still hold messages from its start time on.
        split = int(np.searchsorted(held.time_ns, chunks[k + 1].message_start_time))
        if split:
            yield held.take(np.arange(split))
            held = held.take(np.arange(split, len(held))).compact()
    if held is not None and len(held):
        yield held


def _pictured(channels: dict[int, Channel]) -> list[int]:
    """Return the ids of channels with images; empty if all channels have images."""
    found = [number for number, channel in channels.items() if channel.pictured]
    return found if len(found) < len(channels) else []


def chunks_between(
    summary: McapSummary, numbers: Set[int], low: int, high: int
) -> list[ChunkIndex]:
    """Return the chunks that may contain messages of these channels in [low, high), by time."""

    def wanted(chunk: ChunkIndex) -> bool:
        seen = chunk.message_index_offsets
        return (
            chunk.message_end_time >= low
            and chunk.message_start_time < high
            and (not seen or not numbers.isdisjoint(seen))
        )

    return sorted(
        filter(wanted, summary.chunk_indexes),
        key=lambda c: (c.message_start_time, c.chunk_start_offset),
    )


def _unindexed(
    path: Path, stream: Bounded, topics: frozenset[str] | None, low: int, high: int
) -> tuple[Block, dict[int, Channel]]:
    """Read every message of a file without chunk indexes into one batch."""
    walk = walked(path, stream)
    channels = {n: c for n, c in walk.channels.items() if topics is None or c.topic in topics}
    kept = []
    for whole in walk.blocks:
        block = of_channels(whole, channels, walk.channels)
        kept.append(block.take((block.time_ns >= low) & (block.time_ns < high)))
    return joined(kept).sorted(_pictured(channels)) if kept else EMPTY, channels
