"""Read, write and describe Arrow datasets, the input of training.

`layout` defines the columns and files. `writing` builds rows from recordings and stores them;
`read` opens the result.
"""

from dmrl.datasets.read import Dataset, Split, is_dataset, open_dataset

__all__ = ["Dataset", "Split", "is_dataset", "open_dataset"]
