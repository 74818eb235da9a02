"""A folder of recordings as one Parquet table: what each holds, what is wrong with it, queries.

`describe` looks at one recording, `table` keeps the rows of a folder beside its recordings, and
`query` asks them in SQL.
"""

from dmrl.catalogue.describe import Row, describe, unread
from dmrl.catalogue.table import NAME, Catalogue, open_catalogue

__all__ = ["NAME", "Catalogue", "Row", "describe", "open_catalogue", "unread"]
