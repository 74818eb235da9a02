"""Read the message indexes of many chunks at a time."""

import zlib
from collections.abc import Iterator, Sequence

import numpy as np
from mcap.exceptions import McapError
from mcap.records import ChunkIndex

from dmrl.recording.mcap import checksums, message_index
from dmrl.recording.mcap.extra_records import read_metadata
from dmrl.recording.mcap.file import BoundedReader
from dmrl.recording.mcap.message_batch import MAX_TIME_NS, Ints
from dmrl.recording.mcap.summary_section import SummarySection

GROUP_BYTES = 1_000_000
"""Message indexes that are parsed at a time: large enough that calls of NumPy cost little."""


def iter_index_times(
    stream: BoundedReader, section: SummarySection, topics: frozenset[str] | None = None
) -> Iterator[tuple[Ints, Ints, int]]:
    """Yield the message indexes of some chunks at a time, then verify the CRC of all.

    For a file in a bucket, only indexes of chunks with the topics are read, without that CRC.

    Yields
    ------
    tuple
        (N,) channel ids and log times, chunk by chunk in the order of the file, each chunk channel
        by channel; and the least log time that may follow.

    Raises
    ------
    McapError
        If an index contradicts its chunk, is not listed, or fails the CRC.
    """
    stored_checksums = read_metadata(stream, section).get(checksums.METADATA_NAME)
    crc = 0
    chunks = sorted(section.chunk_indexes, key=lambda c: c.chunk_start_offset)
    if stream.remote_stream is not None:
        stored_checksums = None
        wanted = {n for n, c in section.channels.items() if topics is None or c.topic in topics}
        chunks = [chunk for chunk in chunks if wanted & chunk.message_index_offsets.keys()]
    stream.expect_reads([(_get_start(chunk), chunk.message_index_length) for chunk in chunks])
    later_ns = [MAX_TIME_NS]
    for chunk in reversed(chunks):
        later_ns.append(min(later_ns[-1], chunk.message_start_time))
    for group in _iter_groups(chunks):
        raw = b"".join(_iter_records(stream, group))
        crc = zlib.crc32(raw, crc)
        del later_ns[-len(group) :]
        yield *_parse_group(raw, group), later_ns[-1]
    if stored_checksums and stored_checksums[-1].get("indexes") != checksums.format_crc(crc):
        raise McapError("its message indexes fail their CRC")


def _iter_groups(chunks: Sequence[ChunkIndex]) -> Iterator[list[ChunkIndex]]:
    group: list[ChunkIndex] = []
    size = 0
    for chunk in chunks:
        group.append(chunk)
        size += chunk.message_index_length
        if size >= GROUP_BYTES:
            yield group
            group, size = [], 0
    if group:
        yield group


def _iter_records(stream: BoundedReader, chunks: Sequence[ChunkIndex]) -> Iterator[bytes]:
    for chunk in chunks:
        stream.seek(_get_start(chunk))
        yield stream.read(chunk.message_index_length)


def _get_start(chunk: ChunkIndex) -> int:
    """Return where the message indexes of a chunk begin in the file, bytes."""
    return chunk.chunk_start_offset + chunk.chunk_length


def _parse_group(raw: bytes, chunks: Sequence[ChunkIndex]) -> tuple[Ints, Ints]:
    """Return channel ids and log times of the joined message indexes of chunks."""
    sizes = np.array([chunk.message_index_length for chunk in chunks])
    starts = np.cumsum(sizes) - sizes
    offsets = [chunk.message_index_offsets for chunk in chunks]
    owner = np.repeat(np.arange(len(chunks)), [len(one) for one in offsets])
    numbers = np.fromiter((n for one in offsets for n in one), np.int64, len(owner))
    places = (at - _get_start(c) for c in chunks for at in c.message_index_offsets.values())
    at = starts[owner] + np.fromiter(places, np.int64, len(owner))
    entries = message_index.parse_index_records(
        raw, numbers, at, (starts[owner], (starts + sizes)[owner])
    )
    ends = at + message_index.MESSAGE_INDEX_STRUCT.size + message_index.ENTRY_BYTES * entries.counts
    if not _fills(len(raw), at, ends):
        for chunk, start, size in zip(chunks, starts.tolist(), sizes.tolist(), strict=True):
            own = {n: at - _get_start(chunk) for n, at in chunk.message_index_offsets.items()}
            message_index.check_all_listed(raw[start : start + size], own)
    low = np.array([chunk.message_start_time for chunk in chunks])
    high = np.array([chunk.message_end_time for chunk in chunks])
    owner = np.repeat(owner, entries.counts)
    foreign = (entries.time_ns < low[owner]) | (entries.time_ns > high[owner])
    if foreign.any():
        first = _get_start(chunks[owner[foreign][0]])
        raise McapError(f"a message index at byte {first} has times of another chunk")
    return entries.channel, entries.time_ns


def _fills(size: int, begins: Ints, ends: Ints) -> bool:
    """Return whether records without bytes of a later version follow one another without a gap."""
    order = np.argsort(begins)
    return np.array_equal(np.append(begins[order], size), np.append(0, ends[order]))
