"""Parquet writer for disks that may refuse a write."""

from contextlib import suppress

import pyarrow.parquet as pq


class ParquetWriter(pq.ParquetWriter):  # type: ignore[misc] # Arrow has no types
    """`pyarrow.parquet.ParquetWriter` that raises an error of the disk once.

    Arrow's closes the file again when it is collected, and prints a traceback if that fails too.
    """

    def __del__(self) -> None:
        with suppress(OSError):
            super().__del__()
