"""Rows of a dataset for a training of one's own: a torch dataset, and a loader by the batch."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

Item = dict[str, Tensor]


class Source(Protocol):
    """Rows that can be taken out many at a time."""

    def __len__(self) -> int: ...

    def gathered(self, rows: Sequence[int], /) -> dict[str, NDArray[Any]]:
        """Arrays with a first axis for the rows; ``image`` (N, H, W, 3) among them."""
        ...


class TorchRows(Dataset[Item]):
    """Rows as tensors: ``image`` (3, H, W) uint8, the rest as it is.

    Parameters
    ----------
    source
        Where they come from.
    """

    def __init__(self, source: Source) -> None:
        self.source = source

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: int) -> Item:
        return {name: value[0] for name, value in self.batch([index]).items()}

    def __getitems__(self, indices: Sequence[int]) -> Item:
        """What a DataLoader calls for a batch: gathered at once, it needs no collation."""
        return self.batch(indices)

    def batch(self, indices: Sequence[int]) -> Item:
        """Some rows, stacked."""
        arrays = self.source.gathered(indices)
        tensors = {
            name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()
        }
        return tensors | {"image": tensors["image"].permute(0, 3, 1, 2)}


def loader_of(
    source: Source, batch_size: int, *, shuffle: bool, seed: int, workers: int
) -> DataLoader[Item]:
    """A DataLoader that gathers each batch at once."""
    return DataLoader(
        TorchRows(source),
        batch_size=batch_size,
        shuffle=shuffle,
        num_workers=workers,
        collate_fn=_as_it_is,
        generator=torch.Generator().manual_seed(seed),
    )


def _as_it_is(batch: Any) -> Any:
    return batch
