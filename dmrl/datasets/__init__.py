"""Read, write and describe Arrow datasets, the input of training.

`layout` defines the columns and files. `writing` builds rows from recordings and stores them;
`read` opens the result. A name is imported on first use: `settings` needs no Arrow.
"""

from typing import TYPE_CHECKING

from dmrl.guards.lazy_names import import_lazily

if TYPE_CHECKING:
    from dmrl.datasets.read import Dataset, Split, is_dataset, open_dataset

__all__ = ["Dataset", "Split", "is_dataset", "open_dataset"]

if not TYPE_CHECKING:
    __getattr__ = import_lazily(__name__, dict.fromkeys(__all__, "dmrl.datasets.read"))
