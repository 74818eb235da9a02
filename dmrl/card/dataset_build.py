"""Build a dataset from recordings, or add to one: shards, manifest, facts and card."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Literal

from dmrl import recipe as recipes
from dmrl.atomic_output import atomic_folder, extend_folder, register_output
from dmrl.card import write_card
from dmrl.card.facts import FACTS_FILE as FACTS
from dmrl.card.facts import merge_facts, read_facts
from dmrl.card.front_matter import check_license
from dmrl.card.recording_facts import RecordingFacts, build_facts, read_recording_facts
from dmrl.datasets.huggingface_metadata import hash_document, write_json_if_changed, write_metadata
from dmrl.datasets.layout import MANIFEST_FILE
from dmrl.datasets.manifest import Manifest, load_manifest, part_folder
from dmrl.datasets.settings import Settings
from dmrl.datasets.writing import builder
from dmrl.datasets.writing.append import ExistingDataset, load_combined_provenance, open_existing
from dmrl.datasets.writing.corrections import find_corrected, load_corrections
from dmrl.datasets.writing.dataset_writer import write_shards
from dmrl.datasets.writing.exclusions import load_flags
from dmrl.datasets.writing.inputs import warn_about_lenses
from dmrl.datasets.writing.near_duplicates import ImageHashes
from dmrl.datasets.writing.rows import ExclusionCounts, RowFilter
from dmrl.datasets.writing.splits import assign_splits
from dmrl.errors import SettingError
from dmrl.recording import LoadedRecording, Provenance, build_provenance
from dmrl.recording.provenance import FILE_NAME as PROVENANCE
from dmrl.recording.provenance_inputs import build_input
from dmrl.storage import RemotePath
from dmrl.terminal.progress import say

MAX_HELD_IMAGES = 5_000
"""Images whose labels stay in memory between their two reads. The labels of further ones are read
twice, so that memory does not grow with the number of recordings."""


@dataclass(frozen=True, slots=True)
class Written:
    """Images per split, label source per recording, and the images left out."""

    images: dict[str, int]
    sources: dict[str, str]
    tally: ExclusionCounts


def build_dataset(
    recordings: Sequence[Path], out: Path, settings: Settings, workers: int
) -> Written:
    """Write a dataset to ``out``; see ``dmrl.stages.dataset.run``."""
    check_license(settings.license)
    if settings.png and settings.pixels == "jpeg":
        raise SettingError("--png and --pixels jpeg contradict each other. Leave out one")
    before = ExistingDataset(manifest=Manifest(parquet=settings.parquet))
    with atomic_folder(out) as partial:
        written = _write_part(partial, recordings, settings, before, workers)
        _describe(partial)
    return written


def extend_dataset(
    recordings: Sequence[Path], out: Path, settings: Settings, given: Collection[str], workers: int
) -> Written:
    """Add recordings to the dataset ``out``; see ``dmrl.stages.dataset.add``.

    Parameters
    ----------
    recordings, out, settings, workers
        As there.
    given
        Names of the settings that are not the default ones.
    """
    settings = _settings_of(out, open_existing(out), settings, given)
    written = Written({}, {}, ExclusionCounts())
    with extend_folder(out, MANIFEST_FILE) as partial:
        before = open_existing(out)  # again: another may have added to it meanwhile
        known = {one.sha256 for one in before.inputs}
        fresh = [path for path in recordings if build_input(path).sha256 not in known]
        if present := len(recordings) - len(fresh):
            say(f"{present} of {len(recordings)} recordings are in {out} already")
        if fresh:
            written = _write_part(partial, fresh, settings, before, workers)
    register_output(out)
    _describe(out)
    return written


def _settings_of(
    out: Path, before: ExistingDataset, settings: Settings, given: Collection[str]
) -> Settings:
    """Return the settings of a dataset, which those given must not contradict."""
    made = before.made
    assert made is not None
    names = {f.name for f in fields(Settings)} - {"without", "corrections"}
    for name in sorted(names & set(given)):
        if getattr(settings, name) != made.settings.get(name):
            flag = f"--{name.replace('_', '-')}"
            raise SettingError(
                f"{out} was made with {flag} {made.settings.get(name)}. Leave out {flag}, or make "
                "another dataset"
            )
    own = {name: value for name, value in made.settings.items() if name in names}
    made_with = recipes.check(f"{out}/provenance.json", own, Settings)
    return replace(made_with, without=settings.without, corrections=settings.corrections)


def _write_part(
    folder: Path,
    recordings: Sequence[Path],
    settings: Settings,
    before: ExistingDataset,
    workers: int,
) -> Written:
    """Write the shards of recordings, the manifest with them, and their facts."""
    if settings.masks and not any(builder.has_masks(path) for path in recordings):
        raise SettingError(f"{recordings[0]} has no masks; renders have. Leave out --masks")
    made = _provenance(recordings, settings)
    known, held = _read_labels(recordings, settings)
    _warn_about_labels(known, settings)
    tally, seen = ExclusionCounts(), ImageHashes(before.load_image_hashes())
    splits = {path: one.splits for path, one in known.items()}
    found = builder.iter_rows(
        held,
        {path: one.source for path, one in known.items()},
        assign_splits(splits, made, settings, before.inputs if before.made else None),
        tally,
        _select_images(settings),
        total=sum(one.images for one in known.values()),
        size_px=before.size_px,
        workers=workers,
    )
    shards = write_shards(
        folder,
        seen.filter_new(found, tally.count_duplicate if before.made else None),
        packed=_choose_storage(settings) != "raw",
        shard_images=settings.shard_images,
        before=before.manifest,
    )
    manifest = before.manifest.with_part(shards, _list_focal_lengths(known))
    builder.report_left_out(recordings, manifest, tally, settings)
    builder.warn_about_unused_flags(settings, tally)
    _write_documents(part_folder(folder, before.manifest.parts), made, known, tally, seen)
    manifest.write(folder)  # last: from here on the part belongs to the dataset
    images = {
        name: sum(one.rows for one in shards[name]) for name in manifest.splits if name in shards
    }
    return Written(images, {path.name: one.source for path, one in known.items()}, tally)


def _list_focal_lengths(known: Mapping[Path, RecordingFacts]) -> list[float]:
    """Return the focal lengths of all cameras, those of recordings with many images first."""
    ordered = sorted(known.values(), key=lambda one: -one.images)
    return [px for one in ordered for px in one.focal_px]


def _warn_about_labels(known: Mapping[Path, RecordingFacts], settings: Settings) -> None:
    if settings.labels in ("auto", "best"):
        sources = {path: one.source for path, one in known.items()}
        builder.warn_about_other_sources(sources, {path: one.others for path, one in known.items()})
    warn_about_lenses([px for one in known.values() for px in one.focal_px])


def _write_documents(
    place: Path,
    made: Provenance,
    known: Mapping[Path, RecordingFacts],
    tally: ExclusionCounts,
    seen: ImageHashes,
) -> None:
    """Write the provenance, the facts and the hashes of a part."""
    place.mkdir(parents=True)
    made.write(place)
    build_facts(known, tally, seen).write(place)
    seen.write(place)


def _select_images(settings: Settings) -> RowFilter:
    flagged = frozenset() if settings.without is None else load_flags(settings.without)
    corrected = load_corrections(settings.corrections)
    return RowFilter(
        settings.keep_all, settings.masks, flagged, corrected, _choose_storage(settings)
    )


def _choose_storage(settings: Settings) -> Literal["raw", "png", "jpeg"]:
    """Return how images are stored; Parquet files hold packed ones."""
    packed = settings.png or settings.parquet
    return "png" if packed and settings.pixels == "raw" else settings.pixels


def _describe(folder: Path) -> None:
    """Write the files that follow from manifest and parts: names, provenance, facts, card."""
    manifest = load_manifest(folder)
    assert manifest is not None
    # A kilobyte for each recording: once.
    made = load_combined_provenance(folder, manifest).to_json()
    settings = made["settings"]
    about = {"description": str(settings["title"]), "license": str(settings["license"])}
    write_metadata(folder, manifest, fingerprint=hash_document(made), about=about)
    write_json_if_changed(folder / PROVENANCE, made)
    del made
    parts = [read_facts(part_folder(folder, k)) for k in range(manifest.parts)]
    write_json_if_changed(
        folder / FACTS, asdict(merge_facts([part for part in parts if part is not None]))
    )
    if isinstance(folder, RemotePath):
        say(f"{folder}: the card is as it was; a bucket's would be read as a whole for it")
    else:
        write_card(folder)


def _provenance(recordings: Sequence[Path], settings: Settings) -> Provenance:
    flags = [] if settings.without is None else [settings.without]
    inputs, libraries = [*recordings, *flags, *settings.corrections], ("pyarrow", "pillow")
    return build_provenance("dataset", settings, inputs, seed=settings.seed, libraries=libraries)


def _read_labels(
    recordings: Sequence[Path], settings: Settings
) -> tuple[dict[Path, RecordingFacts], dict[Path, LoadedRecording]]:
    """Return the facts of recordings, and the labels of the first, which are not read again."""
    known: dict[Path, RecordingFacts] = {}
    held: dict[Path, LoadedRecording] = {}
    images = 0
    corrected = find_corrected(recordings, settings.corrections)
    for path in recordings:
        known[path], labels = read_recording_facts(
            path,
            settings.labels,
            with_splits=settings.split == "auto",
            corrected=path.name in corrected,
        )
        images += known[path].images
        if images <= MAX_HELD_IMAGES:
            held[path] = labels
    return known, held
