"""Chunks that a summary lists: read, and held against it and against their message indexes."""

from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex

from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.chunk import (
    HEAD,
    RECORD_HEADER,
    beside,
    messages_at,
    of_channels,
    possible,
    scanned,
    unpacked,
)
from dmrl.recording.mcap.file import Bounded, damaged
from dmrl.recording.mcap.file_writer import CHUNK
from dmrl.recording.mcap.message_batch import HEAD_BYTES, Block, Bytes, taken
from dmrl.recording.mcap.message_index import MessageIndex, index_entries, indexes_size
from dmrl.recording.mcap.summary_section import Section


def place_of(chunk: ChunkIndex) -> tuple[int, int]:
    """Where a chunk and its message indexes start, and how long they are together, bytes."""
    return chunk.chunk_start_offset, chunk.chunk_length + chunk.message_index_length


def in_chunk(
    path: Path,
    stream: Bounded,
    said: ChunkIndex,
    channels: dict[int, Channel],
    summary: Section,
) -> Block:
    """The messages of a chunk that are of some channels, in the order of the chunk.

    Parameters
    ----------
    path, stream
        The recording.
    said
        What its summary says of the chunk.
    channels
        Those that are wanted.
    summary
        Of the recording.

    Raises
    ------
    RecordingError
        If the chunk is not what its summary and its message indexes say.
    """
    raw, _, data = _unpacked(path, stream, said)
    if summary.must_confirm(said):
        summary.confirm(path, scanned(data).definitions())
    return _indexed(path, raw, data, said, channels, summary)[0]


def whole_chunk(
    path: Path,
    stream: Bounded,
    said: ChunkIndex,
    channels: dict[int, Channel],
    summary: Section,
) -> tuple[Chunk, Block, MessageIndex | None]:
    """A chunk, still compressed, with all of its messages and its message indexes, for a copy.

    Parameters
    ----------
    path, stream
        The recording.
    said
        What its summary says of the chunk.
    channels
        All that the recording has.
    summary
        Of the recording.

    Returns
    -------
    tuple
        No message indexes where there are none, or where they are laid out otherwise than a
        copy's.

    Raises
    ------
    RecordingError
        If the chunk is not what its summary and its message indexes say.
    """
    raw, chunk, data = _unpacked(path, stream, said)
    block, counts = _indexed(path, raw, data, said, channels, summary)
    if summary.must_confirm(said):
        summary.confirm(path, (beside(block) or scanned(data)).definitions())
    records = raw[said.chunk_length :]
    if not all(counts.values()) or len(records) != indexes_size(counts):
        return chunk, block, None
    after = said.chunk_start_offset + said.chunk_length
    places = {n: at - after for n, at in said.message_index_offsets.items()}
    return chunk, block, MessageIndex(records, places, counts)


def _unpacked(path: Path, stream: Bounded, said: ChunkIndex) -> tuple[bytes, Chunk, Bytes]:
    """A chunk with its message indexes as it stands there, its record, and what it unpacks to."""
    at, size = place_of(said)
    stream.seek(at)
    raw = stream.read(size)
    chunk = _chunk_record(path, raw, said)
    return raw, chunk, unpacked(path, chunk, at)


def _indexed(
    path: Path,
    raw: bytes,
    data: Bytes,
    said: ChunkIndex,
    channels: dict[int, Channel],
    summary: Section,
) -> tuple[Block, dict[int, int]]:
    """The messages of some channels in a chunk, and how many each has by its message index."""
    at = said.chunk_start_offset
    if not said.message_index_offsets:
        block = of_channels(scanned(data).block, channels, summary.channels)
        return _within(path, said, block), {}
    places = {n: place - at for n, place in said.message_index_offsets.items() if n in channels}
    entries = index_entries(path, raw, places)
    if len(entries.at) and not 0 <= entries.at.min() <= entries.at.max() <= len(data) - HEAD_BYTES:
        raise damaged(path, f"index beyond the chunk at byte {at}")
    # Indexes carry no CRC of their own, so they are held against the records they point at.
    heads = taken(data, HEAD, entries.at)
    block = messages_at(data, np.sort(entries.at.astype(np.uint32)).astype(np.int64))
    right = (heads["opcode"] == Opcode.MESSAGE) & (heads["channel"] == entries.channel)
    right &= heads["time"].view(np.int64) == entries.time_ns
    if not (right & (block.end <= len(data))).all():
        raise damaged(path, f"index of the chunk at byte {at} is wrong")
    return _within(path, said, possible(block)), dict(
        zip(places, entries.counts.tolist(), strict=True)
    )


def _within(path: Path, chunk: ChunkIndex, block: Block) -> Block:
    """The block, if its messages are of the time that the chunk is said to be of."""
    low, high = chunk.message_start_time, chunk.message_end_time
    if len(block) and not low <= block.span[0] <= block.span[1] <= high:
        raise damaged(
            path,
            f"messages in the chunk at byte {chunk.chunk_start_offset} are of "
            "other times than it says",
        )
    return block


def _chunk_record(path: Path, raw: bytes, said: ChunkIndex) -> Chunk:
    """The chunk at the start of some bytes, if it is the one that the summary says is there."""
    at = said.chunk_start_offset
    if len(raw) < CHUNK.size or raw[0] != Opcode.CHUNK:
        raise damaged(path, f"no chunk at byte {at}")
    _, length, first, last, size, crc, name_bytes = CHUNK.unpack_from(raw)
    begin = CHUNK.size + name_bytes + 8
    compression = raw[CHUNK.size : begin - 8].decode()
    end = begin + int.from_bytes(raw[begin - 8 : begin], "little")
    found = length + RECORD_HEADER, first, last, size, compression
    listed = said.chunk_length, said.message_start_time, said.message_end_time
    if found != (*listed, said.uncompressed_size, said.compression) or end > said.chunk_length:
        raise damaged(path, f"the chunk at byte {at} is not the one that its summary lists")
    return Chunk(compression, raw[begin:end], last, first, crc, size)
