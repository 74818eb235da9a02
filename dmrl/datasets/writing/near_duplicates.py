"""What is known of the images of a dataset, 25 bytes each: enough to find one again.

Kept beside the shards, so that nobody has to read pixels again when the dataset grows. The same
picture in train and in test is a leak: what a test on it measures is memory.
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

FILE = "seen.bin"
NEAR_BITS = 6
"""Of the 64 of a perceptual hash: pictures that differ in no more look the same to people."""
AT_ONCE = 64
MOST_PAIRS = 500_000_000
"""Pictures of tests times those of train that are compared: a second. Of more, a part is."""
FRESH = 65_536
"""Keys that wait in a set, before they are sorted into an array: a twelfth of the memory."""
DTYPE = np.dtype([("key", "<u8"), ("pixels", "<u8"), ("look", "<u8"), ("train", "?")])
"""Hash of an image's robot, time and pixels; of its pixels; its perceptual hash; its split."""

Hashes = NDArray[np.uint64]


def perceptual_hash(rgb: NDArray[np.uint8]) -> int:
    """64 bits that change little where a picture does: whether brightness rises along rows.

    The difference hash: the green picture shrunk to 8 x 9 means, each compared with the next.

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


class Seen:
    """Images that were there before, and those that go by.

    Parameters
    ----------
    before
        The images that were there, as `read_seen` gives them.
    """

    def __init__(self, before: Sequence[NDArray[np.void]] = ()) -> None:
        self._before = before
        self._own = tuple(array("Q") for _ in range(3))
        self._train = bytearray()
        self._sorted: Hashes = np.sort(self._known("key"))
        self._fresh: set[int] = set()

    def new(
        self, rows: Iterable[tuple[str, Row]], refuse: Callable[[], None] | None
    ) -> Iterator[tuple[str, Row]]:
        """Those rows whose image is not there yet, by robot, time and pixels.

        Parameters
        ----------
        rows
            Each with its split.
        refuse
            Called for each of the others. None: these are yielded as well.
        """
        for split, row in rows:
            pixels = _hash(np.ascontiguousarray(row.rgb).data)
            key = _hash(f"{pixels} {row.time_ns} {row.robot}".encode())
            if refuse is not None and self._has(key):
                refuse()
                continue
            self._add(key)
            for column, value in zip(
                self._own, (key, pixels, perceptual_hash(row.rgb)), strict=True
            ):
                column.append(value)
            self._train.append(split == "train")
            yield split, row

    def _has(self, key: int) -> bool:
        at = int(np.searchsorted(self._sorted, np.uint64(key)))
        return key in self._fresh or (at < len(self._sorted) and int(self._sorted[at]) == key)

    def _add(self, key: int) -> None:
        self._fresh.add(key)
        if len(self._fresh) >= FRESH:
            fresh = np.fromiter(self._fresh, np.uint64, len(self._fresh))
            self._sorted = np.sort(np.concatenate([self._sorted, fresh]))
            self._fresh.clear()

    def _known(self, column: str, *, train: bool | None = None) -> Hashes:
        """A column, of all images or of one kind of splits, with what was there before first."""
        every = (*self._before, self._mine())
        return np.concatenate(
            [one[column] if train is None else one[column][one["train"] == train] for one in every]
        )

    def _mine(self) -> NDArray[np.void]:
        found = np.empty(len(self._train), DTYPE)
        for name, column in zip(DTYPE.names or (), (*self._own, self._train), strict=True):
            found[name] = column
        return found

    def twins(self) -> int:
        """Images outside train whose pixels stand in train as well."""
        others = self._known("pixels", train=False)
        return int(np.isin(others, self._known("pixels", train=True)).sum())

    def near(self) -> tuple[int, int, int]:
        """Images outside train that look like one in train; of how many compared; of how many."""
        train = np.unique(self._known("look", train=True))
        every = self._known("look", train=False)
        others = every[:: max(1, -(-len(every) * len(train) // MOST_PAIRS))]
        if not len(train):
            return 0, len(every), len(every)
        parts = (others[k : k + AT_ONCE, None] ^ train for k in range(0, len(others), AT_ONCE))
        alike = (np.bitwise_count(one).min(axis=1) <= NEAR_BITS for one in parts)
        return sum(int(one.sum()) for one in alike), len(others), len(every)

    def write(self, folder: Path) -> None:
        """Write what is known of the images that went by."""
        (folder / FILE).write_bytes(self._mine().tobytes())


def read_seen(folder: Path) -> NDArray[np.void]:
    """What `Seen.write` wrote, mapped.

    Raises
    ------
    DatasetError
        If it is missing or damaged.
    """
    path = folder / FILE
    try:
        if not path.stat().st_size:
            return np.empty(0, DTYPE)  # which cannot be mapped
        return np.memmap(os.fspath(path), DTYPE, "r")
    except (OSError, ValueError) as e:
        why = " ".join(str(e).split())
        raise DatasetError(f"{path} is missing or damaged ({why}). Make the dataset again") from e


def _hash(data: bytes | memoryview) -> int:
    return int.from_bytes(hashlib.blake2b(data, digest_size=8).digest(), "big")
