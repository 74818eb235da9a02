"""Join the labels and detections of recordings by robot and log time.

The images are those of a dataset. They have labels from the chosen source, all of them OK, or that
source labelled them as empty. See ``dmrl.datasets.writing.rows``.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dmrl import topics
from dmrl.datasets import Split
from dmrl.errors import RecordingError, SettingError
from dmrl.geometry.frames import is_inside
from dmrl.learn.inference.matching import Points
from dmrl.messages import STATUS_OK
from dmrl.recording import LoadedRecording, read_splits
from dmrl.recording.label_sources import SOURCE_FIELDS, collect_sources, mark_repeated
from dmrl.recording.protobuf.arrow_arrays import match_text, to_numpy
from dmrl.recording.provenance_inputs import refuse_duplicates
from dmrl.terminal.progress import track

Mask = NDArray[np.bool_]
Times = NDArray[np.int64]
Spans = list[tuple[int, int]] | None
"""First and last log times of a split, nanoseconds; None: the whole recording."""


class ImageKey(NamedTuple):
    """Identifies an image: recording, robot, and log time in nanoseconds."""

    recording: Path
    robot: str
    time_ns: int


@dataclass(frozen=True, slots=True)
class LabelledDetections:
    """Labels and detections of the same images.

    Parameters
    ----------
    at
        Identities of the images.
    labels
        Labels inside the image, from one source.
    detections
        All detections, best first within an image.
    threshold
        The detector's own threshold on the confidence; 0: not stored.
    left_out
        Number of images and labels left out, by reason.
    unseen
        Images without a Detections message, evaluated as images without detections.
    """

    at: list[ImageKey]
    labels: Points
    detections: Points
    threshold: float = 0.0
    left_out: dict[str, int] = field(default_factory=dict)
    unseen: int = 0

    @property
    def images(self) -> int:
        """Number of images."""
        return len(self.at)


def join_by_image(
    recordings: Sequence[Path], against: str, split: str | None = None, *, partial: bool = False
) -> LabelledDetections:
    """Join as `join_each`, and return all recordings together."""
    return concatenate_parts(join_each(recordings, against, split, partial=partial))


def join_each(
    recordings: Sequence[Path], against: str, split: str | None = None, *, partial: bool = False
) -> list[LabelledDetections]:
    """Join labels and detections of every image that can be evaluated, recording by recording.

    An image without a Detections message counts as one without detections: images that a detector
    skips count against it.

    Parameters
    ----------
    recordings
        Recordings with labels and detections.
    against
        Source of the labels.
    split
        Only this split of each recording's source. None: all images.
    partial
        Leave out images without a Detections message.

    Raises
    ------
    RecordingError
        If a recording cannot be read, has no detections, labels or images, or is given twice.
    SettingError
        If a recording has no labels from that source, no such split, or no image to evaluate.
    """
    refuse_duplicates(recordings)
    return [_join_recording(path, against, split, partial) for path in track(recordings, "Reading")]


def _join_recording(
    recording: Path, against: str, split: str | None, partial: bool
) -> LabelledDetections:
    held = LoadedRecording(recording, topics.LABELS, topics.DETECTIONS)
    robots = topics.list_robots(list(held.topics), topics.DETECTIONS)
    if robots and not partial:
        labelled = topics.list_robots(list(held.topics), topics.LABELS)
        pictured = topics.list_robots(list(held.topics), topics.CAMERA_IMAGE)
        robots = sorted({*robots, *(robot for robot in labelled if robot in pictured)})
    if not robots:
        raise RecordingError(
            f"{recording} has no detections. Try: dmrl predict MODEL {recording} OUT.mcap"
        )
    spans = _find_spans(recording, read_splits(recording, held.summary), split)
    _require_source(held, robots, against)
    parts = [_join_robot(held, robot, against, spans, partial) for robot in robots]
    pairs = concatenate_parts(parts)
    if not pairs.images:
        seen = " and detections" if partial else ""
        where = f"in split {split}" if split else "in it"
        raise SettingError(
            f"{recording} has no image with labels from {against}{seen} {where}. "
            f"Try: dmrl info {recording}"
        )
    return pairs


def read_split_labels(split: Split, rows: Sequence[int]) -> Points:
    """Read the labels inside some images of a split; images are numbered by their position."""
    height_px, width_px = split.image_shape
    entries = _combine_column(split.table, "peers")
    labels = build_points(entries, None, np.array(rows, np.int64), np.arange(len(rows)))
    return labels.select(_is_in_view(labels, width_px, height_px))


def _is_in_view(labels: Points, width_px: int, height_px: int) -> Mask:
    uv = np.column_stack([labels.u_px, labels.v_px])
    return is_inside(uv, width_px, height_px) & ~(labels.depth_m <= 0)


def _find_spans(recording: Path, own: dict[str, list[tuple[int, int]]], split: str | None) -> Spans:
    if split is None:
        return None
    if split not in own:
        has = f"It has: {', '.join(sorted(own))}" if own else "It has none; leave --split out"
        raise SettingError(f"{recording} has no split {split}. {has}")
    return own[split]


def _require_source(held: LoadedRecording, robots: Iterable[str], against: str) -> None:
    present: set[str] = set()
    for robot in robots:
        table = held.get_table(topics.LABELS(robot), SOURCE_FIELDS)
        present |= collect_sources(*(_combine_column(table, name) for name in SOURCE_FIELDS))
    if present and against not in present:
        has = ", ".join(sorted(present))
        raise SettingError(
            f"{held.path} has no labels from {against}. Give --against one of: {has}"
        )


def _join_robot(
    held: LoadedRecording, robot: str, against: str, spans: Spans, partial: bool
) -> LabelledDetections:
    left_out: Counter[str] = Counter()
    labelled = held.get_table(topics.LABELS(robot), SOURCE_FIELDS)
    detected = _read_detections(held, robot)
    times, (peers, looked) = _merge_by_time(labelled, f"{held.path}: {topics.LABELS(robot)}")
    seen_at = to_numpy(_combine_column(detected, "log_time"))
    _refuse_two_at_once(seen_at, f"{held.path}: {topics.DETECTIONS(robot)}")
    mine, usable = _select_usable(peers, looked, against, _is_within(times, spans), left_out)
    seen = np.isin(times, seen_at)
    if partial:
        left_out["images without detections"] += int((usable & ~seen).sum())
    else:
        seen |= np.isin(times, held.get_times(topics.CAMERA_IMAGE(robot)))
        left_out["labels without an image"] += int((usable & ~seen).sum())
    usable &= seen
    judged = times[usable]
    _, in_judged, in_detections = np.intersect1d(judged, seen_at, return_indices=True)
    labels = build_points(peers, mine, np.flatnonzero(usable), np.arange(len(judged)))
    size_px = held.read_image_size(topics.CAMERA_IMAGE(robot))
    if size_px is None:
        raise RecordingError(f"{held.path} has no image of {robot}. Give the whole recording")
    shown = _is_in_view(labels, *size_px)
    left_out["labels outside their image"] += int((~shown).sum())
    every = _combine_column(detected, "detections")
    detections = build_points(every, None, in_detections, in_judged)
    threshold = float(np.max(to_numpy(_combine_column(detected, "threshold")), initial=0.0))
    at = [ImageKey(held.path, robot, int(time_ns)) for time_ns in judged]
    unseen = len(judged) - len(in_judged)
    return LabelledDetections(at, labels.select(shown), detections, threshold, left_out, unseen)


def _read_detections(held: LoadedRecording, robot: str) -> pa.Table:
    """Read a robot's detections; an empty table if it has none."""
    topic = topics.DETECTIONS(robot)
    if topic in held.topics:
        return held.get_table(topic)
    other = topics.list_robots(list(held.topics), topics.DETECTIONS)[0]
    return held.get_table(topics.DETECTIONS(other)).slice(0, 0)


def _refuse_two_at_once(times: Times, where: str) -> None:
    """Raise RecordingError if an image has two messages of detections."""
    if (twice := times[1:][times[1:] == times[:-1]]).size:
        raise RecordingError(
            f"{where} has two messages at {twice[0]} ns, as in a merge of two models' detections. "
            "Give the recordings one by one"
        )


def _merge_by_time(labelled: pa.Table, where: str) -> tuple[Times, list[pa.Array]]:
    """Merge messages of equal log time; return the times and the merged `SOURCE_FIELDS`."""
    every = to_numpy(_combine_column(labelled, "log_time"))
    times, first = np.unique(every, return_index=True)
    found = []
    for name in SOURCE_FIELDS:
        entries = _combine_column(labelled, name)
        if name == "peers" and len(times) < len(every):
            entries = _drop_repeated(entries, every, where)
        ends = to_numpy(entries.offsets)
        starts = np.append(ends[first], ends[-1]) - ends[0]
        found.append(pa.ListArray.from_arrays(starts, entries.flatten()))
    return times, found


def _drop_repeated(peers: pa.Array, times: Times, where: str) -> pa.Array:
    """Remove labels that an earlier message of the same time has, too."""
    rows: list[list[Any]] = []
    for time_ns, group in groupby(zip(times.tolist(), peers, strict=True), key=lambda row: row[0]):
        messages = [labels.as_py() for _, labels in group]
        named = [[((one["peer"], one["source"]), repr(one)) for one in m] for m in messages]
        marked = mark_repeated(named, f"{where} at {time_ns} ns")
        for labels, repeated in zip(messages, marked, strict=True):
            pairs = zip(labels, repeated, strict=True)
            rows.append([label for label, is_there in pairs if not is_there])
    return pa.array(rows, peers.type)


def _select_usable(
    peers: pa.Array, looked: pa.Array, against: str, within: Mask, left_out: Counter[str]
) -> tuple[Mask, Mask]:
    """Select the peers from one source, and the images that they can evaluate."""
    image = _image_indices(peers)
    flat = peers.flatten()
    mine = match_text(flat.field("source"), against)
    bad = mine & (to_numpy(flat.field("status")) != STATUS_OK)
    count = np.bincount(image, minlength=len(peers))
    own = np.bincount(image[mine], minlength=len(peers))
    not_ok = np.bincount(image[bad], minlength=len(peers)) > 0
    asked = match_text(looked.flatten(), against)
    own += np.bincount(_image_indices(looked)[asked], minlength=len(peers))
    known = count + np.diff(to_numpy(looked.offsets)) > 0
    foreign = known & (own == 0)
    left_out["images with labels from other sources only"] += int((within & foreign).sum())
    left_out["images with a label that is not OK"] += int((within & not_ok).sum())
    return mine, within & ~foreign & ~not_ok


def build_points(entries: pa.Array, mine: Mask | None, rows: Times, numbers: Times) -> Points:
    """Build points from the entries of chosen rows of a list column, with these image numbers."""
    place = np.full(len(entries), -1, np.int64)
    place[rows] = numbers
    image = place[_image_indices(entries)]
    keep = np.flatnonzero((image >= 0) if mine is None else (image >= 0) & mine)
    flat = entries.flatten()
    names = {flat.type.field(i).name for i in range(flat.type.num_fields)}
    values = {
        name: to_numpy(flat.field(name))[keep]
        for name in ("u_px", "v_px", "depth_m", "confidence", "sigma_depth_m")
        if name in names
    }
    unknown = np.isinf(values.pop("sigma_depth_m", 0.0))
    values["depth_m"] = np.where(unknown, np.nan, values["depth_m"])
    image = image[keep]
    values.setdefault("confidence", np.ones(len(keep)))
    # By image, and best first: a detector of another program may not sort them.
    order = np.lexsort((-values["confidence"], image))
    return Points(image[order], **{name: value[order] for name, value in values.items()})


def concatenate_parts(parts: list[LabelledDetections]) -> LabelledDetections:
    """Concatenate the images of several robots or recordings."""
    first = np.cumsum([0, *(part.images for part in parts)])
    left_out: Counter[str] = Counter()
    for part in parts:
        left_out.update(part.left_out)
    return LabelledDetections(
        [at for part in parts for at in part.at],
        Points.concatenate([p.labels for p in parts], first),
        Points.concatenate([p.detections for p in parts], first),
        max(part.threshold for part in parts),
        {why: count for why, count in left_out.items() if count},
        sum(part.unseen for part in parts),
    )


def _is_within(times: Times, spans: Spans) -> Mask:
    if spans is None:
        return np.ones(len(times), bool)
    within = np.zeros(len(times), bool)
    for start, end in spans:
        within |= (start <= times) & (times <= end)
    return within


def _image_indices(entries: pa.Array) -> Times:
    """Return the row of a list column that each of its M entries belongs to, (M,)."""
    return np.repeat(np.arange(len(entries)), np.diff(to_numpy(entries.offsets)))


def _combine_column(table: pa.Table, name: str) -> pa.Array:
    joined = table.column(name).combine_chunks()
    return pa.concat_arrays(joined.chunks) if isinstance(joined, pa.ChunkedArray) else joined
