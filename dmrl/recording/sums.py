"""Sums over what MCAP gives no checksum of its own: metadata and message indexes.

The last metadata record of a recording that dmrl wrote, `dmrl.crc`, holds the CRC-32 of all
metadata records before it and of all message indexes. The summary, which has a CRC, says that it
is there.
"""

import zlib
from dataclasses import dataclass

from mcap.opcode import Opcode

from dmrl.recording.opening import MAGIC, RECORD

METADATA_NAME = "dmrl.crc"


@dataclass(slots=True)
class Sums:
    """CRC-32 of the metadata records and of the message indexes, in the order of the file."""

    metadata: int = 0
    indexes: int = 0

    def add(self, written: bytes) -> None:
        """Some whole records that were written, or the magic bytes."""
        at = len(MAGIC) if written[: len(MAGIC)] == MAGIC else 0
        while at < len(written):
            opcode, length = RECORD.unpack_from(written, at)
            end = at + RECORD.size + length
            if opcode == Opcode.METADATA:
                self.metadata = zlib.crc32(written[at:end], self.metadata)
            elif opcode == Opcode.MESSAGE_INDEX:
                self.indexes = zlib.crc32(written[at:end], self.indexes)
            at = end

    def to_metadata(self) -> dict[str, str]:
        """As they stand in a recording."""
        return {"metadata": text(self.metadata), "indexes": text(self.indexes)}


def text(crc: int) -> str:
    """A CRC-32 as it stands in a recording."""
    return f"{crc:08x}"
