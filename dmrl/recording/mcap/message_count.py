"""Count the messages of a recording, and compare them with its Statistics record."""

import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Statistics

from dmrl.recording.mcap import checksums
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.chunks.chunk_reader import iter_chunks
from dmrl.recording.mcap.extra_records import read_metadata
from dmrl.recording.mcap.file import BoundedReader
from dmrl.recording.mcap.file_cache import get_cached
from dmrl.recording.mcap.message_batch import Ints
from dmrl.recording.mcap.message_index import (
    ENTRY_BYTES,
    MESSAGE_INDEX_STRUCT,
    check_all_listed,
    parse_index_entries,
)
from dmrl.recording.mcap.record_scan import ScannedFile
from dmrl.recording.mcap.summary_section import SummarySection
from dmrl.terminal.progress import say_once

COUNTED_BYTES = 128_000_000
"""Uncompressed size up to which every chunk of another program's file is read to count.

It costs a few tenths of a second, once a process. The chunks of larger files are verified when
they are read.
"""
Times = Iterable[tuple[int, Ints]]


@dataclass(frozen=True, slots=True)
class MessageCount:
    """Number and times of the messages of a recording.

    Parameters
    ----------
    by_channel
        Number of messages by channel id. Channels without messages may be missing.
    start_ns, end_ns
        First and last log time, nanoseconds; both 0 without messages.
    contradiction
        What the Statistics record states otherwise; empty if it agrees.
    spans_ns
        First and last log time by channel id; empty if only the Statistics record was read.
    """

    by_channel: Counter[int]
    start_ns: int
    end_ns: int
    contradiction: str = ""
    spans_ns: Mapping[int, tuple[int, int]] = field(default_factory=dict)


def count_scanned(scanned: ScannedFile) -> MessageCount:
    """Count the messages of a file that was read record by record.

    Raises
    ------
    McapError
        If the Statistics record states another number.
    """
    times = (
        (number, batch.time_ns[batch.channel == number])
        for batch in scanned.batches
        for number in batch.list_channel_ids()
    )
    return _compare(scanned.statistics, scanned.channels, times)


def count_recording(stream: BoundedReader, section: SummarySection) -> MessageCount:
    """Return number and times of the messages.

    Every chunk of another program's file is read and verified. Of a file that dmrl wrote, is larger
    than `COUNTED_BYTES`, or is in a bucket, they are from the Statistics record if that is complete
    and agrees with the chunk indexes; else they are counted in the message indexes.

    Raises
    ------
    McapError
        If the file states another number, or is corrupt.
    """
    size = sum(chunk.uncompressed_size for chunk in section.chunk_indexes)
    costly = size > COUNTED_BYTES or stream.remote_stream is not None
    own = checksums.METADATA_NAME in read_metadata(stream, section)
    if costly or own:
        count = _get_stated(section) or verify_indexes(stream, section)
        if count is not None:
            if not own:
                words = "is large or in a bucket: its statistics count its messages"
                say_once(f"{stream.path} {words}. To count them all: dmrl check")
            return count
    return count_chunks(stream, section)


def count_chunks(stream: BoundedReader, section: SummarySection) -> MessageCount:
    """Count the messages of every chunk, each read and verified; raise as `count_recording`."""
    times = _iter_chunk_times(stream, section)
    return _compare(section.statistics, section.channels_by_id, times)


def verify_indexes(stream: BoundedReader, section: SummarySection) -> MessageCount | None:
    """Compare the message indexes of all chunks with the Statistics record, and count by them.

    The result is cached. None: the file has chunks without indexes.

    Raises
    ------
    McapError
        If they state another number or other times, one is not listed, or they fail dmrl's CRC.
    """
    if not all(chunk.message_index_offsets for chunk in section.chunk_indexes):
        return None

    def count() -> MessageCount:
        times = iter_index_times(stream, section)
        return _compare(section.statistics, section.channels_by_id, times)

    return get_cached("message indexes", stream, count)


def check_counts(
    statistics: Statistics | None,
    channels: Mapping[int, Channel],
    counts: Counter[int],
) -> None:
    """Raise McapError unless the counts of messages equal those of the Statistics record.

    Parameters
    ----------
    statistics
        The record, if there is one. It may lack the counts by channel.
    channels
        Channels that were read, by channel id.
    counts
        Messages found, by channel id.
    """
    expected = statistics.channel_message_counts if statistics else {}
    for number, channel in channels.items() if expected else ():
        if counts[number] != expected.get(number, 0):
            raise McapError(
                f"{channel.topic} has {counts[number]} of {expected.get(number, 0)} messages"
            )


def _get_stated(section: SummarySection) -> MessageCount | None:
    """Return the counts of the Statistics record, if it is complete and fits the chunk indexes."""
    statistics, chunks = section.statistics, section.chunk_indexes
    if statistics is None or (statistics.message_count and not section.counts):
        return None
    times = statistics.message_start_time, statistics.message_end_time
    filled = [chunk for chunk in chunks if chunk.message_end_time or chunk.message_index_offsets]
    if filled and times != (
        min(chunk.message_start_time for chunk in filled),
        max(chunk.message_end_time for chunk in filled),
    ):
        return None
    # Each message index has a head, and an entry for every message.
    size = sum(chunk.message_index_length for chunk in chunks)
    heads = MESSAGE_INDEX_STRUCT.size * sum(len(chunk.message_index_offsets) for chunk in chunks)
    if size and size != heads + ENTRY_BYTES * statistics.message_count:
        return None
    return MessageCount(Counter(section.counts), *times)


def _iter_chunk_times(stream: BoundedReader, section: SummarySection) -> Iterator[tuple[int, Ints]]:
    """Yield channel id and log times of the messages of every chunk."""
    chunks = sorted(section.chunk_indexes, key=lambda c: c.chunk_start_offset)
    for batch in iter_chunks(stream, chunks, section.channels_by_id, section):
        for number in batch.list_channel_ids():
            yield number, batch.time_ns[batch.channel == number]


def iter_index_times(
    stream: BoundedReader, section: SummarySection, topics: frozenset[str] | None = None
) -> Iterator[tuple[int, Ints]]:
    """Yield channel id and log times of every message index by chunk, then verify the CRC of all.

    For a file in a bucket, only indexes of chunks with the topics are read, without that CRC.

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
    firsts = [chunk.chunk_start_offset + chunk.chunk_length for chunk in chunks]
    stream.expect_reads([(k, c.message_index_length) for k, c in zip(firsts, chunks, strict=True)])
    for first, chunk in zip(firsts, chunks, strict=True):
        stream.seek(first)
        raw = stream.read(chunk.message_index_length)
        crc = zlib.crc32(raw, crc)
        places = {n: at - first for n, at in chunk.message_index_offsets.items()}
        _, times, _, counts = parse_index_entries(raw, places)
        check_all_listed(raw, places)
        low, high = chunk.message_start_time, chunk.message_end_time
        if len(times) and not low <= int(times.min()) <= int(times.max()) <= high:
            raise McapError(f"a message index at byte {first} has times of another chunk")
        bounds = pairwise([0, *np.cumsum(counts).tolist()])
        for number, (begin, end) in zip(places, bounds, strict=True):
            yield number, times[begin:end]
    if stored_checksums and stored_checksums[-1].get("indexes") != checksums.format_crc(crc):
        raise McapError("its message indexes fail their CRC")


def _compare(
    statistics: Statistics | None, channels: Mapping[int, Channel], times: Times
) -> MessageCount:
    """Count messages by their times and compare them with the Statistics record."""
    counts: Counter[int] = Counter()
    spans: dict[int, tuple[int, int]] = {}
    for number, time_ns in times:
        if len(time_ns):
            counts[number] += len(time_ns)
            low, high = int(time_ns.min()), int(time_ns.max())
            before = spans.get(number, (low, high))
            spans[number] = min(low, before[0]), max(high, before[1])
    start_ns = min((low for low, _ in spans.values()), default=0)
    end_ns = max((high for _, high in spans.values()), default=0)
    check_counts(statistics, channels, counts)
    if statistics is None:
        return MessageCount(counts, start_ns, end_ns, "", spans)
    if statistics.message_count != counts.total():
        raise McapError(f"{counts.total()} of {statistics.message_count} messages are there")
    stated = statistics.message_start_time, statistics.message_end_time
    contradiction = (
        f"its statistics state times from {stated[0]} to {stated[1]} ns, but its messages have "
        f"{start_ns} to {end_ns} ns"
    )
    agrees = stated == (start_ns, end_ns) or not counts
    return MessageCount(counts, start_ns, end_ns, "" if agrees else contradiction, spans)
