"""Checksums of the parts that MCAP leaves unprotected: metadata and message indexes.

The last Metadata record of a recording that dmrl wrote is `dmrl.crc`. It contains the CRC-32 of
all earlier Metadata records, the CRC-32 of all Message Index records, and its own byte offset.
The Summary section, which has a CRC, lists this record. Another program may copy the record into
a rewritten file. The offset is then different, and the checksums are ignored.
"""

import zlib
from dataclasses import dataclass

METADATA_NAME = "dmrl.crc"


@dataclass(slots=True)
class Checksums:
    """CRC-32 of the Metadata records and of the Message Index records, in file order."""

    metadata: int = 0
    indexes: int = 0

    def add_metadata(self, record: bytes) -> None:
        """Add a complete Metadata record that was written."""
        self.metadata = zlib.crc32(record, self.metadata)

    def add_message_indexes(self, records: bytes) -> None:
        """Add complete Message Index records that were written."""
        self.indexes = zlib.crc32(records, self.indexes)

    def to_metadata(self, at: int) -> dict[str, str]:
        """Return the values of the metadata record that starts at this byte."""
        return {
            "metadata": format_crc(self.metadata),
            "indexes": format_crc(self.indexes),
            "at": str(at),
        }


def belongs_to_file(values: dict[str, str], at: int) -> bool:
    """Return whether checksums at this byte belong to this file, not to a copied one."""
    return values.get("at", str(at)) == str(at)


def format_crc(crc: int) -> str:
    """Format a CRC-32 as it is stored in a recording."""
    return f"{crc:08x}"
