"""Open a dataset to which recordings are added."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.datasets import layout
from dmrl.datasets.manifest import PARTS_FOLDER, Manifest, load_manifest, part_folder
from dmrl.datasets.shards import load_schema
from dmrl.datasets.writing.near_duplicates import load_hashes
from dmrl.errors import DatasetError
from dmrl.geometry.frames import STRIDE_PX
from dmrl.recording import Input, Provenance
from dmrl.recording.provenance_inputs import read_provenance


@dataclass(frozen=True, slots=True)
class ExistingDataset:
    """A dataset before recordings are added to it.

    Parameters
    ----------
    folder
        Its folder. None: the dataset is new.
    manifest
        Its manifest.
    made
        Its provenance: the settings of its creation, and the inputs of all parts.
    size_px
        Width and height of its images. None: it has no images yet.
    """

    folder: Path | None = None
    manifest: Manifest = field(default_factory=Manifest)
    made: Provenance | None = None
    size_px: tuple[int, int] | None = None

    @property
    def inputs(self) -> Sequence[Input]:
        """Files that the dataset was made from."""
        return self.made.inputs if self.made is not None else ()

    def load_image_hashes(self) -> list[NDArray[np.void]]:
        """Read the hashes of its images, one array per part.

        Raises
        ------
        DatasetError
            If a part is missing or damaged.
        """
        if self.folder is None:
            return []
        found = [load_hashes(part_folder(self.folder, k)) for k in range(self.manifest.parts)]
        if sum(map(len, found)) != sum(map(self.manifest.count_rows, self.manifest.splits)):
            raise DatasetError(
                f"{self.folder / PARTS_FOLDER} has hashes of {sum(map(len, found))} images, which "
                "is not "
                "the number in the shards. Make the dataset again"
            )
        return found


def open_existing(folder: Path) -> ExistingDataset:
    """Open a dataset to add recordings to it.

    Raises
    ------
    DatasetError
        If the folder is no dataset, is damaged, or was made by a dmrl that wrote no manifest.
    """
    manifest = load_manifest(folder)
    if manifest is None or not manifest.parts or not any(manifest.splits.values()):
        raise DatasetError(
            f"{folder} cannot be extended: it has no {layout.MANIFEST_FILE}. Make it again "
            "with dmrl dataset, without --add"
        )
    split, shards = next(one for one in manifest.splits.items() if one[1])
    grid = load_schema(manifest.shard_path(folder, split, shards[0])).field(layout.CONFIDENCE).type
    size_px = grid.value_type.list_size * STRIDE_PX, grid.list_size * STRIDE_PX
    return ExistingDataset(folder, manifest, load_combined_provenance(folder, manifest), size_px)


def load_combined_provenance(folder: Path, manifest: Manifest) -> Provenance:
    """Read the provenance of a dataset: settings of its creation, inputs of all parts.

    Raises
    ------
    DatasetError
        If a part has no provenance.
    """
    parts = []
    for k in range(manifest.parts):  # a damaged manifest can name any number: stop at the first gap
        part = read_provenance(part_folder(folder, k))
        if part is None:
            lost = part_folder(folder, k)
            raise DatasetError(f"{lost} has no provenance.json. Make the dataset again")
        parts.append(part)
    return combine_provenance(parts)


def combine_provenance(parts: Iterable[Provenance]) -> Provenance:
    """Return the first provenance with the inputs of all, each once."""
    first, *more = parts
    inputs: dict[str, Input] = {}
    for part in (first, *more):
        for one in part.inputs:
            inputs.setdefault(one.sha256, one)
    return replace(first, inputs=tuple(inputs.values()))
