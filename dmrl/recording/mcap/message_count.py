"""Count the messages of a recording, and compare them with its Statistics record."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Statistics

from dmrl.recording.mcap import checksums
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.chunks.chunk_reader import iter_chunks
from dmrl.recording.mcap.extra_records import read_metadata
from dmrl.recording.mcap.file import BoundedReader
from dmrl.recording.mcap.file_cache import get_cached
from dmrl.recording.mcap.index_reader import iter_index_times
from dmrl.recording.mcap.message_batch import MAX_TIME_NS, Ints
from dmrl.recording.mcap.message_index import ENTRY_BYTES, MESSAGE_INDEX_STRUCT
from dmrl.recording.mcap.record_scan import ScannedFile
from dmrl.recording.mcap.summary_section import SummarySection
from dmrl.terminal.progress import say_once

COUNTED_BYTES = 128_000_000
"""Uncompressed size up to which every chunk of another program's file is read to count.

It costs a few tenths of a second, once a process. The chunks of larger files are verified when
they are read.
"""
MAX_CHANNELS = 2**16
Times = Iterable[tuple[Ints, Ints]]
"""(N,) channel ids and log times of some messages at a time."""


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
        How the Statistics record differs; empty if it agrees.
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
    times = ((batch.channel, batch.time_ns) for batch in scanned.batches)
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
                say_once(f"{stream.path} {words}. dmrl check counts them all")
            return count
    return count_chunks(stream, section)


def count_chunks(stream: BoundedReader, section: SummarySection) -> MessageCount:
    """Count the messages of every chunk, each read and verified; raise as `count_recording`."""
    chunks = sorted(section.chunk_indexes, key=lambda c: c.chunk_start_offset)
    batches = iter_chunks(stream, chunks, section.channels_by_id, section)
    times = ((batch.channel, batch.time_ns) for batch in batches)
    return _compare(section.statistics, section.channels_by_id, times)


def verify_indexes(stream: BoundedReader, section: SummarySection) -> MessageCount | None:
    """Compare the message indexes of all chunks with the Statistics record, and count by them.

    The result is cached. None: the file has chunks without indexes.

    Raises
    ------
    McapError
        If they state another number or other times, one is not listed, or they fail dmrl's CRC.
    """

    def count() -> MessageCount | None:
        if not all(chunk.message_index_offsets for chunk in section.chunk_indexes):
            return None
        times = ((ids, time_ns) for ids, time_ns, _ in iter_index_times(stream, section))
        return _compare(section.statistics, section.channels_by_id, times)

    return get_cached("message indexes", stream, count)


def check_counts(
    statistics: Statistics | None, channels: Mapping[int, Channel], counts: Counter[int]
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


def _compare(
    statistics: Statistics | None, channels: Mapping[int, Channel], times: Times
) -> MessageCount:
    """Count messages by their times and compare them with the Statistics record."""
    counts, spans = _tally(times)
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


def _tally(times: Times) -> tuple[Counter[int], dict[int, tuple[int, int]]]:
    """Return number of messages, and first and last log time, by channel id."""
    counts = np.zeros(MAX_CHANNELS, np.int64)
    low, high = np.full(MAX_CHANNELS, MAX_TIME_NS), np.full(MAX_CHANNELS, -1)
    for channel, time_ns in times:
        found = np.bincount(channel)
        counts[: len(found)] += found
        np.minimum.at(low, channel, time_ns)
        np.maximum.at(high, channel, time_ns)
    numbers = np.flatnonzero(counts)
    spans = zip(low[numbers].tolist(), high[numbers].tolist(), strict=True)
    by_channel = dict(zip(numbers.tolist(), counts[numbers].tolist(), strict=True))
    return Counter(by_channel), dict(zip(numbers.tolist(), spans, strict=True))
