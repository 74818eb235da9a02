"""Rows of a dataset as other trainers take them: a PNG, a name, and boxes with classes."""

import math
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import pyarrow as pa

from dmrl.datasets import Dataset, layout
from dmrl.errors import SettingError
from dmrl.geometry.boxes import clip_box, square_box
from dmrl.geometry.frames import Camera
from dmrl.guards.safe_names import check_split_name
from dmrl.images.codec import encode_png
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import track

COLUMNS = ("peers", "robot", "source", "log_time")
BATCH_ROWS = 2048
"""Rows whose values are Python objects at a time."""
WITHOUT_BOX = "images with a label without a box (--robot-width-m and --camera give one)"


@dataclass(frozen=True)
class ExportRow:
    """One image of a split.

    Parameters
    ----------
    split
        Its split.
    name
        Name for files: its number in the split, recording, robot and log time.
    size_px
        Width and height.
    png
        The image.
    peers
        Its labels, dictionaries with the fields of ``layout.PEER_TYPE``. ``class`` is their class,
        and ``box_px`` is empty where it is unknown.
    robot, source, log_time
        Robot whose camera took it, recording, and log time there, nanoseconds.
    """

    split: str
    name: str
    size_px: tuple[int, int]
    png: bytes
    peers: list[dict[str, Any]]
    robot: str
    source: str
    log_time: int


@dataclass(frozen=True)
class BoxOptions:
    """Options of the boxes and their classes.

    Parameters
    ----------
    names
        Classes by peer, or by peer without the number of its repetition.
    robot_width_m, camera
        Width of the robots, metres, and camera, from which labels without a box get one.
    """

    names: Mapping[str, str] = field(default_factory=dict)
    robot_width_m: float | None = None
    camera: Camera | None = None

    def to_class(self, peer: str) -> str:
        """Return the class of a peer: drone for drone-2."""
        base = _remove_number(peer)
        return self.names.get(peer) or self.names.get(base) or base

    def to_box(self, peer: Mapping[str, Any]) -> list[float]:
        """Return the box of a label: its own, or one as wide as the robot at its depth."""
        if peer["box_px"] or self.camera is None or not self.robot_width_m or not peer["depth_m"]:
            return list(peer["box_px"])
        seen = (peer["u_px"], peer["v_px"], peer["depth_m"])
        return square_box(self.camera, *seen, self.robot_width_m)


@dataclass(frozen=True)
class ExportRows:
    """All rows of a dataset.

    Parameters
    ----------
    data
        The dataset.
    options
        Options of its boxes.
    """

    data: Dataset
    options: BoxOptions

    def check_options(self) -> None:
        """Raise SettingError if an option has no effect, or does not fit the dataset."""
        options, path, camera = self.options, self.data.path, self.options.camera
        if (options.robot_width_m is None) != (camera is None):
            raise SettingError(
                "--robot-width-m and --camera go together with --to. Give both, or neither"
            )
        for split in self.data.splits:
            height_px, width_px = self.data.split(split).image_shape
            size = f"{width_px} x {height_px} px"
            other = f"{camera.width_px} x {camera.height_px} px" if camera else size
            if size != other:
                raise SettingError(
                    f"{path}: its images are {size}, those of --camera {other}. "
                    "Pass the camera of the images"
                )
        known = self._peers | {_remove_number(peer) for peer in self._peers}
        if unused := ", ".join(sorted(options.names.keys() - known)):
            raise SettingError(f"--names has no effect: {path} has no {unused}. Leave it out")

    @cached_property
    def classes(self) -> list[str]:
        """Every class, sorted."""
        return sorted(set(map(self.options.to_class, self._peers)))

    @cached_property
    def _peers(self) -> set[str]:
        peers = (peer for s in self.data.splits for p in self._read(s, "peers") for peer in p)
        return {peer["peer"] for peer in peers}

    @cached_property
    def most_peers(self) -> int:
        """Largest number of labels of an image, 1 at least."""
        return max([1, *(len(p) for s in self.data.splits for p in self._read(s, "peers"))])

    def list_times(self) -> list[list[int]]:
        """Return the log times of the images of each robot, by split and recording."""
        found: dict[tuple[str, ...], list[int]] = defaultdict(list)
        for split in self.data.splits:
            columns = (self._read(split, name) for name in ("robot", "source", "log_time"))
            for robot, source, log_time in zip(*columns, strict=True):
                found[split, robot, source].append(log_time)
        return list(found.values())

    def _read(self, split: str, column: str) -> Iterator[Any]:
        values = self.data.split(split).table[column]
        return _iter_values(values, list(range(len(values))))

    def __iter__(self) -> Iterator[ExportRow]:
        """Yield the rows, split by split."""
        return self._iter_tracked(by_camera=False)

    def iter_by_camera(self) -> Iterator[ExportRow]:
        """Yield the rows, split by split, those of a robot in a recording one after another."""
        return self._iter_tracked(by_camera=True)

    def _iter_tracked(self, *, by_camera: bool) -> Iterator[ExportRow]:
        total = sum(len(self.data.split(split)) for split in self.data.splits)
        return track(self._iter_rows(by_camera=by_camera), "Writing images", total)

    def iter_boxed(self) -> Iterator[ExportRow]:
        """Yield the rows whose visible peers all have boxes, which are clipped to the image.

        Others are left out: a detector would take their peers for background.
        """
        for row in self:
            boxes = [(peer, self.options.to_box(peer)) for peer in row.peers]
            if any(not box for _, box in boxes):
                leave_out(WITHOUT_BOX, f"{self.data.path}: {row.name}")
                continue
            clipped = [peer | {"box_px": clip_box(box, *row.size_px)} for peer, box in boxes]
            yield replace(row, peers=[peer for peer in clipped if _has_area(*peer["box_px"])])

    def _iter_rows(self, *, by_camera: bool) -> Iterator[ExportRow]:
        for name in self.data.splits:
            split = self.data.split(name)
            height_px, width_px = split.image_shape
            table = split.table.select(COLUMNS)
            places = _order_by_camera(table) if by_camera else list(range(len(split)))
            images = split.images(places)
            columns = (_iter_values(table[column], places) for column in COLUMNS)
            for k, (rgb, peers, robot, source, log_time) in enumerate(
                zip(images, *columns, strict=True)
            ):
                place = f"{Path(source).stem[:80]}-{robot[:80]}-{log_time}"
                yield ExportRow(
                    check_split_name(name, f"{self.data.path}: a split"),
                    f"{k:06d}-" + re.sub(r"[^A-Za-z0-9_-]", "_", place),
                    (width_px, height_px),
                    encode_png(rgb),
                    [peer | {"class": self.options.to_class(peer["peer"])} for peer in peers],
                    robot,
                    source,
                    log_time,
                )


def _iter_values(column: pa.ChunkedArray, places: list[int]) -> Iterator[Any]:
    for start in range(0, len(places), BATCH_ROWS):
        yield from column.take(places[start : start + BATCH_ROWS]).to_pylist()


def _order_by_camera(table: pa.Table) -> list[int]:
    """Return the rows by recording and robot, in the order of their first images."""
    cameras = list(zip(*(table[name].to_pylist() for name in ("source", "robot")), strict=True))
    ranks = {camera: rank for rank, camera in enumerate(dict.fromkeys(cameras))}
    return sorted(range(len(cameras)), key=lambda place: ranks[cameras[place]])


def _remove_number(peer: str) -> str:
    """Return a peer without the number of its repetition."""
    return re.sub(r"-\d+$", "", peer)


def _has_area(left: float, top: float, right: float, bottom: float) -> bool:
    return left < right and top < bottom


def to_attributes(peer: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a label that JSON can hold; a depth that is unknown is left out."""
    known = {name: peer[name] for name in (*(f.name for f in layout.PEER_TYPE), "class")}
    if math.isinf(known["sigma_depth_m"]):
        del known["depth_m"], known["sigma_depth_m"]
    return {
        name: value
        for name, value in known.items()
        if not isinstance(value, float) or math.isfinite(value)
    }
