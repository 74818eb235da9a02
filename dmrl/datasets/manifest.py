"""The manifest of a dataset: its shards in the order of the rows, and the number of its parts.

Readers ignore files that the manifest does not list. A dataset therefore grows by new shards and
then by a new manifest; no other existing file is written again. Every addition also gets a folder
such as ``parts/00001`` with its provenance and the hashes of its images.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from dmrl.datasets import layout
from dmrl.errors import DatasetError
from dmrl.guards.bounded_parsing import parse_json
from dmrl.guards.safe_names import check_file_name, check_split_name, safe_join

PARTS_FOLDER = "parts"

MAX_FOCAL_RATIO = 1.05
"""Focal lengths within this ratio count as one: depths are as far off."""


@dataclass(frozen=True, slots=True)
class Shard:
    """One file of a split: its name, number of rows and size in bytes."""

    file: str
    rows: int
    bytes: int


@dataclass(frozen=True, slots=True)
class Manifest:
    """The contents of a dataset.

    Parameters
    ----------
    splits
        Shards by split, train first.
    parts
        Number of times that rows were written: one for the creation, one for each addition.
    parquet
        Shards are Parquet files in ``data``, else Arrow streams in a folder of their split.
    focal_px
        Focal lengths of the calibrated cameras, pixels, without those within `MAX_FOCAL_RATIO` of
        an earlier one.
    """

    splits: Mapping[str, Sequence[Shard]] = field(default_factory=dict)
    parts: int = 0
    parquet: bool = False
    focal_px: Sequence[float] = ()

    def with_part(
        self, added: Mapping[str, Sequence[Shard]], focal_px: Iterable[float] = ()
    ) -> "Manifest":
        """Return a manifest with some shards and their cameras added, and one part more."""
        names = sorted({*self.splits, *added}, key=lambda name: (name != "train", name))
        grown = {name: [*self.splits.get(name, ()), *added.get(name, ())] for name in names}
        distinct = list(self.focal_px)
        for own_px in focal_px:
            if not any(have_similar_focal_lengths(own_px, px) for px in distinct):
                distinct.append(own_px)
        return Manifest(grown, self.parts + 1, self.parquet, distinct)

    def count_rows(self, split: str) -> int:
        """Count the rows of a split."""
        return sum(shard.rows for shard in self.splits.get(split, ()))

    def shard_path(self, folder: Path, split: str, shard: Shard) -> Path:
        """Return the path of a shard in the dataset's folder."""
        own = "data" if self.parquet else split
        place = safe_join(folder, own, f"{folder}: a split")
        return safe_join(place, shard.file, f"{folder}: a shard")

    def write(self, folder: Path) -> None:
        """Write the manifest into the folder of a dataset."""
        splits = [
            {"split": name, "shards": [asdict(shard) for shard in shards]}
            for name, shards in self.splits.items()
        ]
        document = {
            "parquet": self.parquet,
            "parts": self.parts,
            "splits": splits,
            "focal_px": list(self.focal_px),
        }
        (folder / layout.MANIFEST_FILE).write_text(layout.format_json(document), encoding="utf-8")


def have_similar_focal_lengths(first_px: float, second_px: float) -> bool:
    """Return whether a network's depths hold for both focal lengths; see `MAX_FOCAL_RATIO`."""
    return max(first_px, second_px) <= MAX_FOCAL_RATIO * min(first_px, second_px)


def part_folder(folder: Path, number: int) -> Path:
    """Return the folder of a part: 0 for the creation, then one for each addition."""
    return folder / PARTS_FOLDER / f"{number:05d}"


def load_manifest(folder: Path) -> Manifest | None:
    """Read the manifest of a dataset; None if there is none, as in datasets of other programs.

    Raises
    ------
    DatasetError
        If the manifest is damaged.
    UnsafeName
        If the name of a split or a shard is not a valid file name.
    """
    path = folder / layout.MANIFEST_FILE
    if not path.is_file():
        return None
    try:
        said = parse_json(path.read_text(encoding="utf-8"))
        splits = {
            check_split_name(one["split"], f"{path}: a split"): [
                _parse_shard(shard, path) for shard in one["shards"]
            ]
            for one in said["splits"]
        }
        if len(splits) < len(said["splits"]):
            raise ValueError("a split is named twice")
        if any(len({shard.file for shard in own}) < len(own) for own in splits.values()):
            raise ValueError("a shard is named twice")
        focal_px = [_parse_length(value) for value in said.get("focal_px", [])]
        return Manifest(splits, _parse_count(said["parts"]), said["parquet"] is True, focal_px)
    except (OSError, KeyError, TypeError, ValueError, AttributeError) as e:
        raise DatasetError(f"{path} is damaged ({e}). Make the dataset again") from e


def _parse_shard(said: Mapping[str, Any], path: Path) -> Shard:
    name = check_file_name(said["file"], f"{path}: a shard")
    return Shard(name, _parse_count(said["rows"]), _parse_count(said["bytes"]))


def _parse_length(value: Any) -> float:
    if type(value) not in (int, float) or not 0 < value < math.inf:
        raise ValueError(f"{value!r} is not a focal length")
    return float(value)


def _parse_count(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**60:
        raise ValueError(f"{value!r} is not a count")
    return value
