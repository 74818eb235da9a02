"""The same picture in train and in test: what a test on it measures is memory."""

import hashlib
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from dmrl.datasets.write import Row

NEAR_BITS = 6
"""Of the 64 of a perceptual hash: pictures that differ in no more look the same to people."""
AT_ONCE = 64


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


class Twins:
    """Counts images of other splits whose pixels stand in train too, while rows go by."""

    def __init__(self) -> None:
        self._train: set[bytes] = set()
        self._others: list[bytes] = []
        self._hashes: tuple[list[int], list[int]] = ([], [])  # of train, of the others

    @property
    def count(self) -> int:
        """Images outside train that are in train as well."""
        return sum(digest in self._train for digest in self._others)

    @property
    def near(self) -> int:
        """Images outside train that look like one in train, those that are the same too."""
        train, others = (np.array(one, np.uint64) for one in self._hashes)
        if not len(train):
            return 0
        parts = (others[k : k + AT_ONCE, None] ^ train for k in range(0, len(others), AT_ONCE))
        return sum(int((np.bitwise_count(one).min(axis=1) <= NEAR_BITS).sum()) for one in parts)

    def seen(self, rows: Iterable[tuple[str, Row]]) -> Iterator[tuple[str, Row]]:
        """The same rows, counted as they go by."""
        for split, row in rows:
            digest = hashlib.blake2b(row.rgb.tobytes(), digest_size=16).digest()
            if split == "train":
                self._train.add(digest)
            else:
                self._others.append(digest)
            self._hashes[split != "train"].append(perceptual_hash(row.rgb))
            yield split, row
