"""``dmrl dataset``: recordings to an Arrow dataset, with its card."""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter, validators

from dmrl import topics
from dmrl.card import write_card
from dmrl.card.facts import Facts
from dmrl.card.front import check_license
from dmrl.card.sensors import cameras_of, sensors_of
from dmrl.datasets.flags import read_flags
from dmrl.datasets.inputs import warn_of_lenses
from dmrl.datasets.parts import splits_of
from dmrl.datasets.rows import (
    Tally,
    count_images,
    label_source,
    one_size,
    rows_of,
    sources_of,
)
from dmrl.datasets.splits import SplitOf
from dmrl.datasets.twins import Twins
from dmrl.datasets.write import Row, write_dataset
from dmrl.errors import RecordingError, SettingError
from dmrl.images.ahead import ahead
from dmrl.output import partial_folder
from dmrl.pipeline.crew import cores
from dmrl.pipeline.folders import all_recordings
from dmrl.pipeline.once import done_on
from dmrl.recording import (
    Contents,
    Provenance,
    label_findings,
    licences,
    provenance,
    summary,
)
from dmrl.terminal.arguments import On, Workers
from dmrl.terminal.progress import say, track
from dmrl.terminal.tables import print_json, print_line, print_table

Share = Annotated[float, Parameter(validator=validators.Number(gte=0, lt=1))]
Positive = Annotated[int, Parameter(validator=validators.Number(gte=1))]


@dataclass(frozen=True, slots=True)
class Settings:
    """How recordings become a dataset.

    Parameters
    ----------
    labels
        Whose labels. "auto" takes, for each recording, the first of estimate, truth, hand and
        published that it has: what dmrl label made goes before the truth. "best" takes the truth
        before estimates.
    keep_all
        Use labels that are not OK as well. Without it, images with such a label are left out.
    split
        "auto": as the source says, where it does, else whole recordings. "recordings": whole
        recordings. "none": everything is train.
    test_share
        Share of the recordings that become the test split, 0 to 1.
    val
        Pattern of the recordings' names that become the split val, on which a training chooses its
        threshold and never learns, such as "held*". Empty: none.
    seed
        Another seed holds out other recordings.
    masks
        Keep the masks of rendered robots: a training can then paste robots without what was
        around them. Images that show a peer and have no mask are left out.
    png
        Store PNG images in place of raw pixels: less disk, but decoded at each opening.
    parquet
        Write Parquet files in place of Arrow shards: for publishing. Images are PNG then, which
        others show as images.
    without
        CSV file of images to leave out: source, robot, log_time. dmrl view DATASET --flag helps
        to write one.
    shard_images
        Images per shard, at most.
    title
        Name of the dataset on its card. Empty: made from the recordings' names.
    license
        License on the card: an SPDX identifier such as cc-by-4.0, or a word of the Hugging Face
        Hub's: unknown, other.
    """

    labels: Literal["auto", "best", "truth", "estimate", "hand", "published"] = "auto"
    keep_all: bool = False
    split: Literal["auto", "recordings", "none"] = "auto"
    test_share: Share = 0.2
    val: str = ""
    seed: int = 0
    masks: bool = False
    png: bool = False
    parquet: bool = False
    without: Path | None = None
    shard_images: Positive = 2048
    title: str = ""
    license: str = "unknown"


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
    if settings.masks and not any(_has_masks(path) for path in recordings):
        raise SettingError(f"{recordings[0]} has no masks; renders have. Leave out --masks")
    with partial_folder(out) as partial:
        made = _provenance(recordings, settings)
        total = sum(count_images(path) for path in recordings)
        held = {path: Contents(path, topics.LABELS, topics.CALIBRATION) for path in recordings}
        sources = {path: label_source(held[path], settings.labels) for path in recordings}
        beside = _beside(held, sources)
        split_of = splits_of(
            recordings,
            made,
            split=settings.split,
            val=settings.val,
            test_share=settings.test_share,
            seed=settings.seed,
        )
        warn_of_lenses(held.values())
        tally = Tally()
        twins = Twins()
        images = write_dataset(
            partial,
            twins.seen(_rows(held, sources, split_of, tally, total, settings, workers or cores())),
            png=settings.png or settings.parquet,
            parquet=settings.parquet,
            shard_images=settings.shard_images,
            fingerprint=hashlib.sha256(json.dumps(made.to_json()).encode()).hexdigest(),
            about={"description": settings.title, "license": settings.license},
        )
        _explain(recordings, images, tally, settings)
        _unused(settings, tally)
        made.write(partial)
        result = Result(images, {path.name: source for path, source in sources.items()}, tally)
        _facts(result, held, beside, twins).write(partial)
        write_card(partial)
    return result


def _provenance(recordings: Sequence[Path], settings: Settings) -> Provenance:
    flags = [] if settings.without is None else [settings.without]
    inputs, libraries = [*recordings, *flags], ("pyarrow", "pillow")
    return provenance("dataset", settings, inputs, seed=settings.seed, libraries=libraries)


def _unused(settings: Settings, tally: Tally) -> None:
    """Say so where flags name no image: they may be of another recording."""
    if settings.without is not None:
        flags = len(read_flags(settings.without))
        if flags > tally.flagged:
            say(f"{settings.without}: {flags - tally.flagged} of {flags} flags name no image here")


def _facts(
    result: Result, held: Mapping[Path, Contents], beside: dict[str, list[str]], twins: Twins
) -> Facts:
    """What the card says beside the counts: what is left out, and what to be careful of."""
    return Facts(
        {why: count for why, count in result.tally.left_out().items() if count},
        result.sources,
        beside,
        {path.name: found for path in held if (found := label_findings(held[path]))},
        licences(list(held)),
        twins.count,
        twins.near,
        sensors_of(held.values()),
        cameras_of(held.values()),
    )


def _has_masks(recording: Path) -> bool:
    return any(topics.names(topics.MASKS, topic) for topic in summary(recording).topics)


def _beside(held: Mapping[Path, Contents], sources: Mapping[Path, str]) -> dict[str, list[str]]:
    """Sources that are not used, by recording, which is said where one might be meant."""
    found = {path.name: sorted(sources_of(held[path]) - {used}) for path, used in sources.items()}
    for path, used in sources.items():
        if {"truth", "estimate"} <= {*found[path.name], used}:
            other = "estimate" if used == "truth" else "truth"
            say(f"{path}: labels from {used}, not from {other}, which it has too (--labels)")
    return {name: others for name, others in found.items() if others}


def _rows(
    held: Mapping[Path, Contents],
    sources: dict[Path, str],
    split_of: dict[Path, SplitOf],
    tally: Tally,
    total: int,
    settings: Settings,
    workers: int,
) -> Iterator[tuple[str, Row]]:
    flagged = frozenset() if settings.without is None else read_flags(settings.without)
    how = {"keep_all": settings.keep_all, "masks": settings.masks}
    rows = (
        (path, row)
        for path, source in sources.items()
        for row in rows_of(held[path], source, split_of[path], tally, flagged=flagged, **how)
    )
    size_px: tuple[int, int] | None = None
    for path, kept in track(ahead(_made, rows, workers), "Writing images", total):
        if kept is not None:
            size_px = size_px or kept[1].size_px
            one_size(path, kept[1], size_px)
            yield kept


def _made(
    planned: tuple[Path, tuple[str, Callable[[], Row]] | None],
) -> tuple[Path, tuple[str, Row] | None]:
    path, kept = planned
    return path, None if kept is None else (kept[0], kept[1]())


def _explain(
    recordings: Sequence[Path], images: dict[str, int], tally: Tally, settings: Settings
) -> None:
    reasons = [f"{count} images {why}" for why, count in tally.left_out().items() if count]
    if not images:
        names = ", ".join(str(path) for path in recordings)
        raise RecordingError(
            f"no image of {names} can be used: {'; '.join(reasons) or 'there is none'}. "
            "Try: dmrl info, dmrl label"
        )
    for reason in reasons:
        say(f"left out: {reason}")
    if list(images) == ["train"] and settings.split != "none" and settings.test_share > 0:
        say(
            "nothing is held out for testing. Name two or more recordings or one with a split "
            "of its own, or test on another dataset"
        )


DEFAULTS = Settings()


def command(
    recordings: Annotated[list[Path], Parameter(name="IN")],
    out: Path,
    /,
    *,
    settings: Annotated[Settings, Parameter(name="*")] = DEFAULTS,
    from_index: str | None = None,
    workers: Workers = None,
    on: On = None,
    as_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> None:
    """Build an Arrow dataset and its card from recordings.

    Parameters
    ----------
    recordings
        Recordings with images and labels, or folders of them.
    out
        Folder to write. Must not exist.
    from_index
        Of the recordings in folders that dmrl index has seen, only those that this is true of, such
        as 'camera = "cf1" and ok_labels > 100'; see dmrl find.
    workers
        Threads that decode images. Without it, as many as there are cores. Changes no byte.
    as_json
        Print one JSON document in place of the tables.
    """
    named = all_recordings(recordings, from_index)
    result = run(named, out, settings, workers=workers) if on is None else None
    if on is not None and (said := done_on(on, "dataset", out, {"recordings": named}, settings)):
        result = Result(said["images"], said["sources"], Tally(**said["tally"]))
    if result is None:
        print_line(f"{out} was there, made of the same by the same settings")
        return
    left_out = {why: count for why, count in result.tally.left_out().items() if count}
    if as_json:
        document = {"dataset": str(out), "images": result.images}
        print_json({**document, "labels": result.sources, "left_out": left_out})
        return
    print_table(str(out), ("split", "images"), list(result.images.items()))
    print_table("", ("recording", "labels from"), list(result.sources.items()))
