"""Catalogue of a folder of recordings, as one Parquet table with SQL queries.

`describe` describes one recording, `table` stores the rows of a folder beside its recordings, and
`query` filters them with SQL.
"""

from dmrl.catalogue.describe import Row, describe, unreadable_row
from dmrl.catalogue.table import FILE_NAME, Catalogue, open_catalogue

__all__ = ["FILE_NAME", "Catalogue", "Row", "describe", "open_catalogue", "unreadable_row"]
