"""A few images of a dataset, evenly spread over it."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.datasets.read import open_dataset
from dmrl.errors import DatasetError


def sample_images(folder: Path, most: int) -> list[NDArray[np.uint8]]:
    """Return at most so many images of a dataset.

    Raises
    ------
    DatasetError
        If it has none.
    """
    data = open_dataset(folder)
    chunks = [chunk for name in data.splits for chunk in data.split(name).pixels]
    starts = np.cumsum([0, *map(len, chunks)])
    if not starts[-1]:
        raise DatasetError(f"{folder} holds no images. Give another dataset")
    rows = np.unique(np.linspace(0, starts[-1] - 1, min(most, int(starts[-1]))).astype(int))
    where = np.searchsorted(starts, rows, side="right") - 1
    return [np.asarray(chunks[k][row - starts[k]]) for k, row in zip(where, rows, strict=True)]
