"""Arrow datasets: what trainers see of recordings.

`layout` says what a dataset looks like, `rows` and `splits` make rows from recordings,
`write` and `read` store and open them.
"""

from dmrl.datasets.read import Dataset, Split, is_dataset, open_dataset

__all__ = ["Dataset", "Split", "is_dataset", "open_dataset"]
