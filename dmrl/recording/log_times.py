"""Read the log times of topics from the message indexes."""

import zlib
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from mcap.summary import Summary as McapSummary

from dmrl.recording.mcap import checksums
from dmrl.recording.mcap.batch_reader import iter_batches
from dmrl.recording.mcap.file import BoundedReader, corrupt_error, open_mcap
from dmrl.recording.mcap.message_batch import MAX_TIME_NS, Ints
from dmrl.recording.mcap.message_index import parse_index_entries
from dmrl.recording.mcap.summary_index import read_metadata, read_summary_section
from dmrl.recording.protobuf.message_types import require_types
from dmrl.recording.summary import read_summary

_NO_TIMES: Ints = np.empty(0, np.int64)


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
    require_types(path, present, names)
    low = 0 if start_ns is None else start_ns
    high = MAX_TIME_NS if end_ns is None else end_ns
    found = {topic: np.sort(times) for topic, times in read_indexed_times(path, names).items()}
    return {topic: t[(t >= low) & (t < high)] for topic, t in found.items()}


def read_indexed_times(path: Path, topics: frozenset[str]) -> dict[str, Ints]:
    """Read log times in the order of the message indexes, without decompressing chunks.

    Raises
    ------
    RecordingError
        If the file is not a complete recording, or its message indexes are corrupt.
    """
    parts: dict[str, list[Ints]] = {topic: [_NO_TIMES] for topic in topics}
    with open_mcap(path) as stream:
        summary = read_summary_section(path, stream)
        if summary is not None and all(c.message_index_offsets for c in summary.chunk_indexes):
            for topic, times in _iter_index_times(path, stream, summary, topics):
                if topic in parts:
                    parts[topic].append(times)
            return {topic: np.concatenate(times) for topic, times in parts.items()}
    for batch, found in iter_batches(path, topics):
        for number, channel in found.items():
            parts[channel.topic].append(batch.time_ns[batch.channel == number])
    return {topic: np.concatenate(times) for topic, times in parts.items()}


def _iter_index_times(
    path: Path, stream: BoundedReader, summary: McapSummary, topics: frozenset[str]
) -> Iterator[tuple[str, Ints]]:
    """Yield topic and log times of every message index by chunk, then verify the CRC of all.

    For a file in a bucket, only indexes of chunks with the topics are read, without that CRC.
    """
    stored_checksums = read_metadata(path, stream, summary).get(checksums.METADATA_NAME)
    crc = 0
    chunks = sorted(summary.chunk_indexes, key=lambda c: c.chunk_start_offset)
    if stream.remote_stream is not None:
        stored_checksums, wanted = (
            None,
            {n for n, c in summary.channels.items() if c.topic in topics},
        )
        chunks = [chunk for chunk in chunks if wanted & chunk.message_index_offsets.keys()]
    firsts = [chunk.chunk_start_offset + chunk.chunk_length for chunk in chunks]
    stream.expect_reads([(k, c.message_index_length) for k, c in zip(firsts, chunks, strict=True)])
    for first, chunk in zip(firsts, chunks, strict=True):
        stream.seek(first)
        raw = stream.read(chunk.message_index_length)
        crc = zlib.crc32(raw, crc)
        places = {n: at - first for n, at in chunk.message_index_offsets.items()}
        _, times, _, counts = parse_index_entries(path, raw, places)
        low, high = chunk.message_start_time, chunk.message_end_time
        if len(times) and not low <= int(times.min()) <= int(times.max()) <= high:
            raise corrupt_error(path, f"a message index at byte {first} has times of another chunk")
        bounds = pairwise([0, *np.cumsum(counts).tolist()])
        for number, (begin, end) in zip(places, bounds, strict=True):
            yield summary.channels[number].topic, times[begin:end]
    if stored_checksums and stored_checksums[-1].get("indexes") != checksums.format_crc(crc):
        raise corrupt_error(path, "its message indexes fail their CRC")
