"""Collect facts about the recordings of a dataset before their labels leave memory."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dmrl import topics
from dmrl.card.facts import Facts
from dmrl.card.sensor_facts import cameras_of, sensors_of
from dmrl.datasets.writing.inputs import focal_lengths
from dmrl.datasets.writing.near_duplicates import Seen
from dmrl.datasets.writing.rows import Tally, count_images, label_source, sources_of
from dmrl.recording import Contents, label_findings, splits
from dmrl.recording.licences import licences_in
from dmrl.recording.mcap.shared_file import share_file


@dataclass(frozen=True, slots=True)
class About:
    """Facts about one recording for the stage and the card: a few short strings; see `Facts`."""

    source: str
    others: Sequence[str]
    images: int
    focal_px: Sequence[float]
    sensors: Sequence[str]
    findings: Sequence[str]
    licences: Mapping[str, str]
    cameras: Mapping[str, str]
    splits: Mapping[str, Sequence[tuple[int, int]]]


def read_about(path: Path, wanted: str, *, with_splits: bool) -> tuple[About, Contents]:
    """Read the facts of a recording, and its labels, which may be needed again soon.

    Parameters
    ----------
    path
        Recording with images and labels.
    wanted
        Source of the labels; see `choose_label_source`.
    with_splits
        Whether to read the split that the source of the recording defines.

    Raises
    ------
    RecordingError
        If the recording cannot be read, or lacks images or labels.
    SettingError
        If the recording has no labels from that source.
    """
    with share_file(path):
        held = Contents(path, topics.LABELS, topics.CALIBRATION)
        images = count_images(held)
        source = label_source(held, wanted)
        about = About(
            source,
            tuple(sorted(sources_of(held) - {source})),
            images,
            tuple(focal_lengths(held)),
            tuple(sensors_of(held.topics)),
            tuple(label_findings(held)),
            dict(sorted(licences_in(held.summary))),
            cameras_of([held]),
            splits(path, held.summary) if with_splits else {},
        )
    return about, held


def facts_of(known: Mapping[Path, About], tally: Tally, seen: Seen) -> Facts:
    """Build the facts of a dataset from its recordings, exclusions and image hashes."""
    near, compared, outside = seen.near()
    sensors = {pattern for one in known.values() for pattern in one.sensors}
    return Facts(
        {why: count for why, count in tally.left_out().items() if count},
        {path.name: one.source for path, one in known.items()},
        {path.name: one.others for path, one in known.items() if one.others},
        {path.name: one.findings for path, one in known.items() if one.findings},
        dict(sorted(pair for one in known.values() for pair in one.licences.items())),
        seen.twins(),
        near,
        0 if compared == outside else compared,
        [row.pattern for row in topics.TOPICS if row.pattern in sensors],
        {name: words for one in known.values() for name, words in one.cameras.items()},
    )
