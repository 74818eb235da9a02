"""``dmrl dataset``: recordings to an Arrow dataset, with its card."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dmrl import recipe as recipes
from dmrl.atomic_output import grown_folder, note, partial_folder
from dmrl.card import write_card
from dmrl.card.facts import FILE as FACTS
from dmrl.card.facts import merged, read_facts
from dmrl.card.front_matter import check_license
from dmrl.card.recording_facts import About, facts_of, read_about
from dmrl.datasets.huggingface_metadata import fingerprint_of, rewrite, write_names
from dmrl.datasets.layout import MANIFEST
from dmrl.datasets.manifest import Manifest, part_folder, read_manifest
from dmrl.datasets.settings import Settings
from dmrl.datasets.writing.append import Before, made_of, opened
from dmrl.datasets.writing.builder import Wanted, explain, has_masks, rows, unused, warn_of_others
from dmrl.datasets.writing.dataset_writer import write_shards
from dmrl.datasets.writing.exclusions import read_flags
from dmrl.datasets.writing.inputs import warn_of_lenses
from dmrl.datasets.writing.near_duplicates import Seen
from dmrl.datasets.writing.parts import splits_of
from dmrl.datasets.writing.rows import Tally
from dmrl.datasets.writing.splits import SplitOf
from dmrl.errors import SettingError
from dmrl.pipeline.batch import all_recordings, differing
from dmrl.pipeline.process_pool import cores
from dmrl.pipeline.single_run import done_on
from dmrl.recording import Contents, Provenance, provenance
from dmrl.recording.provenance import FILE_NAME as PROVENANCE
from dmrl.recording.provenance_inputs import input_of
from dmrl.storage import Remote
from dmrl.terminal.arguments import AsJson, Flat, On, Workers
from dmrl.terminal.progress import say
from dmrl.terminal.tables import print_json, print_line, print_table

HELD_IMAGES = 5_000
"""Labels of so many images stay in memory between the two looks at them; of more, they are read
twice, so that memory does not grow with the number of recordings."""


@dataclass(frozen=True, slots=True)
class Result:
    """What was written: images per split, label source per recording, images left out."""

    images: dict[str, int]
    sources: dict[str, str]
    tally: Tally


def run(
    recordings: Sequence[Path], out: Path, settings: Settings, *, workers: int | None = None
) -> Result:
    """Images per split of the dataset written to ``out``.

    Parameters
    ----------
    recordings
        With images and labels.
    out
        Folder to write. Must not exist.
    settings
        See `Settings`.
    workers
        Threads that decode images. None: as many as there are cores. Changes no byte.

    Raises
    ------
    RecordingError
        If a recording cannot be read, lacks images or labels, or its images cannot be used.
    SettingError
        If a recording has no labels from the source asked for, two share name or content, or
        nobody knows the license.
    OutputError
        If ``out`` exists.
    """
    check_license(settings.license)
    before = Before(manifest=Manifest(parquet=settings.parquet))
    with partial_folder(out) as partial:
        result = _part(partial, recordings, settings, before, workers or cores())
        _describe(partial)
    return result


def add(
    recordings: Sequence[Path], out: Path, settings: Settings, *, workers: int | None = None
) -> Result:
    """Images that were added to the dataset ``out``, per split.

    Nothing that is there is written again but the manifest, and the files that are made of it: the
    card, the names for ``datasets``, provenance.json, facts.json. If it was stopped, do it again.

    Parameters
    ----------
    recordings
        Those that are in it already, by their content, are left out.
    out
        A dataset.
    settings
        Where they are not the default ones, they must be those that it was made with.
    workers
        See `run`.

    Raises
    ------
    RecordingError, SettingError
        As `run`; or if a setting is another than the dataset's.
    DatasetError
        If ``out`` is no dataset that can grow.
    OutputError
        If another process is writing it, or the system refuses a write.
    """
    settings = _as_before(settings, opened(out), out)
    result = Result({}, {}, Tally())
    with grown_folder(out, MANIFEST) as partial:
        before = opened(out)  # again: another may have added to it meanwhile
        known = {one.sha256 for one in before.inputs}
        fresh = [path for path in recordings if input_of(path).sha256 not in known]
        if there := len(recordings) - len(fresh):
            say(f"{there} of {len(recordings)} recordings are in {out} already")
        if fresh:
            result = _part(partial, fresh, settings, before, workers or cores())
    note(out)
    _describe(out)
    return result


def _as_before(settings: Settings, before: Before, out: Path) -> Settings:
    """Settings of the dataset, which those given must not contradict."""
    made = before.made
    assert made is not None
    names = {f.name for f in fields(Settings)} - {"without"}
    for name in sorted(names & differing(settings).keys()):
        if getattr(settings, name) != made.settings.get(name):
            flag = f"--{name.replace('_', '-')}"
            raise SettingError(
                f"{out} was made with {flag} {made.settings.get(name)}. Leave out {flag}, or make "
                "another dataset"
            )
    own = {name: value for name, value in made.settings.items() if name in names}
    return replace(recipes.check(f"{out}/provenance.json", own, Settings), without=settings.without)


def _part(
    folder: Path, recordings: Sequence[Path], settings: Settings, before: Before, workers: int
) -> Result:
    """Write the shards of recordings, the manifest with them, and what is known of them."""
    if settings.masks and not any(has_masks(path) for path in recordings):
        raise SettingError(f"{recordings[0]} has no masks; renders have. Leave out --masks")
    made = _provenance(recordings, settings)
    known, held = _read(recordings, settings)
    sources = {path: one.source for path, one in known.items()}
    warn_of_others(sources, {path: one.others for path, one in known.items()})
    warn_of_lenses([px for one in known.values() for px in one.focal_px])
    tally, seen = Tally(), Seen(before.seen())
    found = rows(
        held,
        sources,
        _splits(recordings, made, settings, before),
        tally,
        _wanted(settings),
        total=sum(one.images for one in known.values()),
        size_px=before.size_px,
        workers=workers,
    )
    shards = write_shards(
        folder,
        seen.new(found, tally.refuse_twin if before.made else None),
        png=settings.png or settings.parquet,
        shard_images=settings.shard_images,
        before=before.manifest,
    )
    manifest = before.manifest.with_part(shards)
    explain(recordings, manifest, tally, settings)
    unused(settings, tally)
    place = part_folder(folder, before.manifest.parts)
    place.mkdir(parents=True)
    made.write(place)
    facts_of(known, tally, seen).write(place)
    seen.write(place)
    manifest.write(folder)  # last: from here on the part belongs to the dataset
    images = {
        name: sum(one.rows for one in shards[name]) for name in manifest.splits if name in shards
    }
    return Result(images, {path.name: source for path, source in sources.items()}, tally)


def _splits(
    recordings: Sequence[Path], made: Provenance, settings: Settings, before: Before
) -> dict[Path, SplitOf]:
    return splits_of(
        recordings,
        made,
        split=settings.split,
        val=settings.val,
        test_share=settings.test_share,
        seed=settings.seed,
        there=before.inputs if before.made else None,
    )


def _wanted(settings: Settings) -> Wanted:
    flagged = frozenset() if settings.without is None else read_flags(settings.without)
    return Wanted(settings.keep_all, settings.masks, flagged)


def _describe(folder: Path) -> None:
    """Write what follows from the manifest and the parts: names, provenance, facts, the card."""
    manifest = read_manifest(folder)
    assert manifest is not None
    made = made_of(folder, manifest).to_json()  # a kilobyte for each recording: once
    settings = made["settings"]
    about = {"description": str(settings["title"]), "license": str(settings["license"])}
    write_names(folder, manifest, fingerprint=fingerprint_of(made), about=about)
    rewrite(folder / PROVENANCE, made)
    del made
    parts = [read_facts(part_folder(folder, k)) for k in range(manifest.parts)]
    rewrite(folder / FACTS, asdict(merged([part for part in parts if part is not None])))
    if isinstance(folder, Remote):
        say(f"{folder}: the card is as it was; a bucket's would be read as a whole for it")
    else:
        write_card(folder)


def _provenance(recordings: Sequence[Path], settings: Settings) -> Provenance:
    flags = [] if settings.without is None else [settings.without]
    inputs, libraries = [*recordings, *flags], ("pyarrow", "pillow")
    return provenance("dataset", settings, inputs, seed=settings.seed, libraries=libraries)


def _read(
    recordings: Sequence[Path], settings: Settings
) -> tuple[dict[Path, About], dict[Path, Contents]]:
    """What is said of recordings, and the labels of the first, which are not read again."""
    known: dict[Path, About] = {}
    held: dict[Path, Contents] = {}
    images = 0
    for path in recordings:
        known[path], labels = read_about(path, settings.labels)
        images += known[path].images
        if images <= HELD_IMAGES:
            held[path] = labels
    return known, held


DEFAULTS = Settings()


def command(
    recordings: Annotated[list[Path], Parameter(name="IN")],
    out: Path,
    /,
    *,
    settings: Flat[Settings] = DEFAULTS,
    from_index: str | None = None,
    into: Annotated[bool, Parameter(name="--add", negative=())] = False,
    workers: Workers = None,
    on: On = None,
    as_json: AsJson = False,
) -> None:
    """Build an Arrow dataset and its card from recordings.

    Parameters
    ----------
    recordings
        Recordings with images and labels, or folders of them.
    out
        Folder to write. Must not exist, but for --add.
    from_index
        Of the recordings in folders that dmrl index has seen, only those that this is true of, such
        as 'camera = "cf1" and ok_labels > 100'; see dmrl find.
    into
        Add the recordings to OUT, a dataset, with the settings that it was made with. Shards that
        are there stay as they are; recordings and images that are there already are left out.
    workers
        Threads that decode images. Without it, as many as there are cores. Changes no byte.
    as_json
        Print one JSON document in place of the tables.
    """
    if into and on is not None:
        raise SettingError("--add is done here. Leave out --on")
    named = all_recordings(recordings, from_index)
    result: Result | None = None
    if on is None:
        result = (add if into else run)(named, out, settings, workers=workers)
    elif said := done_on(on, "dataset", out, {"recordings": named}, settings):
        result = Result(said["images"], said["sources"], Tally(**said["tally"]))
    if result is None:
        print_line(f"{out} was there, made of the same by the same settings")
        return
    left_out = {why: count for why, count in result.tally.left_out().items() if count}
    if as_json:
        document = {"dataset": str(out), "images": result.images}
        print_json({**document, "labels": result.sources, "left_out": left_out})
        return
    title = f"{out}, added" if into else str(out)
    print_table(title, ("split", "images"), list(result.images.items()))
    print_table("", ("recording", "labels from"), list(result.sources.items()))
