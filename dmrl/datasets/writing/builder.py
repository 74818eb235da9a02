"""Build the rows of many recordings, decode images ahead, and report the images left out."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from dmrl import topics
from dmrl.datasets.manifest import Manifest
from dmrl.datasets.settings import Settings
from dmrl.datasets.writing.corrections import load_corrections
from dmrl.datasets.writing.dataset_writer import Row
from dmrl.datasets.writing.exclusions import load_flags
from dmrl.datasets.writing.rows import ExclusionCounts, RowFilter, iter_row_builders
from dmrl.datasets.writing.splits import SplitLookup
from dmrl.errors import RecordingError, SourceError
from dmrl.images.prefetch import map_ahead
from dmrl.recording import LoadedRecording, read_summary
from dmrl.terminal.progress import say, track


def iter_rows(
    held: Mapping[Path, LoadedRecording],
    sources: Mapping[Path, str],
    split_of: Mapping[Path, SplitLookup],
    tally: ExclusionCounts,
    wanted: RowFilter,
    *,
    total: int,
    size_px: tuple[int, int] | None,
    workers: int,
) -> Iterator[tuple[str, Row]]:
    """Yield the split and the row of every image that is kept, recording after recording.

    Parameters
    ----------
    held
        Recordings whose labels are in memory already. Others are loaded when their turn comes.
    sources, split_of
        By recording: the source of labels that is used, and its splits.
    tally
        Counts of kept and excluded images; updated in place.
    wanted
        Filter of the images.
    total
        Number of images, for the progress bar.
    size_px
        Required width and height. None: those of the first image.
    workers
        Number of decoding threads.

    Raises
    ------
    RecordingError
        If an image has another size.
    """
    planned = (
        (path, row)
        for path, source in sources.items()
        for row in iter_row_builders(
            held[path] if path in held else LoadedRecording(path, topics.LABELS),
            source,
            split_of[path],
            tally,
            wanted,
        )
    )
    for path, kept in track(map_ahead(_decode_row, planned, workers), "Writing images", total):
        if isinstance(kept, SourceError):
            tally.count_undecodable(kept)
        elif kept is not None:
            size_px = size_px or kept[1].size_px
            require_same_size(path, kept[1], size_px)
            yield kept


def _decode_row(
    planned: tuple[Path, tuple[str, Callable[[], Row]] | None],
) -> tuple[Path, tuple[str, Row] | SourceError | None]:
    path, kept = planned
    try:
        return path, None if kept is None else (kept[0], kept[1]())
    except SourceError as e:
        return path, e


def has_masks(recording: Path) -> bool:
    """Return whether a recording has masks."""
    return any(topics.parse_topic(topics.MASKS, topic) for topic in read_summary(recording).topics)


def warn_about_other_sources(
    sources: Mapping[Path, str], others: Mapping[Path, Sequence[str]]
) -> None:
    """Report once for each source that recordings with both truth and estimates are used by."""
    for used, other in (("truth", "estimate"), ("estimate", "truth")):
        both = [path for path in sources if sources[path] == used and other in others[path]]
        if both:
            more = f" and {len(both) - 1} more" if both[1:] else ""
            beside = f"not from {other}, which is there too (--labels)"
            say(f"{both[0]}{more}: labels from {used}, {beside}")


def require_same_size(path: Path, row: Row, size_px: tuple[int, int]) -> None:
    """Raise RecordingError unless a row's image has the size of the rows before it."""
    if row.size_px != size_px:
        width_px, height_px = row.size_px
        raise RecordingError(
            f"{path}: the image of {row.robot} at {row.time_ns} ns is {width_px} x {height_px} px, "
            f"those before it {size_px[0]} x {size_px[1]} px. Make one dataset for each size, "
            "or scale: dmrl convert --from images --width-px 320 --height-px 224"
        )


def warn_about_unused_flags(settings: Settings, tally: ExclusionCounts) -> None:
    """Report flags that match no image: they may belong to another recording."""
    if settings.without is not None:
        flags = len(load_flags(settings.without))
        if flags > tally.flagged:
            say(f"{settings.without}: {flags - tally.flagged} of {flags} flags name no image here")
    if settings.corrections:
        count = len(load_corrections(settings.corrections))
        say(f"labels of {tally.corrected} images are corrected by hand")
        if count > tally.corrected:
            say(f"{count - tally.corrected} of {count} corrections name no image here")


def report_left_out(
    recordings: Sequence[Path], manifest: Manifest, tally: ExclusionCounts, settings: Settings
) -> None:
    """Report the images left out, and a missing test split.

    Raises
    ------
    RecordingError
        If no image can be used.
    """
    reasons = [f"images that {why}: {n}" for why, n in tally.count_by_reason().items() if n]
    if not (tally.kept or tally.twice):
        names = ", ".join(str(path) for path in recordings)
        raise RecordingError(
            f"no image of {names} can be used: {'; '.join(reasons) or 'there is none'}. "
            "Try: dmrl info, dmrl label"
        )
    for reason in reasons[: -1 if tally.undecodable else None]:  # that one has its line
        say(f"left out: {reason}")
    if list(manifest.splits) == ["train"] and settings.split != "none" and settings.test_share > 0:
        say(
            "nothing is held out for testing. Name two or more recordings or one with a split "
            "of its own, or test on another dataset"
        )
