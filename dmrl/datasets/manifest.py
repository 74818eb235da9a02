"""The manifest of a dataset: its shards, in the order of its rows, and how often it was added to.

A file that it does not name is not there. So a dataset grows by new shards, then the manifest in
place of the one before, and nothing else of what is there is written again. For each time there
is a folder as well, ``parts/00001``: how its rows were made, and what is known of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dmrl.datasets import layout
from dmrl.errors import DatasetError
from dmrl.guards.bounded_parsing import parse_json
from dmrl.guards.safe_names import file_name, inside, split_name

PARTS = "parts"


@dataclass(frozen=True, slots=True)
class Shard:
    """One file of a split: its name, and how many rows and bytes it has."""

    file: str
    rows: int
    bytes: int


@dataclass(frozen=True, slots=True)
class Manifest:
    """What a dataset consists of.

    Parameters
    ----------
    splits
        Shards by split, train first.
    parts
        How often it was written to: once when it was made, and once each time it grew.
    parquet
        Shards are Parquet files in ``data``, else Arrow streams in a folder of their split.
    """

    splits: Mapping[str, Sequence[Shard]] = field(default_factory=dict)
    parts: int = 0
    parquet: bool = False

    def with_part(self, added: Mapping[str, Sequence[Shard]]) -> "Manifest":
        """The same, grown by some shards."""
        names = sorted({*self.splits, *added}, key=lambda name: (name != "train", name))
        grown = {name: [*self.splits.get(name, ()), *added.get(name, ())] for name in names}
        return Manifest(grown, self.parts + 1, self.parquet)

    def rows(self, split: str) -> int:
        """How many rows a split has."""
        return sum(shard.rows for shard in self.splits.get(split, ()))

    def place(self, folder: Path, split: str, shard: Shard) -> Path:
        """Where a shard lies in the dataset's folder."""
        own = "data" if self.parquet else split
        return inside(inside(folder, own, f"{folder}: a split"), shard.file, f"{folder}: a shard")

    def write(self, folder: Path) -> None:
        """Write it into the folder of a dataset."""
        splits = [
            {"split": name, "shards": [_plain(shard) for shard in shards]}
            for name, shards in self.splits.items()
        ]
        document = {"parquet": self.parquet, "parts": self.parts, "splits": splits}
        (folder / layout.MANIFEST).write_text(layout.json_text(document), encoding="utf-8")


def part_folder(folder: Path, number: int) -> Path:
    """What is kept of the time that a dataset was made (0) or added to."""
    return folder / PARTS / f"{number:05d}"


def read_manifest(folder: Path) -> Manifest | None:
    """The manifest of a dataset; None, if it has none: others than dmrl write none.

    Raises
    ------
    DatasetError
        If it is damaged.
    UnsafeName
        If a split or a shard is called what could not be a file's name.
    """
    path = folder / layout.MANIFEST
    if not path.is_file():
        return None
    try:
        said = parse_json(path.read_text(encoding="utf-8"))
        splits = {
            split_name(one["split"], f"{path}: a split"): [
                _shard(shard, path) for shard in one["shards"]
            ]
            for one in said["splits"]
        }
        if len(splits) < len(said["splits"]):
            raise ValueError("a split is named twice")
        if any(len({shard.file for shard in own}) < len(own) for own in splits.values()):
            raise ValueError("a shard is named twice")
        return Manifest(splits, _count(said["parts"]), said["parquet"] is True)
    except (OSError, KeyError, TypeError, ValueError, AttributeError) as e:
        raise DatasetError(f"{path} is not what it should be ({e}). Make the dataset again") from e


def _plain(shard: Shard) -> dict[str, Any]:
    return {"file": shard.file, "rows": shard.rows, "bytes": shard.bytes}


def _shard(said: Mapping[str, Any], path: Path) -> Shard:
    name = file_name(said["file"], f"{path}: a shard")
    return Shard(name, _count(said["rows"]), _count(said["bytes"]))


def _count(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**60:
        raise ValueError(f"{value!r} is no count")
    return value
