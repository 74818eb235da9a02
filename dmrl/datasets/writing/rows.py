"""Recordings to rows: images joined with their labels by robot and log time.

Of each image one source of labels is used. An image without any PeerLabels is left out:
nobody looked. One at which the chosen source looked and saw no peer stays, and so does one
that nobody saw any peer in. One that only other sources looked at is left out, and so is one with
a peer whose label is not OK: as a picture of "nobody there" it would teach the opposite of the
truth.
"""

import re
from collections.abc import Callable, Iterator, Set
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dmrl import topics
from dmrl.datasets.layout import PEER
from dmrl.datasets.writing.dataset_writer import Row
from dmrl.datasets.writing.exclusions import Flag
from dmrl.datasets.writing.splits import SplitOf
from dmrl.errors import RecordingError, SettingError
from dmrl.geometry.frames import STRIDE_PX, grid_label
from dmrl.images.codec import decode
from dmrl.messages import STATUS_OK, status_name
from dmrl.recording import Contents, Stamped, matching, read, summary
from dmrl.recording.label_sources import LOOKED, looked_at, sources_in

SOURCES = ("truth", "estimate", "hand", "published")
"""Sources of labels, best first."""

TAUGHT = ("estimate", "truth", "hand", "published")
"""The same, as a network is to learn from them: who estimated labels of a flight that has true ones
wants to know what estimates teach."""

PATTERNS = (topics.camera_image("*"), topics.labels("*"))

Mask = NDArray[np.uint8]
"""(H, W) what every pixel shows: 0 or the place of a peer among the labels, from 1."""


@dataclass(slots=True)
class Tally:
    """What became of the images: how many were kept, and how many left out, and why."""

    kept: int = 0
    without_labels: int = 0
    of_other_sources: int = 0
    not_ok: int = 0
    without_mask: int = 0
    in_no_split: int = 0
    flagged: int = 0
    twice: int = 0

    def refuse_twin(self) -> None:
        """Count one that was kept, and is there already."""
        self.kept, self.twice = self.kept - 1, self.twice + 1

    def left_out(self) -> dict[str, int]:
        """Why images were left out, and how many."""
        return {
            "had no labels": self.without_labels,
            "were not looked at by the chosen source (--labels)": self.of_other_sources,
            "had a label that is not OK (--keep-all keeps them)": self.not_ok,
            "show a peer, but have no mask (--masks)": self.without_mask,
            "belong to no split of their source (--split)": self.in_no_split,
            "were flagged (--without)": self.flagged,
            "are there already: same camera, time and pixels": self.twice,
        }


def count_images(path: Path) -> int:
    """Number of images in a recording, labelled or not.

    Raises
    ------
    MissingTopic
        If it has no topic of images, or none of labels.
    RecordingError
        If one of these topics holds another message.
    """
    found = matching(path, PATTERNS)
    present = summary(path).topics
    return sum(present[t].count for t in found if topics.names(topics.CAMERA_IMAGE, t))


def sources_of(held: Contents) -> set[str]:
    """Every source of labels that a recording has."""
    present: set[str] = set()
    for topic in held.topics:
        if topics.names(topics.LABELS, topic):
            table = held.table(topic, LOOKED).combine_chunks()
            present.update(sources_in(*(_chunk(table, name) for name in LOOKED)))
    return present


def _chunk(table: pa.Table, name: str) -> pa.Array:
    return table.column(name).chunk(0)


def label_source(held: Contents, wanted: str) -> str:
    """The source whose labels are used for a recording.

    Parameters
    ----------
    held
        A recording that `count_images` accepts, best with its labels.
    wanted
        One of `SOURCES`; "best" for the first of them that the recording has; "auto" for the first
        of `TAUGHT`.

    Raises
    ------
    SettingError
        If the recording has labels, but none from that source.
    """
    present = sources_of(held)
    order = {"best": SOURCES, "auto": TAUGHT}.get(wanted, (wanted,))
    if not present:
        return order[0]
    usable = [source for source in order if source in present]
    if not usable:
        has = ", ".join(sorted(present))
        raise SettingError(f"{held.path} has no labels from {wanted}. Try one of --labels {has}")
    return usable[0]


def rows_of(
    held: Contents,
    source: str,
    split_of: SplitOf,
    tally: Tally,
    *,
    keep_all: bool,
    masks: bool,
    flagged: Set[Flag] = frozenset(),
) -> Iterator[tuple[str, Callable[[], Row]] | None]:
    """Split and row of each image of a recording, in time order; None for one left out.

    The row is made when it is called, in any thread: that decodes the image.

    Parameters
    ----------
    held
        A recording that `count_images` accepts, best with its labels: then each of its chunks is
        unpacked once.
    source
        Whose labels; see `label_source`.
    split_of
        Split of a log time.
    tally
        Is counted up.
    keep_all
        Labels that are not OK count as well.
    masks
        Rows have masks. Images that show a peer and have none are left out: an empty mask would
        say that nobody is there.
    flagged
        Images that are left out.
    """
    for image, labels, covered in labelled_images(held, masks=masks):
        split = split_of(image.time_ns)
        mine = [] if labels is None else [one for one in labels.peers if one.source == source]
        if flagged and (held.path.name, _robot(image), image.time_ns) in flagged:
            tally.flagged += 1
        elif labels is None:
            tally.without_labels += 1
        elif split is None:
            tally.in_no_split += 1
        elif source not in (looked_at(labels) or {source}):
            tally.of_other_sources += 1
        elif masks and covered is None and mine:
            tally.without_mask += 1
        elif not keep_all and any(label.status != STATUS_OK for label in mine):
            tally.not_ok += 1
        else:
            tally.kept += 1
            yield split, partial(_row, held.path, image, mine, covered, masks=masks)
            continue
        yield None


def labelled_images(
    held: Contents, *, masks: bool = False
) -> Iterator[tuple[Stamped, Any, Stamped | None]]:
    """Each image with PeerLabels and, if asked for, masks of its robot and log time, or None."""
    labels = _labels(held)
    wanted = [t for t in held.topics if topics.names(topics.CAMERA_IMAGE, t)]
    wanted += [t for t in held.topics if masks and topics.names(topics.MASKS, t)]
    for _, same_time in groupby(read(held.path, *wanted), key=lambda stamped: stamped.time_ns):
        images: list[Stamped] = []
        covered: dict[str, Stamped] = {}
        for stamped in same_time:
            if link := topics.names(topics.MASKS, stamped.topic):
                covered[link["robot"]] = stamped
            else:
                images.append(stamped)
        _refuse_two_of_one_time(held.path, images)
        for image in images:
            robot = _robot(image)
            yield (
                image,
                labels[robot].at(image.time_ns) if robot in labels else None,
                covered.get(robot),
            )


def _labels(held: Contents) -> dict[str, "_Series"]:
    """Labels by robot."""
    found = ((topic, topics.names(topics.LABELS, topic)) for topic in held.topics)
    return {n["robot"]: _Series(held.messages(topic)) for topic, n in found if n is not None}


class _Series:
    """Messages in the order of time, looked up at times that only increase."""

    def __init__(self, messages: Iterator[Stamped]) -> None:
        self._groups = groupby(messages, key=lambda stamped: stamped.time_ns)
        self._next = next(self._groups, None)

    def at(self, time_ns: int) -> Any:
        """All messages of a time as one, or None.

        Two recordings of the same images, merged, have each its own source.
        """
        while self._next is not None and self._next[0] < time_ns:
            self._next = next(self._groups, None)
        if self._next is None or self._next[0] > time_ns:
            return None
        first, *more = (stamped.message for stamped in self._next[1])
        for other in more:
            first.MergeFrom(other)
        self._next = next(self._groups, None)
        return first


def _refuse_two_of_one_time(path: Path, images: list[Stamped]) -> None:
    """Refuse two pictures of one camera at one time: the labels are of one of them."""
    seen: set[str] = set()
    for image in images:
        if image.topic in seen:
            raise RecordingError(
                f"{path}: {image.topic} has two images at {image.time_ns} ns, as when flights of "
                "the same robots are merged. Give the recordings one by one"
            )
        seen.add(image.topic)


def _mask(path: Path, row: Row, covered: Stamped | None) -> Mask:
    """Places of the row's peers in place of the numbers in their names."""
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


def _robot(image: Stamped) -> str:
    return (topics.names(topics.CAMERA_IMAGE, image.topic) or {})["robot"]


def _peer(label: Any) -> dict[str, Any]:
    peer = {field.name: getattr(label, field.name) for field in PEER}
    return {**peer, "box_px": list(label.box_px), "status": status_name(label.status)}


def _row(
    path: Path, image: Stamped, labels: list[Any], covered: Stamped | None, *, masks: bool
) -> Row:
    what = f"{path}: the image of {image.topic} at {image.time_ns} ns"
    rgb = decode(image.message.data, what)
    height_px, width_px = rgb.shape[:2]
    if height_px % STRIDE_PX or width_px % STRIDE_PX:
        raise RecordingError(
            f"{what} is {width_px} x {height_px} px, not a multiple of {STRIDE_PX} both ways. "
            "Scale it: dmrl convert --from images --width-px 320 --height-px 224"
        )
    # A label as unsure as the image is wide says only that the peer may be there.
    peers = [peer for peer in map(_peer, labels) if peer["sigma_u_px"] < width_px]
    uv_depth = np.array([[p["u_px"], p["v_px"], p["depth_m"]] for p in peers]).reshape(-1, 3)
    ahead = uv_depth[np.isfinite(uv_depth).all(axis=1) & (uv_depth[:, 2] > 0)]
    shape = (height_px // STRIDE_PX, width_px // STRIDE_PX)
    grid = grid_label(ahead[:, :2], ahead[:, 2], shape=shape)
    row = Row(rgb, peers, grid, _robot(image), path.name, image.time_ns)
    return replace(row, mask=_mask(path, row, covered)) if masks else row
