"""Collect messages into one chunk until it is full, then compress it."""

import struct
import zlib
from array import array

import numpy as np
import zstandard

from dmrl.recording.mcap.chunk import MESSAGE, RECORD_HEADER, messages_at
from dmrl.recording.mcap.file_writer import Packed
from dmrl.recording.mcap.message_batch import HEAD_BYTES, Bytes, Ints
from dmrl.recording.mcap.message_index import index_of

CHUNK_BYTES = 256 * 1024
"""Target size of a chunk, uncompressed bytes.

Costs no file size against 1 MiB, and bounds the data that a crash can lose.
"""
LEVEL = 1
"""zstd compression level.

Takes half the time of the default 3, and sensor values do not get larger.
"""
HEAD = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log and publish time
BODY_BYTES = HEAD_BYTES - RECORD_HEADER  # part of the prefix that the record length counts


class OpenChunk:
    """One chunk that is being filled, with messages of one kind: images or numbers.

    Attributes
    ----------
    age
        Chunks of the other kind that were written since this one was started.
    """

    def __init__(self) -> None:
        self.data, self.starts, self.age = bytearray(), array("q"), 0

    @property
    def full(self) -> bool:
        """Whether the chunk has reached its target size."""
        return len(self.data) > CHUNK_BYTES

    def define(self, record: bytes) -> None:
        """Add a Schema or Channel record."""
        self.data += record

    def add(self, number: int, time_ns: int, publish_ns: int, payload: bytes) -> None:
        """Add one message."""
        head = HEAD.pack(MESSAGE, len(payload) + BODY_BYTES, number, 0, time_ns, publish_ns)
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

    def packed(self) -> Packed:
        """Compress the chunk, build its message indexes, and start an empty chunk."""
        data = np.frombuffer(bytes(self.data), np.uint8)
        block = messages_at(data, np.array(self.starts, np.int64))
        squeezed = zstandard.ZstdCompressor(level=LEVEL).compress(data.data)
        crc = zlib.crc32(data.data)
        self.data, self.starts, self.age = bytearray(), array("q"), 0
        return Packed("zstd", squeezed, len(data), crc, *block.span, index_of(block))
