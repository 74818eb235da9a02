"""A chunk of a recording: unpacked within its budget, and the messages in it."""

import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
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
from dmrl.recording.opening import DEFINITIONS, RECORD, damaged, too_large

RECORD_HEADER = 1 + 8  # opcode, length
MESSAGE = int(Opcode.MESSAGE)
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


def set_heads(
    records: Bytes, at: Ints, number: Ints, time_ns: Ints, publish_ns: Ints, *, fresh: bool = False
) -> None:
    """Write channel number and times into message records.

    Parameters
    ----------
    records
        One after another.
    at
        (N + 1,) where each starts, and the end of the last.
    number, time_ns, publish_ns
        (N,) what to write.
    fresh
        Nothing stands there yet: write the rest of the head as well.
    """
    at, size = at[:-1], np.diff(at)

    def put(offset: int, dtype: str, values: Ints | int) -> None:
        # A view with a stride of one byte writes unaligned integers in one go.
        size = np.dtype(dtype).itemsize
        view = np.ndarray((max(len(records) - size + 1, 0),), dtype, records.data, 0, (1,))
        view[at + offset] = values

    put(RECORD_HEADER, "<u2", number)
    put(RECORD_HEADER + 6, "<u8", time_ns)
    put(RECORD_HEADER + 14, "<u8", publish_ns)
    if fresh:
        put(0, "<u1", MESSAGE)
        put(1, "<u8", size - RECORD_HEADER)


@dataclass(frozen=True, slots=True)
class Scan:
    """A chunk, gone through record by record.

    Parameters
    ----------
    data
        Its records.
    messages
        Where those of messages start.
    others
        Opcode, start and end of the others.
    """

    data: Bytes
    messages: list[int]
    others: list[tuple[int, int, int]]

    @property
    def block(self) -> Block:
        """Its messages."""
        return messages_at(self.data, np.array(self.messages, np.int64))

    def definitions(self) -> Iterator[Schema | Channel]:
        """The schemas and channels that it defines."""
        for opcode, at, end in self.others:
            if opcode in DEFINITIONS:
                body = BytesIO(self.data[at + RECORD_HEADER : end].tobytes())
                yield DEFINITIONS[opcode].read(ReadDataStream(body))


def scanned(data: Bytes) -> Scan:
    """A chunk's records, found one after the other, without its message index.

    Raises
    ------
    McapError
        If one runs beyond the chunk, or is too short.
    """
    view, at, size, unpack = data.data, 0, len(data), RECORD.unpack_from
    scan = Scan(data, [], [])
    while at < size:
        if at + RECORD_HEADER > size:
            raise McapError("a chunk ends within a record")
        opcode, length = unpack(view, at)
        end = at + RECORD_HEADER + length
        if end > size or (opcode == MESSAGE and length < MESSAGE_HEADER):
            raise McapError("a record in a chunk has a wrong length")
        if opcode == MESSAGE:
            scan.messages.append(at)
        else:
            scan.others.append((opcode, at, end))
        at = end
    return scan


def of_channels(block: Block, numbers: Collection[int], known: Collection[int]) -> Block:
    """The messages of some channels.

    Raises
    ------
    McapError
        If a message is of no channel in ``known``, or its time is beyond the year 2262, where 64
        bits with a sign end.
    """
    present = set(block.numbers())
    if unknown := present - set(known):
        raise McapError(f"messages of channel {min(unknown)}, which is not defined")
    if not block.possible.all():
        raise McapError("a message has a time beyond the year 2262")
    return block if present <= set(numbers) else block.of(numbers)


def loose(messages: list[Message]) -> Block:
    """Messages that stand outside of chunks, as a block."""
    records = [laid_out(message) for message in messages]
    size = np.array([len(record) for record in records], np.int64)
    return messages_at(np.frombuffer(b"".join(records), np.uint8), np.cumsum(size) - size)
