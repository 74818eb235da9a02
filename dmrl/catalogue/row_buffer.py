"""Rows of a catalogue that is being made, most of them as Arrow."""

from dataclasses import dataclass, field

import pyarrow as pa

from dmrl.catalogue.describe import Row
from dmrl.catalogue.table import to_table

BUFFERED_ROWS = 500
"""Most rows that are held as Python values."""


@dataclass(slots=True)
class RowBuffer:
    """Rows in the order in which they were added."""

    parts: list[pa.Table] = field(default_factory=lambda: [to_table([])])
    buffered: list[Row] = field(default_factory=list)

    def add(self, row: Row) -> None:
        """Add a row."""
        self.buffered.append(row)
        if len(self.buffered) >= BUFFERED_ROWS:
            self._flush()

    def to_table(self) -> pa.Table:
        """Return all rows."""
        self._flush()
        return pa.concat_tables(self.parts)

    def _flush(self) -> None:
        self.parts.append(to_table(self.buffered))
        self.buffered.clear()
