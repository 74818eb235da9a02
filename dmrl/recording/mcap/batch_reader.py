"""Iterate over the messages of an MCAP file in batches, chunk by chunk.

A `MessageBatch` holds the bytes of a chunk and, as NumPy arrays, the times and the payload offsets
of its messages. The mcap package would create a Python object for every message instead.
All readers of messages use this module. Decoders work on whole batches.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Set
from pathlib import Path

import numpy as np
from mcap.records import ChunkIndex

from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.chunks.chunk import select_channels
from dmrl.recording.mcap.chunks.chunk_reader import iter_chunks
from dmrl.recording.mcap.file import BoundedReader, open_mcap
from dmrl.recording.mcap.message_batch import (
    EMPTY_BATCH,
    MAX_TIME_NS,
    MessageBatch,
    concatenate,
    concatenate_all,
)
from dmrl.recording.mcap.message_count import check_counts, verify_indexes
from dmrl.recording.mcap.record_scan import scan_file
from dmrl.recording.mcap.summary_section import SummarySection, read_summary_section

JOINED_BYTES = 4 << 20
"""Bytes of messages that are decoded at once: few calls, little memory."""


def iter_batches(
    path: Path,
    topics: frozenset[str] | None = None,
    *,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> Iterator[tuple[MessageBatch, dict[int, Channel]]]:
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
    high = MAX_TIME_NS if end_ns is None else end_ns
    with open_mcap(path) as stream:
        summary = read_summary_section(stream)
        if summary is None:
            yield _scan_unindexed(stream, topics, low, high)
            return
        channels = {
            number: channel
            for number, channel in summary.channels_by_id.items()
            if topics is None or channel.topic in topics
        }
        counts: Counter[int] = Counter()
        for batch in _iter_in_time_order(stream, summary, channels, low, high):
            count_messages(counts, batch)
            yield batch, channels
        if (low, high) == (0, MAX_TIME_NS):
            check_counts(summary.statistics, channels, counts)


def count_messages(counts: Counter[int], batch: MessageBatch) -> None:
    """Add the number of messages of a batch to the counts by channel id."""
    for number, count in enumerate(np.bincount(batch.channel).tolist()):
        if count:
            counts[number] += count


def iter_batches_in_file_order(path: Path) -> Iterator[tuple[MessageBatch, dict[int, Channel]]]:
    """Yield every message in file order, chunk by chunk, unsorted.

    Raises
    ------
    RecordingError
        As ``iter_batches``.
    """
    with open_mcap(path) as stream:
        summary = read_summary_section(stream)
        if summary is None:
            walk = scan_file(stream)
            for batch in walk.batches:
                yield batch, walk.channels
            return
        channels = summary.channels_by_id
        counts: Counter[int] = Counter()
        chunks = sorted(summary.chunk_indexes, key=lambda c: c.chunk_start_offset)
        for batch in iter_chunks(stream, chunks, channels, summary):
            count_messages(counts, batch)
            yield batch, channels
        check_counts(summary.statistics, channels, counts)


def join_batches(
    batches: Iterable[tuple[MessageBatch, dict[int, Channel]]],
) -> Iterator[tuple[MessageBatch, dict[int, Channel]]]:
    """Join batches to some of `JOINED_BYTES`, which few calls decode."""
    pending: list[MessageBatch] = []
    channels: dict[int, Channel] = {}
    size = 0
    for batch, channels in batches:
        pending.append(batch)
        size += len(batch.data)
        if size >= JOINED_BYTES:
            yield concatenate_all(pending), channels
            pending, size = [], 0
    if pending:
        yield concatenate_all(pending), channels


def _iter_in_time_order(
    stream: BoundedReader,
    summary: SummarySection,
    channels: dict[int, Channel],
    low: int,
    high: int,
) -> Iterator[MessageBatch]:
    """Yield batches in log-time order; hold messages back while a later chunk may precede them."""
    chunks = select_chunks(summary, channels.keys(), low, high)
    last = _find_image_channels(channels)
    pending: MessageBatch | None = None
    whole = (low, high) == (0, MAX_TIME_NS)
    if not whole and stream.remote_stream is None:
        # The messages cannot be compared with the statistics, but all message indexes can.
        verify_indexes(stream, summary)
    for k, batch in enumerate(iter_chunks(stream, chunks, channels, summary)):
        if not whole:
            batch = batch.take((batch.time_ns >= low) & (batch.time_ns < high))
        pending = concatenate(pending, batch).sort_by_time(last)
        if k + 1 == len(chunks):
            break
        # A later chunk may still hold messages from its start time on.
        split = int(np.searchsorted(pending.time_ns, chunks[k + 1].message_start_time))
        if split:
            yield pending.take(slice(split))
            pending = pending.take(slice(split, None)).compact() if split < len(pending) else None
    if pending is not None and len(pending):
        yield pending


def _find_image_channels(channels: dict[int, Channel]) -> list[int]:
    """Return the ids of channels with images; empty if all channels have images."""
    image_channels = [number for number, channel in channels.items() if channel.carries_images]
    return image_channels if len(image_channels) < len(channels) else []


def select_chunks(
    summary: SummarySection, channel_ids: Set[int], low: int, high: int
) -> list[ChunkIndex]:
    """Return the chunks that may contain messages of these channels in [low, high), by time."""
    chunks, starts, latest_ends = summary.chunks_by_time
    near = chunks[np.searchsorted(latest_ends, low) : np.searchsorted(starts, high)]
    inside = [(c, c.message_index_offsets) for c in near if c.message_end_time >= low]
    return [c for c, n in inside if not (n and channel_ids.isdisjoint(n))]


def _scan_unindexed(
    stream: BoundedReader, topics: frozenset[str] | None, low: int, high: int
) -> tuple[MessageBatch, dict[int, Channel]]:
    """Read every message of a file without chunk indexes into one batch."""
    walk = scan_file(stream)
    channels = {n: c for n, c in walk.channels.items() if topics is None or c.topic in topics}
    kept = []
    for whole in walk.batches:
        batch = select_channels(whole, channels, walk.channels)
        kept.append(batch.take((batch.time_ns >= low) & (batch.time_ns < high)))
    return concatenate_all(kept).sort_by_time(
        _find_image_channels(channels)
    ) if kept else EMPTY_BATCH, channels
