"""The same picture in train and in test: what a test on it measures is memory."""

import hashlib
from collections.abc import Iterable, Iterator

from dmrl.datasets.write import Row


class Twins:
    """Counts images of other splits whose pixels stand in train too, while rows go by."""

    def __init__(self) -> None:
        self._train: set[bytes] = set()
        self._others: list[bytes] = []

    @property
    def count(self) -> int:
        """Images outside train that are in train as well."""
        return sum(digest in self._train for digest in self._others)

    def seen(self, rows: Iterable[tuple[str, Row]]) -> Iterator[tuple[str, Row]]:
        """The same rows, counted as they go by."""
        for split, row in rows:
            digest = hashlib.blake2b(row.rgb.tobytes(), digest_size=16).digest()
            if split == "train":
                self._train.add(digest)
            else:
                self._others.append(digest)
            yield split, row
