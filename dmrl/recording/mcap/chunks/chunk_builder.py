"""Collect messages into one chunk until it is full, then compress it."""

import struct
import zlib
from array import array

import numpy as np
import zstandard

from dmrl.recording.mcap.chunks.chunk import MESSAGE_OPCODE, RECORD_HEADER_BYTES, build_batch_at
from dmrl.recording.mcap.file_writer import CompressedChunk
from dmrl.recording.mcap.message_batch import MESSAGE_PREFIX_BYTES, Bytes, Ints
from dmrl.recording.mcap.message_index import build_message_index

CHUNK_BYTES = 256 * 1024
"""Target size of a chunk, uncompressed bytes.

Costs no file size against 1 MiB, and bounds the data that a crash can lose.
"""
ZSTD_LEVEL = 1
"""zstd compression level.

Takes half the time of the default 3, and sensor values do not get larger.
"""
SAMPLE_SHARE, PACKED_SHARE_MAX = 8, 0.95
"""Part of a chunk of images, its first eighth, that is compressed to find out whether that helps.

JPEG and PNG do not get smaller. Chunks of them are stored as they are.
"""
MESSAGE_PREFIX_STRUCT = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time and publish time."""
PREFIX_BODY_BYTES = MESSAGE_PREFIX_BYTES - RECORD_HEADER_BYTES
"""Part of the prefix that the record length counts."""


class ChunkBuilder:
    """One chunk that is being filled, with messages of one kind: images or numbers.

    Parameters
    ----------
    images
        It is stored uncompressed if compression does not help.

    Attributes
    ----------
    age
        Chunks of the other kind that were written since this one was started.
    """

    def __init__(self, *, images: bool = False) -> None:
        self.data, self.starts, self.age = bytearray(), array("q"), 0
        self.images = images

    @property
    def full(self) -> bool:
        """Whether the chunk has reached its target size."""
        return len(self.data) > CHUNK_BYTES

    def add_definition(self, record: bytes) -> None:
        """Add a Schema or Channel record."""
        self.data += record

    def add_message(self, channel_id: int, time_ns: int, publish_ns: int, payload: bytes) -> None:
        """Add one message."""
        head = MESSAGE_PREFIX_STRUCT.pack(
            MESSAGE_OPCODE, len(payload) + PREFIX_BODY_BYTES, channel_id, 0, time_ns, publish_ns
        )
        self.starts.append(len(self.data))
        self.data += head
        self.data += payload

    def fill(self, records: Bytes, at: Ints) -> int:
        """Add records until the chunk is full, and return how many were added.

        Parameters
        ----------
        records
            Message records, contiguous.
        at
            (N + 1,) offset of each record, and the end of the last.
        """
        room = CHUNK_BYTES - len(self.data)
        fitting = int(np.searchsorted(at - at[0], room, side="right"))
        # At least one: a chunk filled by definitions alone is only written with a message.
        count = min(max(fitting, 1), len(at) - 1)
        self.starts.frombytes((at[:count] - at[0] + len(self.data)).tobytes())
        self.data += records[at[0] : at[count]].data
        return count

    def compress(self) -> CompressedChunk:
        """Compress the chunk, build its message indexes, and start an empty chunk."""
        data = bytes(self.data)
        batch = build_batch_at(np.frombuffer(data, np.uint8), np.array(self.starts, np.int64))
        compression, packed = _compress(data, may_store=self.images)
        crc = zlib.crc32(data)
        self.data, self.starts, self.age = bytearray(), array("q"), 0
        return CompressedChunk(
            compression, packed, len(data), crc, *batch.time_span_ns, build_message_index(batch)
        )


def _compress(data: bytes, *, may_store: bool) -> tuple[str, bytes]:
    """Return the name of the compression and the compressed data; "" and the data: not smaller."""
    zstd = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
    sample = data[: len(data) // SAMPLE_SHARE]
    if may_store and len(zstd.compress(sample)) > PACKED_SHARE_MAX * len(sample):
        return "", data
    return "zstd", zstd.compress(data)
