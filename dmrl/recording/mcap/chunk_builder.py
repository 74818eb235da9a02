"""A chunk that messages are put into, one at a time or many, until it is full."""

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
"""Costs no size against 1 MiB, and bounds what a crash can lose."""
LEVEL = 1
"""Of zstd: half the time of its usual 3, and numbers of sensors are no larger."""
HEAD = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log and publish time
BODY_BYTES = HEAD_BYTES - RECORD_HEADER  # of a head, that the length of its record counts


class OpenChunk:
    """Records of one kind that were not written yet.

    ``age`` counts the chunks of the other kind that were written since it was begun.
    """

    def __init__(self) -> None:
        self.data, self.starts, self.age = bytearray(), array("q"), 0

    @property
    def full(self) -> bool:
        """Whether it is to be written."""
        return len(self.data) > CHUNK_BYTES

    def define(self, record: bytes) -> None:
        """Put in what defines a channel or its schema."""
        self.data += record

    def add(self, number: int, time_ns: int, publish_ns: int, payload: bytes) -> None:
        """Put in one message."""
        head = HEAD.pack(MESSAGE, len(payload) + BODY_BYTES, number, 0, time_ns, publish_ns)
        self.starts.append(len(self.data))
        self.data += head
        self.data += payload

    def fill(self, records: Bytes, at: Ints) -> int:
        """Put in the first of some records until it is full: how many.

        Parameters
        ----------
        records
            Message records, one after another.
        at
            (N + 1,) where each starts, and the end of the last.
        """
        room = CHUNK_BYTES - len(self.data)
        fitting = int(np.searchsorted(at - at[0], room, side="right"))
        # One at least: a chunk that definitions fill alone is only written with a message.
        count = min(max(fitting, 1), len(at) - 1)
        self.starts.frombytes((at[:count] - at[0] + len(self.data)).tobytes())
        self.data += records[at[0] : at[count]].data
        return count

    def packed(self) -> Packed:
        """The chunk, compressed; it is empty then."""
        data = np.frombuffer(bytes(self.data), np.uint8)
        block = messages_at(data, np.array(self.starts, np.int64))
        squeezed = zstandard.ZstdCompressor(level=LEVEL).compress(data.data)
        crc = zlib.crc32(data.data)
        self.data, self.starts, self.age = bytearray(), array("q"), 0
        return Packed("zstd", squeezed, len(data), crc, *block.span, index_of(block))
