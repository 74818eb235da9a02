"""Rows of a dataset as a torch Dataset, and a DataLoader that reads whole batches."""

import os
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from dmrl.errors import SettingError
from dmrl.learn.data.batches import epoch_indices

TensorRow = dict[str, Tensor]


class RowSource(Protocol):
    """Protocol of a data source that reads many rows at a time."""

    def __len__(self) -> int: ...

    def gathered(self, rows: Sequence[int], /) -> dict[str, NDArray[Any]]:
        """Return arrays whose first axis is the rows; ``image`` is (N, H, W, 3)."""
        ...


class TorchRows(Dataset[TensorRow]):
    """Torch dataset of rows: ``image`` (3, H, W) uint8, the other columns unchanged.

    Parameters
    ----------
    source
        Source of the rows.
    """

    def __init__(self, source: RowSource) -> None:
        self.source = source

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: int) -> TensorRow:
        return {name: value[0] for name, value in self.get_batch([index]).items()}

    def __getitems__(self, indices: Sequence[int]) -> TensorRow:
        """Return a batch for a DataLoader: read at once, it needs no collation."""
        return self.get_batch(indices)

    def get_batch(self, indices: Sequence[int]) -> TensorRow:
        """Return rows as stacked tensors."""
        arrays = self.source.gathered(indices)
        tensors = {
            name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()
        }
        return tensors | {"image": tensors["image"].permute(0, 3, 1, 2)}


class ProcessSampler(Sampler[int]):
    """Sampler of the rows that one of several processes reads in an epoch.

    Parameters
    ----------
    count
        Number of rows in total.
    part
        Rank of this process, from 0, and number of processes. Their rows in an epoch are disjoint.
    shuffle
        Use another order in each epoch. All processes then read equally many rows, as synchronised
        training requires; each epoch leaves out other rows of the remainder. Otherwise each row is
        read once, in order.
    seed
        Seed of the orders. It must be the same in all processes.

    Raises
    ------
    SettingError
        If the rank is not below the number of processes.
    """

    def __init__(self, count: int, part: tuple[int, int], *, shuffle: bool, seed: int) -> None:
        self.number, self.parts = part
        if not 0 <= self.number < self.parts:
            raise SettingError(f"no process {self.number} of {self.parts}. They count from 0")
        self.count, self.shuffle, self.seed, self.epoch = count, shuffle, seed, 0

    def __len__(self) -> int:
        low, high = self._row_range()
        return high - low

    def __iter__(self) -> Iterator[int]:
        low, high = self._row_range()
        if not self.shuffle:
            return iter(range(low, high))
        rows = epoch_indices(self.count, seed=self.seed, epoch=self.epoch)[low:high]
        self.epoch += 1
        return iter(rows.tolist())

    def _row_range(self) -> tuple[int, int]:
        if self.shuffle:
            each = self.count // self.parts
            return self.number * each, (self.number + 1) * each
        low, high = (k * self.count // self.parts for k in (self.number, self.number + 1))
        return low, high


def get_torchrun_rank() -> tuple[int, int]:
    """Return rank and number of processes from torchrun; (0, 1) without it."""
    try:
        return int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
    except ValueError:
        raise SettingError("RANK and WORLD_SIZE are no numbers. Start with torchrun") from None


def loader_of(
    source: RowSource,
    batch_size: int,
    *,
    shuffle: bool,
    seed: int,
    workers: int,
    part: tuple[int, int] | None,
) -> DataLoader[TensorRow]:
    """Build a DataLoader that reads each batch at once.

    ``part`` is as in `ProcessSampler`; None: that of torchrun.

    Raises
    ------
    SettingError
        If there is no such part, or a number is out of range.
    """
    for name, value, least in (("batch_size", batch_size, 1), ("workers", workers, 0)):
        if not isinstance(value, int) or value < least:
            raise SettingError(f"{name} = {value!r}. Give a whole number, {least} or more")
    if seed < 0:
        raise SettingError(f"seed = {seed}. Give 0 or more")
    return DataLoader(
        TorchRows(source),
        batch_size=batch_size,
        sampler=ProcessSampler(
            len(source), part or get_torchrun_rank(), shuffle=shuffle, seed=seed
        ),
        num_workers=workers,
        collate_fn=_identity_collate,
        generator=torch.Generator().manual_seed(seed),
    )


def _identity_collate(batch: Any) -> Any:
    return batch
