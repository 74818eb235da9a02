"""Read the log times of topics from the message indexes."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from dmrl.recording.mcap.batch_reader import iter_batches
from dmrl.recording.mcap.file import open_mcap
from dmrl.recording.mcap.index_reader import iter_index_times
from dmrl.recording.mcap.message_batch import MAX_TIME_NS, Ints
from dmrl.recording.mcap.message_count import count_chunks, count_scanned, verify_indexes
from dmrl.recording.mcap.record_scan import scan_file
from dmrl.recording.mcap.summary_section import read_summary_section
from dmrl.recording.summary import read_summary


def read_log_times(
    path: Path, topics: Iterable[str], *, start_ns: int | None = None, end_ns: int | None = None
) -> dict[str, Ints]:
    """Read the log times of topics from the index, without reading messages.

    Parameters
    ----------
    path
        A complete recording.
    topics
        Topics to read. Missing topics are left out.
    start_ns, end_ns
        Return log times in [start_ns, end_ns) only, nanoseconds.

    Returns
    -------
    dict
        Topic to (N,) sorted log times, nanoseconds.

    Raises
    ------
    RecordingError
        If the file is not a complete recording.
    """
    present = read_summary(path).topics
    names = frozenset(topic for topic in topics if topic in present)
    low = 0 if start_ns is None else start_ns
    high = MAX_TIME_NS if end_ns is None else end_ns
    parts: dict[str, list[Ints]] = {topic: [np.empty(0, np.int64)] for topic in names}
    for topic, t in iter_sorted_times(path, names):
        parts[topic].append(t[(t >= low) & (t < high)])
    return {topic: np.concatenate(times) for topic, times in parts.items()}


def read_time_spans(path: Path) -> dict[str, tuple[int, int]]:
    """Read the first and last log time of each topic that has messages, in flat memory.

    Raises
    ------
    RecordingError
        If the file is not a complete recording, or its message indexes contradict its statistics.
    """
    with open_mcap(path) as stream:
        section = read_summary_section(stream)
        if section is None:
            scanned = scan_file(stream)
            found, channels = count_scanned(scanned), scanned.channels
        else:
            found = verify_indexes(stream, section) or count_chunks(stream, section)
            channels = section.channels_by_id
    spans: dict[str, tuple[int, int]] = {}
    for number, (low, high) in found.spans_ns.items():
        before = spans.get(channels[number].topic, (low, high))
        spans[channels[number].topic] = min(low, before[0]), max(high, before[1])
    return spans


def iter_sorted_times(path: Path, topics: frozenset[str]) -> Iterator[tuple[str, Ints]]:
    """Yield log times from the message indexes, without decompressing chunks.

    Memory is bounded by the chunks that overlap in time.

    Yields
    ------
    tuple
        Topic, and (N,) its next log times, nanoseconds. Those of a topic are sorted.

    Raises
    ------
    RecordingError
        If the file is not a complete recording, or its message indexes are corrupt.
    """
    with open_mcap(path) as stream:
        summary = read_summary_section(stream)
        if summary is not None and all(c.message_index_offsets for c in summary.chunk_indexes):
            by_topic = {t: [n for n, c in summary.channels.items() if c.topic == t] for t in topics}
            pending = dict.fromkeys(topics, np.empty(0, np.int64))
            for ids, times, later_ns in iter_index_times(stream, summary, topics):
                for topic, numbers in by_topic.items():
                    held = np.concatenate([pending[topic], times[np.isin(ids, numbers)]])
                    held.sort()
                    split = np.searchsorted(held, later_ns)
                    yield topic, held[:split]
                    pending[topic] = held[split:]
            return
    for batch, found in iter_batches(path, topics):
        for topic in topics:
            numbers = [number for number, channel in found.items() if channel.topic == topic]
            yield topic, batch.time_ns[batch.mask_channels(numbers)]
