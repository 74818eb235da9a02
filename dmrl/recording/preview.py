"""Sample a few messages from the whole length of a recording."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from mcap.records import ChunkIndex

from dmrl.recording.mcap.batch_reader import iter_batches, select_chunks
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.chunks.chunk_reader import iter_chunks
from dmrl.recording.mcap.file import open_mcap
from dmrl.recording.mcap.message_batch import MessageBatch, concatenate_all
from dmrl.recording.mcap.summary_section import SummarySection, read_summary_section
from dmrl.recording.protobuf.columns import decode_by_topic
from dmrl.recording.protobuf.message_types import require_types
from dmrl.recording.summary import read_summary

CHUNKS_PER_CHANNEL_MAX = 16
"""Chunks that are read per channel, at most some 2 MB."""


def sample_topics(
    path: Path, fields: Mapping[str, Sequence[str] | None], *, start_ns: int, end_ns: int
) -> dict[str, pa.RecordBatch]:
    """Read the messages of a few chunks, evenly spread over a time range.

    Every topic with messages in the range has at least one in the result.

    Parameters
    ----------
    path
        A complete recording.
    fields
        Topics, and the fields of each to read (None: all). Missing topics are left out.
    start_ns, end_ns
        Read log times in [start_ns, end_ns) only, nanoseconds.

    Returns
    -------
    dict
        Topic to columns as in `iter_columns`, in log-time order.

    Raises
    ------
    RecordingError
        If the file is not a complete recording, or a message is not of its type.
    """
    present = read_summary(path).topics
    names = frozenset(topic for topic in fields if topic in present)
    require_types(path, present, names)
    batches, channels = _sample_chunks(path, names, start_ns, end_ns)
    missing = names - _list_topics(batches, channels)
    # Rare: the chunks have no message in the range, or the file has no index.
    rest = iter_batches(path, missing, start_ns=start_ns, end_ns=end_ns) if missing else ()
    for batch, own in rest:
        batches.append(batch)
        channels |= own
        missing -= _list_topics([batch], own)
        if not missing:
            break
    if not batches:
        return {}
    return decode_by_topic(path, concatenate_all(batches).sort_by_time(), channels, fields)


def _sample_chunks(
    path: Path, names: frozenset[str], start_ns: int, end_ns: int
) -> tuple[list[MessageBatch], dict[int, Channel]]:
    """Read the chosen chunks; return their batches, and channels by channel id."""
    with open_mcap(path) as stream:
        index = read_summary_section(stream)
        if index is None:
            return [], {}
        channels = {n: c for n, c in index.channels_by_id.items() if c.topic in names}
        batches = []
        chosen = _choose_chunks(index, channels, start_ns, end_ns)
        for batch in iter_chunks(stream, chosen, channels, index):
            batch = batch.take((batch.time_ns >= start_ns) & (batch.time_ns < end_ns))
            batches.append(batch.compact())
    return [block for block in batches if len(block)], channels


def _choose_chunks(
    index: SummarySection, channels: Mapping[int, Channel], start_ns: int, end_ns: int
) -> list[ChunkIndex]:
    """Choose the first chunk of each channel, its last, and some between."""
    chosen: dict[int, ChunkIndex] = {}
    for number in channels:
        candidates = select_chunks(index, {number}, start_ns, end_ns)
        places = np.linspace(0, len(candidates) - 1, min(CHUNKS_PER_CHANNEL_MAX, len(candidates)))
        for place in places.round().astype(int).tolist():
            chunk = candidates[place]
            chosen[chunk.chunk_start_offset] = chunk
    return list(chosen.values())


def _list_topics(batches: Sequence[MessageBatch], channels: Mapping[int, Channel]) -> set[str]:
    return {channels[n].topic for batch in batches for n in batch.list_channel_ids()}
