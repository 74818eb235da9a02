"""A dataset as an object: arrays, data frames, and torch loaders."""

import os
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dmrl.api import notebook_display
from dmrl.datasets import Dataset, Split, layout, open_dataset
from dmrl.errors import DatasetError, MissingExtra, optional_imports
from dmrl.exchange.csv_parquet import flatten_table
from dmrl.storage import to_path

if TYPE_CHECKING:
    import pandas as pd
    from torch.utils.data import DataLoader
    from torch.utils.data import Dataset as TorchDataset

HEAVY = (layout.PIXELS, layout.IMAGE, layout.MASKS, layout.CONFIDENCE, layout.DEPTH)


class Rows:
    """The rows of one split: an image each, with its peers and grid labels.

    It is a map-style dataset of torch, so a DataLoader accepts it; `loader` gathers whole batches,
    which is faster.

    Parameters
    ----------
    split
        Mapped into memory: nothing is read before it is used.
    """

    def __init__(self, split: Split) -> None:
        self._split = split

    @property
    def name(self) -> str:
        """Name of the split."""
        return self._split.name

    def __len__(self) -> int:
        return len(self._split)

    def __getitem__(self, index: int | slice) -> dict[str, NDArray[Any]]:
        """Return a row as arrays; for a slice such as ``rows[:9]``, rows stacked by `gathered`.

        Returns
        -------
        dict
            ``image`` (H, W, 3) uint8 RGB; ``confidence`` (rows, cols) float32, 1 in the cell of a
            peer's centre, else 0; ``depth`` (rows, cols) float32, metres in such a cell, else 0.

        Raises
        ------
        IndexError
            If there is no such row.
        """
        if isinstance(index, slice):
            return self.gathered(range(*index.indices(len(self))))
        return {name: array[0] for name, array in self.gathered([index]).items()}

    def __iter__(self) -> Iterator[dict[str, NDArray[Any]]]:
        return (self[index] for index in range(len(self)))

    def gathered(self, rows: Sequence[int]) -> dict[str, NDArray[Any]]:
        """Return some rows as arrays, stacked along a first axis.

        Raises
        ------
        IndexError
            If there is no such row, or ``rows`` are not numbers of rows.
        """
        chosen = np.asarray(rows) if len(rows) else np.zeros(0, np.int64)
        if chosen.ndim != 1 or chosen.dtype.kind not in "iu":
            raise IndexError(f"split {self.name}: rows are whole numbers, not {rows!r:.80}")
        if chosen.size and not -len(self) <= chosen.min() <= chosen.max() < len(self):
            raise IndexError(f"split {self.name} has {len(self)} rows, from 0")
        chosen %= max(len(self), 1)
        return {
            "image": self._stack_images(chosen.tolist()),
            "confidence": self._split.grids(layout.CONFIDENCE, chosen.tolist()),
            "depth": self._split.grids(layout.DEPTH, chosen.tolist()),
        }

    def _stack_images(self, rows: list[int]) -> NDArray[np.uint8]:
        images = np.empty((len(rows), *self._split.image_shape, 3), np.uint8)
        for place, image in zip(images, self._split.images(rows), strict=True):
            place[:] = image
        return images

    @property
    def confidence(self) -> NDArray[np.float32]:
        """(N, rows, cols): 1 in the cell of a peer's centre, else 0."""
        return self._split.confidence

    @property
    def depth(self) -> NDArray[np.float32]:
        """(N, rows, cols): depth in metres where the confidence is 1, else 0."""
        return self._split.depth

    @property
    def images(self) -> list[NDArray[np.uint8]]:
        """Images, (n_i, H, W, 3) RGB for each shard or batch: views of the files where raw.

        PNG and JPEG images are decoded on use; ``np.asarray`` decodes a batch.
        """
        return self._split.pixels

    def to_arrow(self) -> pa.Table:
        """Return all columns, mapped from the files."""
        return self._split.table

    def to_pandas(self) -> "pd.DataFrame":
        """Return a row per peer of an image, or one per empty image, without pixels and grids.

        ``source`` is the recording, ``label_source`` the labeller.

        Raises
        ------
        MissingExtra
            If pandas is not installed.
        """
        if find_spec("pandas") is None:
            raise MissingExtra("pandas", "table", "a data frame")
        table = self._split.table
        light = table.drop_columns([name for name in HEAVY if name in table.column_names])
        light = light.append_column("row", pa.array(np.arange(len(self))))
        found = flatten_table(light)
        # The rows' own source is a recording.
        renamed = {"peers.source": "label_source"}
        names = [renamed.get(name, name.removeprefix("peers.")) for name in found.column_names]
        frame: pd.DataFrame = found.rename_columns(names).to_pandas()
        return frame

    def torch(self) -> "TorchDataset[Any]":
        """Return the rows as a dataset of torch: images (3, H, W) uint8, grids float32.

        Raises
        ------
        MissingExtra
            If torch is not installed.
        """
        found: TorchDataset[Any] = _import_torch_dataset().TorchRows(self)
        return found

    def loader(
        self,
        batch_size: int = 32,
        *,
        shuffle: bool = False,
        seed: int = 0,
        workers: int = 0,
        part: tuple[int, int] | None = None,
    ) -> "DataLoader[Any]":
        """Return a DataLoader of torch that gathers each batch at once.

        Parameters
        ----------
        batch_size
            Rows of a batch; the last may have fewer.
        shuffle
            Change the order every epoch; in a large split, 8,192 rows at a time of shuffled blocks.
        seed
            Seed of the orders.
        workers
            Processes that gather batches ahead; 0: this one.
        part
            ``(k, n)``: this is process k of n, from 0, and reads its own part of the rows. None: as
            torchrun says (RANK, WORLD_SIZE), or all of them.

        Returns
        -------
        DataLoader
            Of dictionaries: ``image`` (N, 3, H, W) uint8, ``confidence`` and ``depth``
            (N, rows, cols) float32.

        Raises
        ------
        MissingExtra
            If torch is not installed.
        SettingError
            If there is no such part, or a number is out of range.
        """
        found: DataLoader[Any] = _import_torch_dataset().loader_of(
            self, batch_size, shuffle=shuffle, seed=seed, workers=workers, part=part
        )
        return found

    def __repr__(self) -> str:
        height, width = self._split.image_shape
        return f"<split {self.name}: {len(self)} images of {width} x {height} px>"

    def _repr_html_(self) -> str:
        shown = notebook_display.pick_even_indices(len(self))
        return notebook_display.html_images(repr(self)[1:-1], self._split.images(shown))


class Data(Mapping[str, Rows]):
    """A dataset: its splits by name.

    Parameters
    ----------
    found
        The folder, opened.
    """

    def __init__(self, found: Dataset) -> None:
        self._found = found

    @property
    def path(self) -> Path:
        """The folder."""
        return self._found.path

    def __getitem__(self, split: str) -> Rows:
        """Return a split.

        Raises
        ------
        MissingSplit
            If there is none of that name. It is a KeyError as well.
        DatasetError
            If a shard is missing or cut short.
        """
        return Rows(self._found.split(split))

    def __iter__(self) -> Iterator[str]:
        return iter(self._found.splits)

    def __len__(self) -> int:
        """Return the number of splits."""
        return len(self._found.splits)

    def card(self) -> str:
        """Return the card, Markdown.

        Raises
        ------
        DatasetError
            If it has none.
        """
        try:
            return (self.path / "README.md").read_text(encoding="utf-8")
        except OSError:
            raise DatasetError(f"{self.path} has no card. Try: dmrl card {self.path}") from None

    def show(self) -> object:
        """Show it in rerun, row by row: in a notebook's cell, or else in a window."""
        return notebook_display.show_in_rerun([self.path], None)

    def __repr__(self) -> str:
        return f"<dataset {self.path}: {', '.join(self)}>"

    def _repr_html_(self) -> str:
        rows = [
            (name, len(split), "{1} x {0}".format(*split._split.image_shape))
            for name, split in self.items()
        ]
        return notebook_display.html_table(
            f"dataset {self.path}", ("split", "images", "size, px"), rows
        )


def dataset(path: str | os.PathLike[str]) -> Data:
    """Open a dataset.

    Parameters
    ----------
    path
        A folder that ``dmrl dataset`` wrote.

    Raises
    ------
    DatasetError
        If it is not one.

    Examples
    --------
    >>> import dmrl
    >>> for batch in dmrl.dataset("set")["train"].loader(shuffle=True):  # doctest: +SKIP
    ...     train(batch["image"], batch["confidence"], batch["depth"])
    """
    return Data(open_dataset(to_path(path)))


def _import_torch_dataset() -> Any:
    with optional_imports("train", "a loader"):
        return import_module("dmrl.learn.data.torch_dataset")
