"""Build rows from recordings: images joined with their labels by robot and log time.

Each recording uses one source of labels. These images are kept or left out:

* no PeerLabels: left out, since it was never labelled;
* labelled by the chosen source, with or without peers: kept;
* labelled as empty by every source: kept;
* labelled by other sources only: left out;
* a peer whose label is not OK, or not finite: left out. Training would treat the image
  as one without peers.
"""

import re
from collections.abc import Callable, Iterator, Set
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dmrl import topics
from dmrl.datasets.layout import PEER_TYPE
from dmrl.datasets.writing.corrections import Corrections
from dmrl.datasets.writing.dataset_writer import JPEG_START, Row
from dmrl.datasets.writing.exclusions import FlaggedImage
from dmrl.datasets.writing.splits import SplitLookup
from dmrl.errors import RecordingError, SourceError
from dmrl.geometry.frames import STRIDE_PX, build_grid_label
from dmrl.images.codec import UNDECODABLE, Rgb, decode, encode_png
from dmrl.messages import STATUS_OK, to_status_name
from dmrl.recording import LoadedRecording, Stamped, read
from dmrl.recording.label_sources import get_message_sources, mark_repeated
from dmrl.storage.shared_file import share_file
from dmrl.terminal.left_out import leave_out

Mask = NDArray[np.uint8]
"""(H, W) index of the peer that each pixel shows, from 1 among the labels; 0 for the background."""


FAR_PX = 1e6
"""No label is so far outside its image."""


@dataclass(frozen=True, slots=True)
class RowFilter:
    """Filter and contents of the rows.

    Parameters
    ----------
    keep_all
        Also use labels that are not OK.
    masks
        Rows have masks. Images that show a peer and have no mask are left out: an empty mask would
        mark the peer as background.
    flagged
        Images that are left out.
    corrected
        Labels of images that replace those of the recording.
    pixels
        "png" or "jpeg": rows hold the image encoded, the latter as recorded if it was JPEG. "raw":
        they do not.
    """

    keep_all: bool = False
    masks: bool = False
    flagged: Set[FlaggedImage] = frozenset()
    corrected: Corrections = field(default_factory=dict)
    pixels: Literal["raw", "png", "jpeg"] = "raw"


@dataclass(slots=True)
class ExclusionCounts:
    """Number of images kept, and of images left out by reason."""

    kept: int = 0
    without_labels: int = 0
    of_other_sources: int = 0
    not_ok: int = 0
    impossible: int = 0
    without_mask: int = 0
    in_no_split: int = 0
    flagged: int = 0
    twice: int = 0
    undecodable: int = 0
    corrected: int = 0

    def count_undecodable(self, error: SourceError) -> None:
        """Count an image that was counted as kept before, but cannot be decoded."""
        leave_out(UNDECODABLE, error)
        self.kept, self.undecodable = self.kept - 1, self.undecodable + 1

    def count_duplicate(self) -> None:
        """Count an image as a duplicate that was counted as kept before."""
        self.kept, self.twice = self.kept - 1, self.twice + 1

    def count_by_reason(self) -> dict[str, int]:
        """Return the number of images left out, by reason."""
        return {
            "had no labels": self.without_labels,
            "were not labelled by the chosen source (--labels)": self.of_other_sources,
            "had a label that is not OK (--keep-all keeps them)": self.not_ok,
            "had a label whose pixel or depth is no number": self.impossible,
            "show a peer, but have no mask (--masks)": self.without_mask,
            "belong to no split of their source (--split)": self.in_no_split,
            "were flagged (--without)": self.flagged,
            "are in the dataset already: same camera, time and pixels": self.twice,
            "cannot be decoded": self.undecodable,
        }


def count_images(held: LoadedRecording, *, corrected: bool = False) -> int:
    """Count the images of a recording, labelled or not.

    Parameters
    ----------
    held
        The recording.
    corrected
        Whether corrections label its images, so that it needs no labels of its own.

    Raises
    ------
    MissingTopic
        If the recording has no topic of images, or none of labels.
    RecordingError
        If one of these topics contains another message type.
    """
    wanted = (
        [topics.CAMERA_IMAGE("*")] if corrected else [topics.CAMERA_IMAGE("*"), topics.LABELS("*")]
    )
    found = held.matching(*wanted)
    return sum(held.topics[t].count for t in found if topics.parse_topic(topics.CAMERA_IMAGE, t))


def iter_row_builders(
    held: LoadedRecording,
    source: str,
    split_of: SplitLookup,
    tally: ExclusionCounts,
    wanted: RowFilter,
) -> Iterator[tuple[str, Callable[[], Row]] | None]:
    """Yield the split and a row builder for each image, in time order; None for one left out.

    The builder decodes the image when it is called, in any thread.

    Parameters
    ----------
    held
        A recording that `count_images` accepts, best with its labels loaded: each of its chunks is
        then decompressed once.
    source
        Source of the labels; see `label_choice.choose_label_source`.
    split_of
        Split of a log time.
    tally
        Counts of kept and excluded images; updated in place.
    wanted
        Filter and contents of the rows.
    """
    masks, flagged = wanted.masks, wanted.flagged
    for image, labels, covered in iter_labelled_images(held, masks=masks):
        split = split_of(image.time_ns)
        key = (held.path.name, _parse_robot(image), image.time_ns)
        fixed = wanted.corrected.get(key)
        mine = [] if labels is None else [one for one in labels.peers if one.source == source]
        if fixed is not None:
            tally.corrected += 1
            mine, labels = list(fixed), None
        if key in flagged:
            tally.flagged += 1
        elif labels is None and fixed is None:
            tally.without_labels += 1
        elif split is None:
            tally.in_no_split += 1
        elif labels is not None and source not in (get_message_sources(labels) or {source}):
            tally.of_other_sources += 1
        elif masks and covered is None and mine:
            tally.without_mask += 1
        elif not wanted.keep_all and any(label.status != STATUS_OK for label in mine):
            tally.not_ok += 1
        elif not all(map(_is_possible, mine)):
            tally.impossible += 1
        else:
            tally.kept += 1
            yield split, partial(_build_row, held.path, image, mine, covered, wanted)
            continue
        yield None


def _is_possible(label: Any) -> bool:
    """Return whether a label has a pixel and a depth, or says that it has none."""
    at_px = np.abs([label.u_px, label.v_px]).max()  # NaN if one is
    no_depth = np.isinf(label.sigma_depth_m)
    return bool(at_px <= FAR_PX and (no_depth or np.isfinite(label.depth_m)))


def iter_labelled_images(
    held: LoadedRecording, *, masks: bool = False
) -> Iterator[tuple[Stamped, Any, Stamped | None]]:
    """Yield each image with its PeerLabels and, on request, its masks, or None.

    Labels and masks have the robot and the log time of the image.
    """
    labels = _group_labels(held)
    wanted = [t for t in held.topics if topics.parse_topic(topics.CAMERA_IMAGE, t)]
    wanted += [t for t in held.topics if masks and topics.parse_topic(topics.MASKS, t)]
    for _, same_time in groupby(
        _iter_stamped(held.path, wanted), key=lambda stamped: stamped.time_ns
    ):
        images: list[Stamped] = []
        covered: dict[str, Stamped] = {}
        for stamped in same_time:
            if link := topics.parse_topic(topics.MASKS, stamped.topic):
                covered[link["robot"]] = stamped
            else:
                images.append(stamped)
        _reject_duplicate_times(held.path, images)
        for image in images:
            robot = _parse_robot(image)
            seen = labels[robot].find_at(image.time_ns) if robot in labels else None
            yield image, seen, covered.get(robot)


def _iter_stamped(path: Path, wanted: list[str]) -> Iterator[Stamped]:
    with share_file(path):
        yield from read(path, *wanted)


def _group_labels(held: LoadedRecording) -> dict[str, "_LabelSeries"]:
    """Return the labels by robot."""
    found = ((topic, topics.parse_topic(topics.LABELS, topic)) for topic in held.topics)
    return {
        n["robot"]: _LabelSeries(held.iter_messages(topic), f"{held.path}: {topic}")
        for topic, n in found
        if n is not None
    }


class _LabelSeries:
    """Messages in time order, looked up at increasing times."""

    def __init__(self, messages: Iterator[Stamped], where: str) -> None:
        self._where = where
        self._groups = groupby(messages, key=lambda stamped: stamped.time_ns)
        self._next = next(self._groups, None)

    def find_at(self, time_ns: int) -> Any:
        """Return all messages of a time merged into one, or None.

        Two recordings of the same images, merged, may have different sources. Labels that both
        have count once.
        """
        while self._next is not None and self._next[0] < time_ns:
            self._next = next(self._groups, None)
        if self._next is None or self._next[0] > time_ns:
            return None
        first, *more = found = [stamped.message for stamped in self._next[1]]
        if more:
            labels = [[_identify_label(label) for label in message.peers] for message in found]
            marked = mark_repeated(labels, f"{self._where} at {time_ns} ns")
            for other, repeated in zip(more, marked[1:], strict=True):
                peers = zip(other.peers, repeated, strict=True)
                first.peers.extend(label for label, is_there in peers if not is_there)
                first.sources.extend(other.sources)
        self._next = next(self._groups, None)
        return first


def _identify_label(label: Any) -> tuple[tuple[str, str], bytes]:
    return (label.peer, label.source), label.SerializeToString(deterministic=True)


def _reject_duplicate_times(path: Path, images: list[Stamped]) -> None:
    """Raise RecordingError if a camera has two images at one time: labels belong to one of them."""
    seen: set[str] = set()
    for image in images:
        if image.topic in seen:
            raise RecordingError(
                f"{path}: {image.topic} has two images at {image.time_ns} ns, as in a merge of "
                "flights of the same robots. Give the recordings one by one"
            )
        seen.add(image.topic)


def _decode_mask(path: Path, row: Row, covered: Stamped | None) -> Mask:
    """Decode a mask, and replace the numbers in peers' names by indices into the row's peers."""
    shape = row.rgb.shape[:2]
    if covered is None:
        return np.zeros(shape, np.uint8)
    what = f"{path}: {covered.topic} at {covered.time_ns} ns"
    numbers = decode(covered.message.data, what)[..., 0]
    if numbers.shape != shape:
        (height_px, width_px), (rows, cols) = shape, numbers.shape
        sizes = f"{cols} x {rows} px, its image {width_px} x {height_px} px"
        raise RecordingError(f"{what} is {sizes}. Leave out --masks")
    place = np.zeros(256, np.uint8)
    for k, peer in enumerate(row.peers, 1):
        found = re.search(r"\d+$", peer["peer"])
        if found and int(found[0]) < len(place):
            place[int(found[0])] = k
    return place[numbers]


def _parse_robot(image: Stamped) -> str:
    return (topics.parse_topic(topics.CAMERA_IMAGE, image.topic) or {})["robot"]


def _peer_to_dict(label: Any) -> dict[str, Any]:
    peer = {field.name: getattr(label, field.name) for field in PEER_TYPE}
    return {**peer, "box_px": list(label.box_px), "status": to_status_name(label.status)}


def _encode(recorded: bytes, rgb: Rgb, wanted: RowFilter) -> bytes:
    if wanted.pixels == "raw":
        return b""
    keeps = wanted.pixels == "jpeg" and recorded.startswith(JPEG_START)
    return recorded if keeps else encode_png(rgb)


def _build_row(
    path: Path, image: Stamped, labels: list[Any], covered: Stamped | None, wanted: RowFilter
) -> Row:
    what = f"{path}: the image of {image.topic} at {image.time_ns} ns"
    rgb = decode(image.message.data, what)
    height_px, width_px = rgb.shape[:2]
    if height_px % STRIDE_PX or width_px % STRIDE_PX:
        raise RecordingError(
            f"{what} is {width_px} x {height_px} px, not a multiple of {STRIDE_PX} both ways. "
            "Scale it: dmrl convert --from images --width-px 320 --height-px 224"
        )
    # A label with a sigma as large as the image gives no position.
    peers = [peer for peer in map(_peer_to_dict, labels) if peer["sigma_u_px"] < width_px]
    uv_depth = np.array([[p["u_px"], p["v_px"], p["depth_m"]] for p in peers]).reshape(-1, 3)
    unknown = np.isinf([peer["sigma_depth_m"] for peer in peers])
    ahead = uv_depth[np.isfinite(uv_depth).all(axis=1) & ((uv_depth[:, 2] > 0) | unknown)]
    shape = (height_px // STRIDE_PX, width_px // STRIDE_PX)
    grid = build_grid_label(ahead[:, :2], ahead[:, 2], shape=shape)
    encoded = _encode(image.message.data, rgb, wanted)
    row = Row(rgb, peers, grid, _parse_robot(image), path.name, image.time_ns, encoded)
    return replace(row, mask=_decode_mask(path, row, covered)) if wanted.masks else row
