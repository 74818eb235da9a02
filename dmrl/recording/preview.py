"""Sample a few messages from the whole length of a recording."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from mcap.records import ChunkIndex
from mcap.summary import Summary as McapSummary

from dmrl.recording.mcap.batch_reader import blocks, chunks_between
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.chunk_reader import in_chunk
from dmrl.recording.mcap.file import opened
from dmrl.recording.mcap.message_batch import Block, joined
from dmrl.recording.mcap.record_scan import channel_of
from dmrl.recording.mcap.summary_index import mcap_summary
from dmrl.recording.protobuf.columns import by_topic
from dmrl.recording.protobuf.message_types import require_types
from dmrl.recording.summary import summary

CHUNKS = 16
"""Chunks that are read per channel, at most some 2 MB."""


def glance(
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
    present = summary(path).topics
    names = frozenset(topic for topic in fields if topic in present)
    require_types(path, present, names)
    held, channels = _spread(path, names, start_ns, end_ns)
    missing = names - _topics(held, channels)
    # Rare: the chunks have no message in the range, or the file has no index.
    rest = blocks(path, missing, start_ns=start_ns, end_ns=end_ns) if missing else ()
    for block, own in rest:
        held.append(block)
        channels |= own
        missing -= _topics([block], own)
        if not missing:
            break
    return by_topic(path, joined(held).sorted(), channels, fields) if held else {}


def _spread(
    path: Path, names: frozenset[str], start_ns: int, end_ns: int
) -> tuple[list[Block], dict[int, Channel]]:
    """Read the chosen chunks; return their batches, and channels by channel id."""
    with opened(path) as stream:
        index = mcap_summary(path, stream)
        if index is None:
            return [], {}
        channels = {
            number: channel_of(number, index.channels, index.schemas)
            for number, channel in index.channels.items()
            if channel.topic in names
        }
        held = []
        for chunk in _chosen(index, channels, start_ns, end_ns):
            block = in_chunk(path, stream, chunk, channels, index)
            block = block.take((block.time_ns >= start_ns) & (block.time_ns < end_ns))
            held.append(block.compact())
    return [block for block in held if len(block)], channels


def _chosen(
    index: McapSummary, channels: Mapping[int, Channel], start_ns: int, end_ns: int
) -> list[ChunkIndex]:
    """Choose the first chunk of each channel, its last, and some between."""
    found: dict[int, ChunkIndex] = {}
    for number in channels:
        candidates = chunks_between(index, {number}, start_ns, end_ns)
        places = np.linspace(0, len(candidates) - 1, min(CHUNKS, len(candidates)))
        for place in places.round().astype(int).tolist():
            chunk = candidates[place]
            found[chunk.chunk_start_offset] = chunk
    return list(found.values())


def _topics(held: Sequence[Block], channels: Mapping[int, Channel]) -> set[str]:
    return {channels[n].topic for block in held for n in block.numbers()}
