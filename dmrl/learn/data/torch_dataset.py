"""Rows of a dataset for a training of one's own: a torch dataset, and a loader by the batch."""

import os
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from dmrl.errors import SettingError
from dmrl.learn.data.batches import order

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


class Part(Sampler[int]):
    """The rows that one of several processes reads in an epoch; another order each time.

    Parameters
    ----------
    count
        Rows of all.
    part
        Which process this is, from 0, and of how many. What they read in an epoch is disjoint.
    shuffle
        All read equally many then, as trainings want that wait for each other: of a remainder
        other rows are left out each time. Else each row is read once, in order.
    seed
        Of the orders. It must be the same everywhere.

    Raises
    ------
    SettingError
        If there is no such part.
    """

    def __init__(self, count: int, part: tuple[int, int], *, shuffle: bool, seed: int) -> None:
        self.number, self.parts = part
        if not 0 <= self.number < self.parts:
            raise SettingError(f"no process {self.number} of {self.parts}. They count from 0")
        self.count, self.shuffle, self.seed, self.epoch = count, shuffle, seed, 0

    def __len__(self) -> int:
        low, high = self._ends()
        return high - low

    def __iter__(self) -> Iterator[int]:
        low, high = self._ends()
        if not self.shuffle:
            return iter(range(low, high))
        rows = order(self.count, seed=self.seed, epoch=self.epoch)[low:high]
        self.epoch += 1
        return iter(rows.tolist())

    def _ends(self) -> tuple[int, int]:
        if self.shuffle:
            each = self.count // self.parts
            return self.number * each, (self.number + 1) * each
        low, high = (k * self.count // self.parts for k in (self.number, self.number + 1))
        return low, high


def part_of_torchrun() -> tuple[int, int]:
    """Which process of how many this is, as torchrun tells it; the only one, without."""
    try:
        return int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
    except ValueError:
        raise SettingError("RANK and WORLD_SIZE are no numbers. Start with torchrun") from None


def loader_of(
    source: Source,
    batch_size: int,
    *,
    shuffle: bool,
    seed: int,
    workers: int,
    part: tuple[int, int] | None,
) -> DataLoader[Item]:
    """A DataLoader that gathers each batch at once; ``part`` as `Part` has it, None: torchrun's."""
    return DataLoader(
        TorchRows(source),
        batch_size=batch_size,
        sampler=Part(len(source), part or part_of_torchrun(), shuffle=shuffle, seed=seed),
        num_workers=workers,
        collate_fn=_as_it_is,
        generator=torch.Generator().manual_seed(seed),
    )


def _as_it_is(batch: Any) -> Any:
    return batch
