"""Find duplicates among the images of a dataset by hashes, 25 bytes for each image.

The hashes are stored beside the shards, so that an addition to the dataset reads no pixels again.
An image in both train and test is a leak: the test then measures memory.
"""

import hashlib
import os
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.datasets.writing.dataset_writer import Row
from dmrl.errors import DatasetError

HASHES_FILE = "seen.bin"
"""File of the hashes in the folder of a part."""
NEAR_DUPLICATE_BITS = 6
"""Largest difference of two 64-bit perceptual hashes that count as near duplicates.

People cannot tell such images apart.
"""
COMPARED_AT_ONCE = 64
"""Test images that are compared with all of train at a time."""
MAX_COMPARED_PAIRS = 500_000_000
"""Pairs of a test and a train image that are compared, at most: one second. Beyond it, test images
are sampled.
"""
MAX_UNSORTED_KEYS = 65_536
"""Keys that are collected in a set before they are merged into a sorted array.

The array needs a twelfth of the memory.
"""
HASHES_DTYPE = np.dtype([("key", "<u8"), ("pixels", "<u8"), ("look", "<u8"), ("train", "?")])
"""Hash of an image's robot, time and pixels; hash of its pixels; perceptual hash; is it in
train."""

Hashes = NDArray[np.uint64]


def compute_perceptual_hash(rgb: NDArray[np.uint8]) -> int:
    """Return the 64-bit difference hash of an image, which changes little when the image does.

    The green channel is reduced to 8 x 9 means. Each bit is 1 if brightness rises from a mean to
    the next in its row.

    Parameters
    ----------
    rgb
        (H, W, 3), at least 8 x 9 pixels.
    """
    green = rgb[::2, ::2, 1] if min(rgb.shape[:2]) >= 36 else rgb[..., 1]  # enough, and cheap
    height, width = green.shape
    rows, cols = (
        np.linspace(0, side, n + 1)[:-1].astype(int) for side, n in ((height, 8), (width, 9))
    )
    sums = np.add.reduceat(np.add.reduceat(green, cols, axis=1, dtype=np.int64), rows, axis=0)
    means = sums / np.outer(np.diff([*rows, height]), np.diff([*cols, width]))
    bits = np.packbits((means[:, 1:] > means[:, :-1]).ravel())
    return int.from_bytes(bits.tobytes(), "big")


class ImageHashes:
    """Hashes of the images of a dataset, those stored before and those added now.

    Parameters
    ----------
    before
        Hashes of the existing images, from `load_hashes`.
    """

    def __init__(self, before: Sequence[NDArray[np.void]] = ()) -> None:
        self._before = before
        self._own = tuple(array("Q") for _ in range(3))
        self._train = bytearray()
        self._sorted: Hashes = np.sort(self._concatenate_column("key"))
        self._fresh: set[int] = set()

    def filter_new(
        self, rows: Iterable[tuple[str, Row]], refuse: Callable[[], None] | None
    ) -> Iterator[tuple[str, Row]]:
        """Yield the rows whose image is new, by robot, time and pixels, and store their hashes.

        Parameters
        ----------
        rows
            Each with its split.
        refuse
            Called for every duplicate, which is skipped. None: duplicates are yielded as well.
        """
        for split, row in rows:
            pixels = _hash_bytes(np.ascontiguousarray(row.rgb).data)
            key = _hash_bytes(f"{pixels} {row.time_ns} {row.robot}".encode())
            if refuse is not None and self._contains_key(key):
                refuse()
                continue
            self._add_key(key)
            for column, value in zip(
                self._own, (key, pixels, compute_perceptual_hash(row.rgb)), strict=True
            ):
                column.append(value)
            self._train.append(split == "train")
            yield split, row

    def _contains_key(self, key: int) -> bool:
        at = int(np.searchsorted(self._sorted, np.uint64(key)))
        return key in self._fresh or (at < len(self._sorted) and int(self._sorted[at]) == key)

    def _add_key(self, key: int) -> None:
        self._fresh.add(key)
        if len(self._fresh) >= MAX_UNSORTED_KEYS:
            fresh = np.fromiter(self._fresh, np.uint64, len(self._fresh))
            self._sorted = np.sort(np.concatenate([self._sorted, fresh]))
            self._fresh.clear()

    def _concatenate_column(self, column: str, *, train: bool | None = None) -> Hashes:
        """Return a column of all images, existing ones first; ``train`` selects the splits."""
        every = (*self._before, self._collect_added())
        return np.concatenate(
            [one[column] if train is None else one[column][one["train"] == train] for one in every]
        )

    def _collect_added(self) -> NDArray[np.void]:
        found = np.empty(len(self._train), HASHES_DTYPE)
        for name, column in zip(HASHES_DTYPE.names or (), (*self._own, self._train), strict=True):
            found[name] = column
        return found

    def count_exact_duplicates(self) -> int:
        """Count the images outside train whose pixels are in train as well."""
        others = self._concatenate_column("pixels", train=False)
        return int(np.isin(others, self._concatenate_column("pixels", train=True)).sum())

    def count_near_duplicates(self) -> tuple[int, int, int]:
        """Count the near duplicates of train images among the images outside train.

        Returns
        -------
        tuple[int, int, int]
            Near duplicates, compared images, and all images outside train.
        """
        train = np.unique(self._concatenate_column("look", train=True))
        every = self._concatenate_column("look", train=False)
        others = every[:: max(1, -(-len(every) * len(train) // MAX_COMPARED_PAIRS))]
        if not len(train):
            return 0, len(every), len(every)
        starts = range(0, len(others), COMPARED_AT_ONCE)
        parts = (others[k : k + COMPARED_AT_ONCE, None] ^ train for k in starts)
        alike = (np.bitwise_count(one).min(axis=1) <= NEAR_DUPLICATE_BITS for one in parts)
        return sum(int(one.sum()) for one in alike), len(others), len(every)

    def write(self, folder: Path) -> None:
        """Write the hashes of the added images into a part's folder."""
        (folder / HASHES_FILE).write_bytes(self._collect_added().tobytes())


def load_hashes(folder: Path) -> NDArray[np.void]:
    """Map the hashes that `ImageHashes.write` wrote.

    Raises
    ------
    DatasetError
        If the file is missing or damaged.
    """
    path = folder / HASHES_FILE
    try:
        if not path.stat().st_size:
            return np.empty(0, HASHES_DTYPE)  # an empty file cannot be mapped
        return np.memmap(os.fspath(path), HASHES_DTYPE, "r")
    except (OSError, ValueError) as e:
        why = " ".join(str(e).split())
        raise DatasetError(f"{path} is missing or damaged ({why}). Make the dataset again") from e


def _hash_bytes(data: bytes | memoryview) -> int:
    return int.from_bytes(hashlib.blake2b(data, digest_size=8).digest(), "big")
