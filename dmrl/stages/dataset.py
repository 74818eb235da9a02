"""``dmrl dataset``: recordings to an Arrow dataset, with its card."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dmrl.datasets.settings import Settings
from dmrl.errors import SettingError
from dmrl.guards.posix import count_cores
from dmrl.pipeline.batch import find_all_recordings, find_changed_settings
from dmrl.pipeline.single_run import run_on_cluster
from dmrl.terminal.arguments import AsJson, Flat, On, Strict, Workers
from dmrl.terminal.left_out import count_left_out
from dmrl.terminal.tables import print_json, print_line, print_table

if TYPE_CHECKING:
    from dmrl.card.dataset_build import Written


def run(
    recordings: Sequence[Path], out: Path, settings: Settings, *, workers: int | None = None
) -> "Written":
    """Write a dataset to ``out``.

    Parameters
    ----------
    recordings
        With images and labels.
    out
        Folder to write. Must not exist.
    settings
        See `Settings`.
    workers
        Threads that decode images. None: as many as there are cores. Does not affect the output.

    Raises
    ------
    RecordingError
        If a recording cannot be read, lacks images or labels, or its images cannot be used.
    SettingError
        If a recording has no labels from the source asked for, two share name or content, or
        the license is unknown.
    OutputError
        If ``out`` exists.
    """
    from dmrl.card.dataset_build import build_dataset

    return build_dataset(recordings, out, settings, workers or count_cores())


def add(
    recordings: Sequence[Path], out: Path, settings: Settings, *, workers: int | None = None
) -> "Written":
    """Add recordings to the dataset ``out``.

    Of its files only the manifest is written again, and those that are made of it: the card, the
    names for ``datasets``, provenance.json, facts.json. If it was stopped, do it again.

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
        If ``out`` is no dataset that recordings can be added to.
    OutputError
        If another process is writing it, or the system refuses a write.
    """
    from dmrl.card.dataset_build import extend_dataset

    given = find_changed_settings(settings).keys()
    return extend_dataset(recordings, out, settings, given, workers or count_cores())


DEFAULTS = Settings()
MAX_NAMED = 20
"""Recordings that the table of a dataset names; more are counted."""


def command(
    recordings: Annotated[list[Path], Parameter(name="IN")],
    out: Path,
    /,
    *,
    settings: Flat[Settings] = DEFAULTS,
    from_index: str | None = None,
    into: Annotated[bool, Parameter(name="--add", negative=())] = False,
    strict: Strict = False,
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
    strict
        End with an error if an image cannot be decoded. Without it, such images are left out and
        counted.
    workers
        Threads that decode images. Without it, one per core. Does not affect the output.
    """
    if into and on is not None:
        raise SettingError("--add is done here. Leave out --on")
    named = find_all_recordings(recordings, from_index)
    if on is None:
        with count_left_out(strict=strict):
            result = (add if into else run)(named, out, settings, workers=workers)
    elif said := run_on_cluster(on, "dataset", out, {"recordings": named}, settings):
        from dmrl.card.dataset_build import Written
        from dmrl.datasets.writing.rows import ExclusionCounts

        result = Written(said["images"], said["sources"], ExclusionCounts(**said["tally"]))
    else:
        print_line(f"{out} was there, made of the same by the same settings")
        return
    left_out = {why: count for why, count in result.tally.count_by_reason().items() if count}
    if as_json:
        document = {"dataset": str(out), "images": result.images}
        print_json({**document, "labels": result.sources, "left_out": left_out})
        return
    title = f"{out}, added" if into else str(out)
    print_table(title, ("split", "images"), list(result.images.items()))
    if len(result.sources) <= MAX_NAMED:
        print_table("", ("recording", "labels from"), list(result.sources.items()))
    else:
        counted = Counter(result.sources.values()).most_common()
        print_table("", ("labels from", "recordings"), counted)
