"""A chunk of a recording: unpacked within its budget, and the messages in it."""

import struct
import zlib
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema

from dmrl.border import limits
from dmrl.recording.block import HEAD_BYTES, Block, Bytes, Ints
from dmrl.recording.container import laid_out
from dmrl.recording.opening import damaged, too_large

RECORD_HEADER = 1 + 8  # opcode, length
MESSAGE_HEADER = HEAD_BYTES - RECORD_HEADER  # channel id, sequence, log time, publish time


def unpacked(path: Path, chunk: Chunk, offset: int) -> Bytes:
    """The records of a chunk, decompressed and checked against its CRC.

    Raises
    ------
    RecordingError
        If they are more than the budget, are not as many as the chunk says, cannot be
        decompressed, or the CRC does not match.
    """
    size = chunk.uncompressed_size
    if size > limits.UNPACKED_BYTES:
        raise too_large(path, f"the chunk at byte {offset} unpacks to {size / 1e6:.0f} MB")
    try:
        data = _decompressed(chunk.compression, chunk.data, size)
    except (zstandard.ZstdError, RuntimeError, MemoryError, ValueError) as e:
        raise damaged(path, f"chunk at byte {offset}: {e}") from e
    if len(data) != size:
        raise damaged(path, f"chunk at byte {offset} unpacks to more or less than it says")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise damaged(path, f"chunk at byte {offset} fails its CRC")
    return np.frombuffer(data, np.uint8)


def _decompressed(compression: str, data: bytes, size: int) -> bytes:
    """What ``size`` bytes were compressed to. Neither decoder reserves more than ``size``."""
    if compression == "zstd":
        if zstandard.frame_content_size(data) > size:
            raise ValueError("unpacks to more than it says")
        if not size:
            return b""
        return zstandard.ZstdDecompressor().decompress(data, size)
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    if compression == "":
        return data
    raise ValueError(f"unknown compression {compression!r}")


def messages_at(data: Bytes, at_record: Ints) -> Block:
    """The messages whose records start at these offsets, each at least a header before the end."""

    def field(offset: int, dtype: str) -> Ints:
        # A view with a stride of one byte reads unaligned integers in one gather.
        size = np.dtype(dtype).itemsize
        view = np.ndarray((max(len(data) - size + 1, 0),), dtype, data, 0, (1,))
        return view[at_record + offset].astype(np.int64)

    start = at_record + HEAD_BYTES
    return Block(
        data,
        field(RECORD_HEADER, "<u2"),
        field(RECORD_HEADER + 6, "<u8"),
        field(RECORD_HEADER + 14, "<u8"),
        start,
        at_record + RECORD_HEADER + field(1, "<u8"),
    )


def set_heads(records: Bytes, at: Ints, number: Ints, time_ns: Ints, publish_ns: Ints) -> None:
    """Write channel number and times into message records that start at these offsets."""

    def put(offset: int, dtype: str, values: Ints) -> None:
        # A view with a stride of one byte writes unaligned integers in one go.
        size = np.dtype(dtype).itemsize
        view = np.ndarray((max(len(records) - size + 1, 0),), dtype, records.data, 0, (1,))
        view[at + offset] = values

    put(RECORD_HEADER, "<u2", number)
    put(RECORD_HEADER + 6, "<u8", time_ns)
    put(RECORD_HEADER + 14, "<u8", publish_ns)


def headers(data: Bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of every record of a chunk.

    Raises
    ------
    McapError
        If the last runs beyond the chunk.
    """
    view, at = data.data, 0
    while at < len(view):
        if at + RECORD_HEADER > len(view):
            raise McapError("a chunk ends within a record")
        opcode, size = struct.unpack_from("<BQ", view, at)
        end = at + RECORD_HEADER + size
        if end > len(view) or (opcode == Opcode.MESSAGE and size < MESSAGE_HEADER):
            raise McapError("a record in a chunk has a wrong length")
        yield opcode, at, end
        at = end


def scanned(data: Bytes) -> Block:
    """All messages of a chunk, record by record, without its message index.

    Raises
    ------
    McapError
        If a record runs beyond the chunk.
    """
    starts = [at for opcode, at, _ in headers(data) if opcode == Opcode.MESSAGE]
    return messages_at(data, np.array(starts, np.int64))


def of_channels(block: Block, numbers: Collection[int], known: Collection[int]) -> Block:
    """The messages of some channels.

    Raises
    ------
    McapError
        If a message is of no channel in ``known``, or its time is beyond the year 2262, where 64
        bits with a sign end.
    """
    present = set(np.unique(block.channel).tolist())
    if unknown := present - set(known):
        raise McapError(f"messages of channel {min(unknown)}, which is not defined")
    if len(block) and min(int(block.time_ns.min()), int(block.publish_ns.min())) < 0:
        raise McapError("a message has a time beyond the year 2262")
    return block if present <= set(numbers) else block.take(np.isin(block.channel, list(numbers)))


def definitions(data: Bytes) -> Iterator[Schema | Channel]:
    """The schemas and channels that a chunk defines."""
    kinds: dict[int, type[Schema] | type[Channel]] = {
        Opcode.SCHEMA: Schema,
        Opcode.CHANNEL: Channel,
    }
    for opcode, at, end in headers(data):
        if opcode in kinds:
            body = BytesIO(data[at + RECORD_HEADER : end].tobytes())
            yield kinds[opcode].read(ReadDataStream(body))


def loose(messages: list[Message]) -> Block:
    """Messages that stand outside of chunks, as a block."""
    records = [laid_out(message) for message in messages]
    size = np.array([len(record) for record in records], np.int64)
    return messages_at(np.frombuffer(b"".join(records), np.uint8), np.cumsum(size) - size)
