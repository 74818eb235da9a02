"""A dataset as it is before recordings are added to it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.datasets import layout
from dmrl.datasets.manifest import PARTS, Manifest, part_folder, read_manifest
from dmrl.datasets.shards import schema_of
from dmrl.datasets.writing.near_duplicates import read_seen
from dmrl.errors import DatasetError
from dmrl.geometry.frames import STRIDE_PX
from dmrl.recording import Input, Provenance
from dmrl.recording.provenance_inputs import provenance_of


@dataclass(frozen=True, slots=True)
class Before:
    """What is there.

    Parameters
    ----------
    folder
        Of the dataset; None: there is none yet.
    manifest
        Its own.
    made
        How it was made: the settings of the first time, the inputs of all times.
    size_px
        Width and height of its images; None: there are none yet.
    """

    folder: Path | None = None
    manifest: Manifest = field(default_factory=Manifest)
    made: Provenance | None = None
    size_px: tuple[int, int] | None = None

    @property
    def inputs(self) -> Sequence[Input]:
        """What it was made from."""
        return self.made.inputs if self.made is not None else ()

    def seen(self) -> list[NDArray[np.void]]:
        """What is known of its images, by part.

        Raises
        ------
        DatasetError
            If a part is missing or damaged.
        """
        if self.folder is None:
            return []
        found = [read_seen(part_folder(self.folder, k)) for k in range(self.manifest.parts)]
        if sum(map(len, found)) != sum(map(self.manifest.rows, self.manifest.splits)):
            raise DatasetError(
                f"{self.folder / PARTS} knows of {sum(map(len, found))} images, the shards hold "
                "others. Make the dataset again"
            )
        return found


def opened(folder: Path) -> Before:
    """A dataset that can grow.

    Raises
    ------
    DatasetError
        If it is none, is damaged, or was not made by a dmrl that keeps a manifest.
    """
    manifest = read_manifest(folder)
    if manifest is None or not manifest.parts or not any(manifest.splits.values()):
        raise DatasetError(
            f"{folder} is no dataset that can grow: it has no {layout.MANIFEST}. Make it again "
            "with dmrl dataset, without --add"
        )
    split, shards = next(one for one in manifest.splits.items() if one[1])
    grid = schema_of(manifest.place(folder, split, shards[0])).field(layout.CONFIDENCE).type
    size_px = grid.value_type.list_size * STRIDE_PX, grid.list_size * STRIDE_PX
    return Before(folder, manifest, made_of(folder, manifest), size_px)


def made_of(folder: Path, manifest: Manifest) -> Provenance:
    """How all of a dataset was made: as the first time, from the inputs of all times.

    Raises
    ------
    DatasetError
        If a part does not say.
    """
    parts = []
    for k in range(manifest.parts):  # a damaged manifest can name any number: stop at the first gap
        part = provenance_of(part_folder(folder, k))
        if part is None:
            lost = part_folder(folder, k)
            raise DatasetError(f"{lost} has no provenance.json. Make the dataset again")
        parts.append(part)
    return joined(parts)


def joined(parts: Iterable[Provenance]) -> Provenance:
    """The first, with the inputs of all, each once."""
    first, *more = parts
    inputs: dict[str, Input] = {}
    for part in (first, *more):
        for one in part.inputs:
            inputs.setdefault(one.sha256, one)
    return replace(first, inputs=tuple(inputs.values()))
