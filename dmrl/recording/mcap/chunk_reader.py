"""Read one chunk and verify it against its Chunk Index and Message Index records."""

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
    """Return the offset of a chunk, and its size with its message indexes, bytes."""
    return chunk.chunk_start_offset, chunk.chunk_length + chunk.message_index_length


def in_chunk(
    path: Path,
    stream: Bounded,
    said: ChunkIndex,
    channels: dict[int, Channel],
    summary: Section,
) -> Block:
    """Read a chunk and return its messages of some channels, in chunk order.

    Parameters
    ----------
    path, stream
        The recording.
    chunk_index
        Chunk Index record of the chunk.
    channels
        Channels to read, by channel id.
    summary
        Summary section of the recording.

    Raises
    ------
    RecordingError
        If the chunk contradicts its Chunk Index, its Message Index or the Summary section.
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
    """Read a chunk for a copy: still compressed, with all its messages and message indexes.

    Parameters
    ----------
    path, stream
        The recording.
    chunk_index
        Chunk Index record of the chunk.
    channels
        All channels of the recording, by channel id.
    summary
        Summary section of the recording.

    Returns
    -------
    tuple
        Chunk record, all messages, and message indexes. The indexes are None where there are none
        or their layout differs from that of a copy.

    Raises
    ------
    RecordingError
        If the chunk contradicts its Chunk Index, its Message Index or the Summary section.
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
    """Return a chunk's bytes with its message indexes, its record, and its decompressed data."""
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
    """Return the messages of some channels, and the number that each message index lists."""
    at = said.chunk_start_offset
    if not said.message_index_offsets:
        block = of_channels(scanned(data).block, channels, summary.channels)
        return _within(path, said, block), {}
    places = {n: place - at for n, place in said.message_index_offsets.items() if n in channels}
    entries = index_entries(path, raw, places)
    if len(entries.at) and not 0 <= entries.at.min() <= entries.at.max() <= len(data) - HEAD_BYTES:
        raise damaged(path, f"index beyond the chunk at byte {at}")
    # Message indexes have no CRC, so they are compared with the records they point at.
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
    """Return the batch; raise RecordingError if its times exceed the range of its Chunk Index."""
    low, high = chunk.message_start_time, chunk.message_end_time
    if len(block) and not low <= block.span[0] <= block.span[1] <= high:
        raise damaged(
            path,
            f"messages in the chunk at byte {chunk.chunk_start_offset} are "
            "outside the time range that it states",
        )
    return block


def _chunk_record(path: Path, raw: bytes, said: ChunkIndex) -> Chunk:
    """Parse the Chunk record at the start of some bytes and compare it with its Chunk Index."""
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
        raise damaged(path, f"the chunk at byte {at} differs from its index in the summary")
    return Chunk(compression, raw[begin:end], last, first, crc, size)
