"""Collect the outputs in a folder: recordings, datasets, models, evaluations, images."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa

from dmrl import recipe as recipes
from dmrl.catalogue import FILE_NAME as CATALOGUE
from dmrl.catalogue import open_catalogue
from dmrl.datasets import is_dataset
from dmrl.errors import DmrlError, SettingError
from dmrl.evaluation import figure_specs as story
from dmrl.evaluation.figure_specs import FigureSpec
from dmrl.guards.bounded_parsing import parse_json
from dmrl.guards.paths import refuse_pipes
from dmrl.recording import Provenance, Summary, read_summary
from dmrl.recording.provenance_inputs import read_provenance

DOCUMENT_KINDS = {
    "evaluation.json": "evaluations",
    "positions.json": "positions",
    "tracks.json": "tracks",
    "flight.json": "flights",
    "quantisation.json": "int8",
    "model.json": "models",
}
"""Files that identify an output folder, and its kind in a report."""
MAX_FILES, MAX_DOCUMENT_BYTES, MAX_FOLDER_DEPTH = 20_000, 16 << 20, 6
"""Limits of a search: files of a folder, bytes of a document, levels of folders."""
MAX_OPENED_RECORDINGS = 100
"""Largest number of recordings in a catalogue that are opened one by one."""
RECIPE_FILE = "recipe.toml"
"""The recipe that `dmrl.pipeline` leaves beside its outputs."""
SKIPPED_FOLDERS = ("unfinished", "previous")
"""Folders of `dmrl.pipeline` with outputs that are incomplete or replaced."""
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")


@dataclass(frozen=True, slots=True)
class ReportInputs:
    """Contents of a folder, by path relative to it.

    Parameters
    ----------
    folder
        The folder.
    recordings
        Complete recordings and their summaries.
    datasets
        Their folders.
    documents
        By kind of `DOCUMENT_KINDS`: the document of each output.
    pictures
        Images in the folder itself, outside outputs.
    catalogues
        Their tables, from `dmrl.catalogue`.
    made
        Provenance of the outputs that have one.
    unread
        Files that cannot be read, with the reason.
    story
        Figures that the folder's recipe puts first.
    title
        Heading of these figures.
    order
        Numbers of the recipe's outputs: documents are shown in this order, others after them.
    """

    folder: Path
    recordings: dict[str, Summary] = field(default_factory=dict)
    datasets: dict[str, Path] = field(default_factory=dict)
    documents: dict[str, dict[str, Mapping[str, Any]]] = field(default_factory=dict)
    pictures: list[Path] = field(default_factory=list)
    catalogues: dict[str, pa.Table] = field(default_factory=dict)
    made: dict[str, Provenance] = field(default_factory=dict)
    unread: dict[str, str] = field(default_factory=dict)
    story: list[FigureSpec] = field(default_factory=list)
    title: str = "The recipe's figures"
    order: Mapping[str, int] = field(default_factory=dict)

    def documents_of_kind(self, kind: str) -> dict[str, Mapping[str, Any]]:
        """Return the documents of one kind, in the order of the recipe, then by name."""
        held = self.documents.get(kind, {})
        names = sorted(sorted(held), key=lambda name: self.order.get(name, len(self.order)))
        return {name: held[name] for name in names}


def collect_outputs(folder: Path) -> ReportInputs:
    """Collect the contents of a folder for its report; links are not followed.

    Raises
    ------
    SettingError
        If it is not a folder, or contains no output.
    """
    if not folder.is_dir():
        raise SettingError(
            f"{folder} is not a folder. Name one with recordings, models, evaluations"
        )
    refuse_pipes(folder)
    found = _read_recipe(folder)
    files = list(_iter_files(folder))
    together: set[Path] = set()
    for path in sorted(files, key=lambda path: path.name != CATALOGUE):
        try:
            if path.name == CATALOGUE:
                together |= _collect_catalogue(found, path)
            elif path not in together:
                _collect_file(found, path)
        except (DmrlError, ValueError, OSError) as e:
            found.unread[_relative_name(found, path)] = str(e)
    if not (found.recordings or found.datasets or found.documents or found.catalogues):
        raise SettingError(
            f"{folder} contains no recording, dataset, model or evaluation. Try: dmrl demo"
        )
    return found


def _read_recipe(folder: Path) -> ReportInputs:
    """Read the figures that the folder's recipe defines, and the order of its outputs."""
    recipe = folder / RECIPE_FILE
    if not recipe.is_file() or recipe.is_symlink():
        return ReportInputs(folder)
    try:
        keys = recipes.read(recipe)
        title = str(keys.get(story.TITLE_KEY, ReportInputs.__dataclass_fields__["title"].default))
        steps = [step for step in keys.get("step", ()) if isinstance(step, dict)]
        order = {str(step.get("out")): k for k, step in enumerate(steps)}
        figures = story.read_figures(recipe, keys)
        return ReportInputs(folder, story=figures, title=title, order=order)
    except DmrlError as e:
        return ReportInputs(folder, unread={RECIPE_FILE: str(e)})


def _iter_files(folder: Path) -> Iterator[Path]:
    """Yield the finished files below a folder, by name."""
    seen = 0
    for place, below, names in os.walk(folder):
        inside = Path(place)
        if len(inside.relative_to(folder).parts) >= MAX_FOLDER_DEPTH:
            below.clear()
        below[:] = sorted(
            n for n in below if not n.endswith(".partial") and n not in SKIPPED_FOLDERS
        )
        for name in sorted(names):
            seen += 1
            path = inside / name
            if seen <= MAX_FILES and not path.is_symlink() and path.is_file():
                yield path


def _collect_file(found: ReportInputs, path: Path) -> None:
    if path.suffix == ".mcap":
        held = read_summary(path)
        name = _relative_name(found, path)
        found.recordings[name] = held
        if held.provenance is not None:
            found.made[name] = held.provenance
    elif path.name in DOCUMENT_KINDS:
        name = _relative_name(found, path.parent)
        found.documents.setdefault(DOCUMENT_KINDS[path.name], {})[name] = read_document(path)
        _store_provenance(found, path.parent)
    elif path.name == "dataset_dict.json" or path.suffix == ".parquet":
        # DATASET/dataset_dict.json, DATASET/data/SPLIT-00000.parquet
        root = path.parent.parent if path.suffix == ".parquet" else path.parent
        if is_dataset(root):
            found.datasets[_relative_name(found, root)] = root
            _store_provenance(found, root)
    elif path.suffix.lower() in IMAGE_SUFFIXES and path.parent == found.folder:
        found.pictures.append(path)


def _collect_catalogue(found: ReportInputs, path: Path) -> set[Path]:
    """Store a catalogue, and return its recordings if they are too many to open."""
    table = open_catalogue(path.parent).table
    found.catalogues[_relative_name(found, path)] = table
    names = table["recording"].to_pylist() if table.num_rows > MAX_OPENED_RECORDINGS else []
    return {path.parent / name for name in names}


def _store_provenance(found: ReportInputs, output: Path) -> None:
    """Store the provenance of an output folder."""
    made = read_provenance(output)
    if made is not None:
        found.made[_relative_name(found, output)] = made


def read_document(path: Path) -> Mapping[str, Any]:
    """Read the JSON document of an output.

    Raises
    ------
    ValueError
        If it is too large, or is not a table.
    """
    if path.stat().st_size > MAX_DOCUMENT_BYTES:
        raise ValueError(f"{path.name} is larger than {MAX_DOCUMENT_BYTES >> 20} MB")
    document = parse_json(path.read_text(encoding="utf-8"))
    if not isinstance(document, dict):
        raise ValueError(f"{path.name} is not a table")
    return document


def _relative_name(found: ReportInputs, path: Path) -> str:
    return path.relative_to(found.folder).as_posix() if path != found.folder else path.name
