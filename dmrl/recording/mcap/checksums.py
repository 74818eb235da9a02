"""Sums over what MCAP gives no checksum of its own: metadata and message indexes.

The last metadata record of a recording that dmrl wrote, `dmrl.crc`, holds the CRC-32 of all
metadata records before it and of all message indexes, and the byte at which it stands. The
summary, which has a CRC, says that it is there. Another program that writes the recording anew
may copy this record; then it stands elsewhere, and says nothing of the new file.
"""

import zlib
from dataclasses import dataclass

METADATA_NAME = "dmrl.crc"


@dataclass(slots=True)
class Sums:
    """CRC-32 of the metadata records and of the message indexes, in the order of the file."""

    metadata: int = 0
    indexes: int = 0

    def add_metadata(self, record: bytes) -> None:
        """A whole metadata record that was written."""
        self.metadata = zlib.crc32(record, self.metadata)

    def add_indexes(self, records: bytes) -> None:
        """Whole message indexes that were written."""
        self.indexes = zlib.crc32(records, self.indexes)

    def to_metadata(self, at: int) -> dict[str, str]:
        """As they stand in a recording, from this byte on."""
        return {"metadata": text(self.metadata), "indexes": text(self.indexes), "at": str(at)}


def of_this_file(values: dict[str, str], at: int) -> bool:
    """Whether sums that start at this byte were written there, and not copied from another file."""
    return values.get("at", str(at)) == str(at)


def text(crc: int) -> str:
    """A CRC-32 as it stands in a recording."""
    return f"{crc:08x}"
