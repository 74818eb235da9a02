"""The one way messages are read: chunk by chunk, as arrays of offsets into the bytes.

mcap's reader makes a Python object of every message. Here the chunk and message indexes are
walked as NumPy arrays instead: one block holds the bytes of a chunk and, for each message
in it, its times and where its payload starts and ends. Decoders work on whole blocks.
"""

import io
import struct
import zlib
from collections.abc import Iterator, Set
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel as McapChannel
from mcap.records import Chunk, ChunkIndex, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.summary import Summary as McapSummary

from dmrl.recording.block import Block, Bytes, Ints, concatenate
from dmrl.recording.index import channel_of, damaged, mcap_summary, opened
from dmrl.recording.writer import Channel

RECORD_HEADER = 1 + 8  # opcode, length
MESSAGE_HEADER = 2 + 4 + 8 + 8  # channel id, sequence, log time, publish time
SMALLEST_MESSAGE = RECORD_HEADER + MESSAGE_HEADER


def blocks(
    path: Path,
    topics: frozenset[str] | None = None,
    *,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> Iterator[tuple[Block, dict[int, Channel]]]:
    """Messages in log-time order, some thousands at a time, with their channels by number.

    Memory is bounded by the chunks that overlap in time; in a recording without an index,
    by the recording.

    Parameters
    ----------
    path
        A complete recording.
    topics
        Only these. None: all.
    start_ns, end_ns
        Only log times in [start_ns, end_ns).

    Raises
    ------
    RecordingError
        If the file is not a complete recording, or a chunk's CRC does not match.
    """
    low = 0 if start_ns is None else start_ns
    high = np.iinfo(np.int64).max if end_ns is None else end_ns
    with opened(path) as stream:
        summary = mcap_summary(path, stream)
        if summary is None or (not summary.chunk_indexes and _message_count(summary)):
            yield from _unindexed(path, stream, topics, low, high)
            return
        channels = {
            number: channel_of(number, summary.channels, summary.schemas)
            for number in summary.channels
            if topics is None or summary.channels[number].topic in topics
        }
        for block in _in_time_order(path, stream, summary, channels, low, high):
            yield block, channels


def in_file_order(path: Path) -> Iterator[tuple[Block, dict[int, Channel]]]:
    """Every message as the file has them, chunk by chunk, unsorted.

    Raises
    ------
    RecordingError
        As ``blocks``.
    """
    with opened(path) as stream:
        summary = mcap_summary(path, stream)
        if summary is None or not summary.chunk_indexes:
            return
        channels = {n: channel_of(n, summary.channels, summary.schemas) for n in summary.channels}
        for chunk in sorted(summary.chunk_indexes, key=lambda c: c.chunk_start_offset):
            yield in_chunk(path, stream, chunk, channels), channels


def indexed_times(path: Path, topics: frozenset[str]) -> dict[str, Ints]:
    """Log times of topics, as they stand in the message indexes; chunks are not unpacked.

    Raises
    ------
    RecordingError
        If the file is not a complete recording.
    """
    parts: dict[str, list[Ints]] = {topic: [_NO_TIMES] for topic in topics}
    with opened(path) as stream:
        summary = mcap_summary(path, stream)
        chunks = [] if summary is None else summary.chunk_indexes
        indexed = bool(chunks) and all(chunk.message_index_offsets for chunk in chunks)
        for chunk in chunks if indexed else ():
            first = chunk.chunk_start_offset + chunk.chunk_length
            stream.seek(first)
            raw = stream.read(chunk.message_index_length)
            for number, at in chunk.message_index_offsets.items():
                topic = summary.channels[number].topic if summary is not None else ""
                if topic in parts:
                    parts[topic].append(_index_entries(path, raw, at - first, number)[:, 0])
    if not indexed:
        for block, channels in blocks(path, topics):
            for number, channel in channels.items():
                parts[channel.topic].append(block.time_ns[block.channel == number])
    return {topic: np.concatenate(times) for topic, times in parts.items()}


_NO_TIMES: Ints = np.empty(0, np.int64)


def _message_count(summary: McapSummary) -> int:
    return summary.statistics.message_count if summary.statistics else 1


def _in_time_order(
    path: Path,
    stream: BinaryIO,
    summary: McapSummary,
    channels: dict[int, Channel],
    low: int,
    high: int,
) -> Iterator[Block]:
    chunks = chunks_between(summary, channels.keys(), low, high)
    held: Block | None = None
    for k, chunk in enumerate(chunks):
        block = in_chunk(path, stream, chunk, channels)
        block = block.take((block.time_ns >= low) & (block.time_ns < high))
        held = concatenate(held, block).sorted()
        if k + 1 == len(chunks):
            break
        # A later chunk may still hold messages from its start time on.
        split = int(np.searchsorted(held.time_ns, chunks[k + 1].message_start_time))
        if split:
            yield held.take(np.arange(split))
            held = held.take(np.arange(split, len(held))).compact()
    if held is not None and len(held):
        yield held


def chunks_between(
    summary: McapSummary, numbers: Set[int], low: int, high: int
) -> list[ChunkIndex]:
    """Chunks that may hold messages of some channels in [low, high), by time."""

    def wanted(chunk: ChunkIndex) -> bool:
        seen = chunk.message_index_offsets
        return (
            chunk.message_end_time >= low
            and chunk.message_start_time < high
            and (not seen or not numbers.isdisjoint(seen))
        )

    return sorted(
        filter(wanted, summary.chunk_indexes),
        key=lambda c: (c.message_start_time, c.chunk_start_offset),
    )


def in_chunk(
    path: Path, stream: BinaryIO, chunk: ChunkIndex, channels: dict[int, Channel]
) -> Block:
    """The messages of a chunk that are of some channels, in the order of the chunk."""
    stream.seek(chunk.chunk_start_offset)
    raw = stream.read(chunk.chunk_length + chunk.message_index_length)
    if len(raw) < RECORD_HEADER or raw[0] != Opcode.CHUNK:
        raise damaged(path, f"no chunk at byte {chunk.chunk_start_offset}")
    data = unpacked(path, _chunk_record(raw), chunk.chunk_start_offset)
    if not chunk.message_index_offsets:
        return scanned(data, set(channels))
    parts = [np.empty((0, 2), np.int64)]
    for number, at in chunk.message_index_offsets.items():
        if number in channels:
            parts.append(_index_entries(path, raw, at - chunk.chunk_start_offset, number))
    entries = np.concatenate(parts)
    entries = entries[np.argsort(entries[:, 1])]
    # Indexes carry no CRC of their own, so they are held against the records they point at.
    if entries.size and not 0 <= entries[0, 1] <= entries[-1, 1] <= len(data) - SMALLEST_MESSAGE:
        raise damaged(path, f"index beyond the chunk at byte {chunk.chunk_start_offset}")
    block = _at(data, entries[:, 1])
    if not (
        (data[entries[:, 1]] == Opcode.MESSAGE).all()
        and np.array_equal(block.time_ns, entries[:, 0])
        and (block.end <= len(data)).all()
        and set(np.unique(block.channel).tolist()) <= channels.keys()
    ):
        raise damaged(path, f"index of the chunk at byte {chunk.chunk_start_offset} is wrong")
    return block


def _index_entries(path: Path, raw: bytes, at: int, number: int) -> Ints:
    """(N, 2) log time and offset of one channel's messages in a chunk."""
    opcode, length, channel, size = struct.unpack_from("<BQHI", raw, at)
    if (opcode, length, channel) != (Opcode.MESSAGE_INDEX, size + 6, number) or size % 16:
        raise damaged(path, f"message index of channel {number} is wrong")
    entries = np.frombuffer(raw, "<i8", size // 8, at + RECORD_HEADER + 6)
    return entries.reshape(-1, 2).astype(np.int64)


def _chunk_record(raw: bytes) -> Chunk:
    stream = io.BytesIO(raw)
    stream.seek(RECORD_HEADER)
    chunk: Chunk = Chunk.read(ReadDataStream(stream))
    return chunk


def unpacked(path: Path, chunk: Chunk, offset: int) -> Bytes:
    """The records of a chunk, decompressed and checked against its CRC.

    Raises
    ------
    RecordingError
        If they cannot be decompressed, or the CRC does not match.
    """
    try:
        if chunk.compression == "zstd":
            data = zstandard.ZstdDecompressor().decompress(chunk.data, chunk.uncompressed_size)
        elif chunk.compression == "lz4":
            data = lz4.frame.decompress(chunk.data)
        elif chunk.compression == "":
            data = chunk.data
        else:
            raise damaged(path, f"unknown compression {chunk.compression!r}")
    except (zstandard.ZstdError, RuntimeError, MemoryError) as e:
        raise damaged(path, f"chunk at byte {offset}: {e}") from e
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise damaged(path, f"chunk at byte {offset} fails its CRC")
    return np.frombuffer(data, np.uint8)


def _at(data: Bytes, at_record: Ints) -> Block:
    """The messages whose records start at these offsets."""

    def field(offset: int, dtype: str) -> Ints:
        # A view with a stride of one byte reads unaligned integers in one gather.
        size = np.dtype(dtype).itemsize
        view = np.ndarray((max(len(data) - size + 1, 0),), dtype, data, 0, (1,))
        return view[at_record + offset].astype(np.int64)

    start = at_record + RECORD_HEADER + MESSAGE_HEADER
    return Block(
        data,
        field(RECORD_HEADER, "<u2"),
        field(RECORD_HEADER + 6, "<u8"),
        field(RECORD_HEADER + 14, "<u8"),
        start,
        at_record + RECORD_HEADER + field(1, "<u8"),
    )


def scanned(data: Bytes, numbers: set[int]) -> Block:
    """The messages of a chunk that has no message index, record by record."""
    view, offsets, at = data.data, [], 0
    while at + RECORD_HEADER <= len(view):
        opcode, size = struct.unpack_from("<BQ", view, at)
        if opcode == Opcode.MESSAGE and int.from_bytes(view[at + 9 : at + 11], "little") in numbers:
            offsets.append(at)
        at += RECORD_HEADER + size
    return _at(data, np.array(offsets, np.int64))


def _unindexed(
    path: Path, stream: BinaryIO, topics: frozenset[str] | None, low: int, high: int
) -> Iterator[tuple[Block, dict[int, Channel]]]:
    """One block with every message, for a file without chunk indexes."""
    stream.seek(0)
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    rows: list[Message] = []
    for record in StreamReader(stream, validate_crcs=True).records:
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, McapChannel) and (topics is None or record.topic in topics):
            channels[record.id] = channel_of(record.id, {record.id: record}, schemas)
        elif isinstance(record, Message) and low <= record.log_time < high:
            rows.append(record)
    rows = [m for m in rows if m.channel_id in channels]
    end = np.cumsum([len(m.data) for m in rows], dtype=np.int64)
    yield (
        Block(
            np.frombuffer(b"".join(m.data for m in rows), np.uint8),
            np.array([m.channel_id for m in rows], np.int64),
            np.array([m.log_time for m in rows], np.int64),
            np.array([m.publish_time for m in rows], np.int64),
            end - np.array([len(m.data) for m in rows], np.int64),
            end,
        ).sorted(),
        channels,
    )
