"""Collect facts about the recordings of a dataset before their labels leave memory."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from dmrl import topics
from dmrl.card.facts import Facts
from dmrl.datasets.writing.inputs import find_focal_lengths
from dmrl.datasets.writing.label_choice import choose_label_source, find_label_sources
from dmrl.datasets.writing.near_duplicates import ImageHashes
from dmrl.datasets.writing.rows import ExclusionCounts, count_images
from dmrl.recording import LoadedRecording, list_label_findings, read_splits
from dmrl.recording.licences import licences_in
from dmrl.storage.shared_file import share_file

NOT_SENSORS = (topics.CAMERA_IMAGE, topics.LABELS, topics.DETECTIONS, topics.GRID, topics.TRACKS)
"""Topics that a dataset consists of, or that models compute: no sensors."""


def find_sensor_patterns(names: Iterable[str]) -> list[str]:
    """Return the patterns of sensor topics among these topics, in the order of the table."""
    names = set(names)
    patterns = (row.pattern for row in topics.TOPICS if row.pattern not in NOT_SENSORS)
    return [p for p in patterns if any(topics.parse_topic(p, name) is not None for name in names)]


def describe_cameras(held: Iterable[LoadedRecording]) -> dict[str, str]:
    """Describe the first calibration of each robot's camera, by recording and robot."""
    found = {}
    for one in held:
        for topic in one.topics:
            if (names := topics.parse_topic(topics.CALIBRATION, topic)) is None:
                continue
            for stamped in islice(one.iter_messages(topic), 1):
                if words := _describe_camera(stamped.message):
                    found[f"{one.path.name}: {names['robot']}"] = words
    return found


def _describe_camera(calibration: Any) -> str:
    """Describe a CameraCalibration in words; empty unless K is a row-major 3 x 3 matrix."""
    if len(calibration.K) != 9:
        return ""
    fx, _, cx, _, fy, cy, *_ = calibration.K
    size = f"{calibration.width} x {calibration.height} px"
    words = f"{size}, fx {fx:.2f}, fy {fy:.2f}, cx {cx:.2f}, cy {cy:.2f}"
    bent = ", ".join(f"{value:.4g}" for value in calibration.D)
    return f"{words}, distortion {bent}" if any(calibration.D) else words


@dataclass(frozen=True, slots=True)
class RecordingFacts:
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


def read_recording_facts(
    path: Path, wanted: str, *, with_splits: bool, corrected: bool = False
) -> tuple[RecordingFacts, LoadedRecording]:
    """Read the facts of a recording, and its labels, which may be needed again soon.

    Parameters
    ----------
    path
        Recording with images and labels.
    wanted
        Source of the labels; see `choose_label_source`.
    with_splits
        Whether to read the split that the source of the recording defines.
    corrected
        Whether corrections label its images; see `count_images`.

    Raises
    ------
    RecordingError
        If the recording cannot be read, or lacks images or labels.
    SettingError
        If the recording has no labels from that source.
    """
    with share_file(path):
        held = LoadedRecording(path, topics.LABELS, topics.CALIBRATION)
        images = count_images(held, corrected=corrected)
        source = choose_label_source(held, wanted, corrected=corrected)
        about = RecordingFacts(
            source,
            tuple(sorted(find_label_sources(held) - {source})),
            images,
            tuple(find_focal_lengths(held)),
            tuple(find_sensor_patterns(held.topics)),
            tuple(list_label_findings(held)),
            dict(sorted(licences_in(held.summary))),
            describe_cameras([held]),
            read_splits(path, held.summary) if with_splits else {},
        )
    return about, held


def build_facts(
    known: Mapping[Path, RecordingFacts], tally: ExclusionCounts, seen: ImageHashes
) -> Facts:
    """Build the facts of a dataset from its recordings, exclusions and image hashes."""
    near, compared, outside = seen.count_near_duplicates()
    sensors = {pattern for one in known.values() for pattern in one.sensors}
    return Facts(
        {why: count for why, count in tally.count_by_reason().items() if count},
        {path.name: one.source for path, one in known.items()},
        {path.name: one.others for path, one in known.items() if one.others},
        {path.name: one.findings for path, one in known.items() if one.findings},
        dict(sorted(pair for one in known.values() for pair in one.licences.items())),
        seen.count_exact_duplicates(),
        near,
        0 if compared == outside else compared,
        [row.pattern for row in topics.TOPICS if row.pattern in sensors],
        {name: words for one in known.values() for name, words in one.cameras.items()},
    )
