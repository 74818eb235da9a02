"""Decompress and parse MCAP chunks."""

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

from dmrl.guards import limits
from dmrl.recording.mcap.file import DEFINITIONS, RECORD, damaged, too_large
from dmrl.recording.mcap.file_writer import laid_out
from dmrl.recording.mcap.message_batch import HEAD_BYTES, Block, Bytes, Ints, put_at, taken

RECORD_HEADER = 1 + 8  # opcode, length
MESSAGE = int(Opcode.MESSAGE)
MESSAGE_HEADER = HEAD_BYTES - RECORD_HEADER  # channel id, sequence, log time, publish time
HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("time", "<u8"),
        ("publish", "<u8"),
    ]
)
"""Layout of a Message record up to its payload."""


def unpacked(path: Path, chunk: Chunk, offset: int) -> Bytes:
    """Decompress the records of a chunk and check their size and CRC.

    Raises
    ------
    RecordingError
        If the size exceeds the budget or differs from the chunk's uncompressed size, the data
        cannot be decompressed, or the CRC does not match.
    """
    size = chunk.uncompressed_size
    if size > limits.UNPACKED_BYTES:
        raise too_large(path, f"the chunk at byte {offset} unpacks to {size / 1e6:.0f} MB")
    try:
        data = _decompressed(chunk.compression, chunk.data, size)
    except (zstandard.ZstdError, RuntimeError, MemoryError, ValueError) as e:
        raise damaged(path, f"chunk at byte {offset}: {e}") from e
    if len(data) != size:
        raise damaged(path, f"chunk at byte {offset} unpacks to another size than it states")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise damaged(path, f"chunk at byte {offset} fails its CRC")
    return np.frombuffer(data, np.uint8)


def _decompressed(compression: str, data: bytes, size: int) -> bytes:
    """Decompress to at most ``size`` bytes. Neither decoder reserves more memory than that."""
    if compression == "zstd":
        if zstandard.frame_content_size(data) > size:
            raise ValueError("unpacks to more than the size that it states")
        if not size:
            return b""
        return zstandard.ZstdDecompressor().decompress(data, size)
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    if compression == "":
        return data
    raise ValueError(f"unknown compression {compression!r}")


def messages_at(data: Bytes, at_record: Ints) -> Block:
    """Build a batch from the offsets of Message records, each at least a prefix before the end."""
    heads = taken(data, HEAD, at_record)
    return Block(
        data,
        heads["channel"].astype(np.int64),
        heads["time"].astype(np.int64),
        heads["publish"].astype(np.int64),
        at_record + HEAD_BYTES,
        at_record + RECORD_HEADER + heads["length"].astype(np.int64),
    )


def set_heads(
    records: Bytes, at: Ints, number: Ints, time_ns: Ints, publish_ns: Ints, *, fresh: bool = False
) -> None:
    """Write channel ids and times into Message records.

    Parameters
    ----------
    records
        Message records, contiguous.
    at
        (N + 1,) offset of each record, and the end of the last.
    channel_ids, time_ns, publish_ns
        (N,) channel ids and times to write, nanoseconds.
    fresh
        The prefixes are empty: write opcode and length as well.
    """
    at, size = at[:-1], np.diff(at)
    heads = np.zeros(len(at), HEAD) if fresh else taken(records, HEAD, at)
    heads["channel"], heads["time"], heads["publish"] = number, time_ns, publish_ns
    if fresh:
        heads["opcode"], heads["length"] = MESSAGE, size - RECORD_HEADER
    put_at(records, at, heads)


@dataclass(frozen=True, slots=True)
class Scan:
    """A chunk parsed record by record.

    Parameters
    ----------
    data
        Decompressed records.
    messages
        Offset of each Message record.
    others
        Opcode, start and end of every other record.
    """

    data: Bytes
    messages: list[int]
    others: list[tuple[int, int, int]]

    @property
    def block(self) -> Block:
        """All messages of the chunk."""
        return messages_at(self.data, np.array(self.messages, np.int64))

    def definitions(self) -> Iterator[Schema | Channel]:
        """Yield the Schema and Channel records of the chunk."""
        for opcode, at, end in self.others:
            if opcode in DEFINITIONS:
                body = BytesIO(self.data[at + RECORD_HEADER : end].tobytes())
                yield DEFINITIONS[opcode].read(ReadDataStream(body))


def scanned(data: Bytes) -> Scan:
    """Parse the records of a chunk one after the other, without its message indexes.

    Raises
    ------
    McapError
        If a record runs beyond the chunk, or is too short.
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


def beside(block: Block) -> Scan | None:
    """Return the records of a chunk other than the messages of a batch, or None.

    The batch must hold all messages of the chunk. None: there are other messages, or some overlap.
    """
    first = np.append(block.start - HEAD_BYTES, len(block.data))
    last = np.concatenate([[0], block.end])
    if (first < last).any():
        return None
    found = Scan(block.data, [], [])
    for gap in np.flatnonzero(first != last).tolist():
        before = int(last[gap])
        scan = scanned(block.data[before : first[gap]])
        if scan.messages:
            return None
        found.others.extend((opcode, before + at, before + end) for opcode, at, end in scan.others)
    return found


def of_channels(block: Block, numbers: Collection[int], known: Collection[int]) -> Block:
    """Select the messages of some channels.

    Raises
    ------
    McapError
        If the channel of a message is not in ``defined``, or a time is beyond the year 2262, the
        end of signed 64-bit nanoseconds.
    """
    present = set(block.numbers())
    if unknown := present - set(known):
        raise McapError(f"messages of channel {min(unknown)}, which is not defined")
    block = possible(block)
    return block if present <= set(numbers) else block.of(numbers)


def possible(block: Block) -> Block:
    """Return the batch; raise McapError if a time is beyond the year 2262."""
    if not block.possible.all():
        raise McapError("a message has a time beyond the year 2262")
    return block


def loose(messages: list[Message]) -> Block:
    """Build a batch from messages that are outside of chunks."""
    records = [laid_out(message) for message in messages]
    size = np.array([len(record) for record in records], np.int64)
    return messages_at(np.frombuffer(b"".join(records), np.uint8), np.cumsum(size) - size)
