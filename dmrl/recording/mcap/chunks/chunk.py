"""Decompress and parse MCAP chunks."""

import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BytesIO

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema

from dmrl.guards import limits
from dmrl.recording.mcap.file import DEFINITIONS, RECORD_STRUCT, BudgetError
from dmrl.recording.mcap.file_writer import serialize
from dmrl.recording.mcap.message_batch import (
    MESSAGE_PREFIX_BYTES,
    Bytes,
    Ints,
    MessageBatch,
    gather,
    scatter,
)

RECORD_HEADER_BYTES = 1 + 8  # opcode, length
MESSAGE_OPCODE = int(Opcode.MESSAGE)
MESSAGE_HEADER_BYTES = MESSAGE_PREFIX_BYTES - RECORD_HEADER_BYTES
"""Of channel id, sequence, log time and publish time."""
MESSAGE_PREFIX_DTYPE = np.dtype(
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


def decompress(chunk: Chunk, offset: int) -> Bytes:
    """Decompress the records of a chunk and check their size and CRC.

    Raises
    ------
    McapError
        If the size exceeds the budget or differs from the chunk's uncompressed size, the data
        cannot be decompressed, or the CRC does not match.
    """
    size = chunk.uncompressed_size
    if size > limits.UNPACKED_BYTES:
        raise BudgetError(f"the chunk at byte {offset} decompresses to {size / 1e6:.0f} MB")
    try:
        data = _decompress_bytes(chunk.compression, chunk.data, size)
    except (zstandard.ZstdError, RuntimeError, MemoryError, ValueError) as e:
        raise McapError(f"chunk at byte {offset}: {e}") from e
    if len(data) != size:
        raise McapError(f"chunk at byte {offset} decompresses to another size than it states")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise McapError(f"chunk at byte {offset} fails its CRC")
    return np.frombuffer(data, np.uint8)


def _decompress_bytes(compression: str, data: bytes, size: int) -> bytes:
    """Decompress to at most ``size`` bytes. Neither decoder reserves more memory than that."""
    if compression == "zstd":
        if zstandard.frame_content_size(data) > size:
            raise ValueError("decompresses to more than the size that it states")
        if not size:
            return b""
        return zstandard.ZstdDecompressor().decompress(data, size)
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    if compression == "":
        return data
    raise ValueError(f"unknown compression {compression!r}")


def build_batch_at(data: Bytes, offsets: Ints) -> MessageBatch:
    """Build a batch from the offsets of Message records, each at least a prefix before the end."""
    heads = gather(data, MESSAGE_PREFIX_DTYPE, offsets)
    return MessageBatch(
        data,
        heads["channel"].astype(np.int64),
        heads["time"].astype(np.int64),
        heads["publish"].astype(np.int64),
        offsets + MESSAGE_PREFIX_BYTES,
        offsets + RECORD_HEADER_BYTES + heads["length"].astype(np.int64),
    )


def write_message_prefixes(
    records: Bytes,
    at: Ints,
    channel_ids: Ints,
    time_ns: Ints,
    publish_ns: Ints,
    *,
    fresh: bool = False,
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
    kind = MESSAGE_PREFIX_DTYPE
    heads = np.zeros(len(at), kind) if fresh else gather(records, kind, at)
    heads["channel"], heads["time"], heads["publish"] = channel_ids, time_ns, publish_ns
    if fresh:
        heads["opcode"], heads["length"] = MESSAGE_OPCODE, size - RECORD_HEADER_BYTES
    scatter(records, at, heads)


@dataclass(frozen=True, slots=True)
class ParsedChunk:
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
    def batch(self) -> MessageBatch:
        """All messages of the chunk."""
        return build_batch_at(self.data, np.array(self.messages, np.int64))

    def iter_definitions(self) -> Iterator[Schema | Channel]:
        """Yield the Schema and Channel records of the chunk."""
        for opcode, at, end in self.others:
            if opcode in DEFINITIONS:
                body = BytesIO(self.data[at + RECORD_HEADER_BYTES : end].tobytes())
                yield DEFINITIONS[opcode].read(ReadDataStream(body))


def parse_records(data: Bytes) -> ParsedChunk:
    """Parse the records of a chunk one after the other, without its message indexes.

    Raises
    ------
    McapError
        If a record runs beyond the chunk, or is too short.
    """
    view, at, size, unpack = data.data, 0, len(data), RECORD_STRUCT.unpack_from
    scan = ParsedChunk(data, [], [])
    while at < size:
        if at + RECORD_HEADER_BYTES > size:
            raise McapError("a chunk ends within a record")
        opcode, length = unpack(view, at)
        end = at + RECORD_HEADER_BYTES + length
        if end > size or (opcode == MESSAGE_OPCODE and length < MESSAGE_HEADER_BYTES):
            raise McapError("a record in a chunk has a wrong length")
        if opcode == MESSAGE_OPCODE:
            scan.messages.append(at)
        else:
            scan.others.append((opcode, at, end))
        at = end
    return scan


def other_records(batch: MessageBatch) -> ParsedChunk | None:
    """Return the records of a chunk other than the messages of a batch, or None.

    The batch must hold all messages of the chunk. None: there are other messages, or some overlap.
    """
    first = np.append(batch.start - MESSAGE_PREFIX_BYTES, len(batch.data))
    last = np.concatenate([[0], batch.end])
    if (first < last).any():
        return None
    found = ParsedChunk(batch.data, [], [])
    for gap in np.flatnonzero(first != last).tolist():
        before = int(last[gap])
        scan = parse_records(batch.data[before : first[gap]])
        if scan.messages:
            return None
        found.others.extend((opcode, before + at, before + end) for opcode, at, end in scan.others)
    return found


def select_channels(
    batch: MessageBatch, channel_ids: Collection[int], defined: Collection[int]
) -> MessageBatch:
    """Select the messages of some channels.

    Raises
    ------
    McapError
        If the channel of a message is not in ``defined``, or a time is beyond the year 2262, the
        end of signed 64-bit nanoseconds.
    """
    present = set(batch.list_channel_ids())
    if unknown := present - set(defined):
        raise McapError(f"messages of channel {min(unknown)}, which is not defined")
    batch = require_valid_times(batch)
    return batch if present <= set(channel_ids) else batch.select_channels(channel_ids)


def require_valid_times(batch: MessageBatch) -> MessageBatch:
    """Return the batch; raise McapError if a time is beyond the year 2262."""
    if not batch.has_valid_times.all():
        raise McapError("a message has a time beyond the year 2262")
    return batch


def batch_from_messages(messages: list[Message]) -> MessageBatch:
    """Build a batch from messages that are outside of chunks."""
    records = [serialize(message) for message in messages]
    size = np.array([len(record) for record in records], np.int64)
    return build_batch_at(np.frombuffer(b"".join(records), np.uint8), np.cumsum(size) - size)
