"""The synthetic set published with the network ``locanet``: text files and JPEGs.

A folder contains ``synImgs/`` (one robot per image) or ``synImgsMulti/``, with

* ``posLabel.txt``: ``path roll,pitch`` of the camera, then ``x,y,z,roll,pitch,yaw`` per
  robot; x, y, z in the camera frame, metres and radians.
* ``boxLabel.txt``: ``path`` and per robot ``x0,y0,x1,y1,class``, first and last pixel that
  the robot covers when drawn alone; x counts from 0, y from 1.
* ``train.txt``, ``test.txt``: ``path roll,pitch`` and per robot ``u,v,depth_mm,class``.

Only the file name of ``path`` is used. Attitudes in the horizontal frame, x forward, y left, z
up, not negated: Rx(roll) Ry(pitch) for the camera, Rx(roll) Rz(yaw) Ry(pitch) for a robot. The
signs follow from the boxes: of all combinations only these match the outlines (0.6 px median,
the next best 1.1 px), and a test checks it. The order of the camera's two rotations is that of
the authors' rendering script; the boxes agree, weakly. The robots' attitudes are relative to the
horizontal frame, unlike their positions.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dmrl import topics
from dmrl.errors import SourceError
from dmrl.formats.base import Content, Format, Options, read_text
from dmrl.geometry.frames import PUBLISHED_RENDER, Array, camera_from_horizontal, project
from dmrl.guards.bounded_parsing import parse_number
from dmrl.images import codec
from dmrl.samples.sample import Sample, build_calibration, build_image, build_labels, find_intervals

IMAGE_FOLDERS = ("synImgs", "synImgsMulti")
IMAGE_PERIOD_NS = 1_000_000_000
"""Period of the nominal times: image n is at n seconds. The images are unrelated."""


@dataclass(frozen=True, slots=True)
class LocanetImage:
    """One image of the set and its published labels.

    Parameters
    ----------
    path
        The JPEG.
    number
        Number in its name.
    roll_rad, pitch_rad
        Attitude of the camera: horizontal_from_camera = Rx(roll) Ry(pitch).
    xyz_camera
        (N, 3) robot centres, camera frame, metres.
    attitude_rad
        (N, 3) roll, pitch, yaw of the robots: Rx(roll) Rz(yaw) Ry(pitch), horizontal frame.
    box_px
        (N, 4) left, top, right, bottom, pixel-edge coordinates, clipped to the image, without
        occlusion. (0, 4) without boxLabel.txt.
    published
        (N, 3) u_px, v_px, depth_m as printed in train.txt or test.txt; (0, 3) where absent.
    split
        "train", "test", or None.
    """

    path: Path
    number: int
    roll_rad: float
    pitch_rad: float
    xyz_camera: Array
    attitude_rad: Array
    box_px: Array
    published: Array
    split: str | None


def can_read(source: Path) -> bool:
    """Return whether a folder has the file names of the published set."""
    folders = (source, *(source / name for name in IMAGE_FOLDERS))
    return any((folder / "posLabel.txt").is_file() for folder in folders) or any(
        (source / name).is_dir() for name in IMAGE_FOLDERS
    )


@dataclass(frozen=True, slots=True)
class _LabelLine:
    where: str
    head: tuple[float, ...]
    robots: Array


LabelLines = Mapping[str, _LabelLine]


def load_images(source: Path) -> list[LocanetImage]:
    """Load the images of the set in the order of their numbers.

    Parameters
    ----------
    source
        A folder with ``synImgs/`` or ``synImgsMulti/``, or that folder itself.

    Raises
    ------
    SourceError
        If posLabel.txt or an image is missing, or a line is malformed: names file and line.
    """
    folder = _find_folder(source)
    positions = _parse_file(folder / "posLabel.txt", head=2, width=6)
    boxes = _parse_file(folder / "boxLabel.txt", head=0, width=5, optional=True)
    train = _parse_file(folder / "train.txt", head=2, width=4, optional=True)
    test = _parse_file(folder / "test.txt", head=2, width=4, optional=True)
    if both := sorted(train.keys() & test.keys()):
        raise SourceError(
            f"{test[both[0]].where}: {both[0]} is in train.txt too. Delete one of the lines"
        )
    if not positions:
        raise SourceError(f"{folder / 'posLabel.txt'} is empty. Restore the file")
    found = [
        _build_image(folder, name, line, boxes, train, test) for name, line in positions.items()
    ]
    return sorted(found, key=lambda item: item.number)


def _find_folder(source: Path) -> Path:
    inner = [source / name for name in IMAGE_FOLDERS if (source / name).is_dir()]
    if len(inner) > 1:
        raise SourceError(f"{source} has two sets. Pass one: {inner[0]} or {inner[1]}")
    folder = inner[0] if inner else source
    if not (folder / "posLabel.txt").is_file():
        raise SourceError(
            f"no posLabel.txt in {folder}. Pass the folder that has synImgs/ or synImgsMulti/"
        )
    return folder


def _parse_file(path: Path, *, head: int, width: int, optional: bool = False) -> LabelLines:
    """Parse the lines of a label file by the file name of the image."""
    if optional and not path.is_file():
        return {}
    found: dict[str, _LabelLine] = {}
    for number, text in enumerate(read_text(path, "ascii").splitlines(), 1):
        where = f"{path}:{number}"
        name, *words = text.split() or [""]
        name = name.rsplit("/", 1)[-1]
        if name in found:
            raise SourceError(f"{where}: {name} has a line already. Delete one of them")
        found[name] = _LabelLine(where, *_parse_numbers(where, words, head, width))
    return found


def _parse_numbers(
    where: str, words: list[str], head: int, width: int
) -> tuple[tuple[float, ...], Array]:
    wanted = f"path {'roll,pitch ' if head else ''}and {width} numbers per robot"
    try:
        groups = [list(map(parse_number, word.split(","))) for word in words]
    except ValueError as e:
        raise SourceError(f"{where}: {e}; expected {wanted}. Restore the line") from None
    first = tuple(groups.pop(0)) if head and groups else ()
    robots = np.array(groups) if {len(g) for g in groups} == {width} else np.empty(0)
    if len(first) != head or robots.ndim != 2 or not np.isfinite([*first, *robots.flat]).all():
        raise SourceError(f"{where}: not {wanted}, all finite. Restore the line")
    return first, robots


def _build_image(
    folder: Path,
    name: str,
    line: _LabelLine,
    boxes: LabelLines,
    train: LabelLines,
    test: LabelLines,
) -> LocanetImage:
    path = folder / name
    if not path.is_file():
        raise SourceError(f"{line.where}: no image {path}. Restore it, or delete the line")
    if not path.stem.isdecimal():
        raise SourceError(f"{line.where}: {name} is not named by its number. Rename it: 0007.jpg")
    if (line.robots[:, 0] <= 0).any():
        raise SourceError(f"{line.where}: a robot behind the camera, x <= 0. Delete the line")
    label = train.get(name) or test.get(name)
    published = _match_robots(name, line, {name: label}) if label else np.empty((0, 4))
    return LocanetImage(
        path=path,
        number=int(path.stem),
        roll_rad=line.head[0],
        pitch_rad=line.head[1],
        xyz_camera=line.robots[:, :3],
        attitude_rad=line.robots[:, 3:],
        box_px=_to_box_px(_match_robots(name, line, boxes)) if boxes else np.empty((0, 4)),
        published=published[:, :3] * (1.0, 1.0, 1e-3),
        split="train" if name in train else "test" if name in test else None,
    )


def _match_robots(name: str, line: _LabelLine, other: LabelLines) -> Array:
    """Return the rows of another file about the same robots, one each."""
    if name not in other:
        beside = next(iter(other.values())).where.rsplit(":", 1)[0]
        raise SourceError(f"{line.where}: no line for {name} in {beside}. Restore it")
    if len(other[name].robots) != len(line.robots):
        raise SourceError(
            f"{other[name].where}: {len(other[name].robots)} robots, but {len(line.robots)} "
            f"at {line.where}. Restore the line"
        )
    return other[name].robots


def _to_box_px(robots: Array) -> Array:
    """Convert first and last pixels to edges; v is printed one too high."""
    limit = (PUBLISHED_RENDER.width_px, PUBLISHED_RENDER.height_px) * 2
    return np.clip(robots[:, :4] + (0.0, -1.0, 1.0, 0.0), 0.0, limit)


def to_attitude_zyx(roll_rad: float, pitch_rad: float) -> tuple[float, float]:
    """Convert roll and pitch of Rx(roll) Ry(pitch) to those of Rz(yaw) Ry(pitch) Rx(roll).

    The set uses the former, dmrl the latter. The yaw between the two, up to 7 degrees, is
    omitted: the x axis of dmrl's horizontal frame lies below that of the camera.
    """
    cr, sr, cp, sp = np.cos(roll_rad), np.sin(roll_rad), np.cos(pitch_rad), np.sin(pitch_rad)
    return float(np.arctan2(sr, cr * cp)), float(np.arcsin(cr * sp))


def load_content(source: Path, options: Options | None = None) -> Content:
    """Load the samples of the set: every image with its true and its published labels.

    Parameters
    ----------
    source
        A folder with ``synImgs/`` or ``synImgsMulti/``, or that folder itself.
    options
        ``robot`` carries the camera. Its peers are cf2, cf3, ..., without itself.

    Raises
    ------
    SourceError
        If a file is missing or malformed: names file and line.
    """
    robot = (options or Options()).robot
    items = load_images(source)
    return Content(
        samples=_iter_samples(items, robot),
        total=1 + sum(3 + len(item.xyz_camera) for item in items),
        split=find_intervals((item.number * IMAGE_PERIOD_NS, item.split) for item in items),
    )


def _iter_samples(items: list[LocanetImage], robot: str) -> Iterator[Sample]:
    yield build_calibration(items[0].number * IMAGE_PERIOD_NS, robot, PUBLISHED_RENDER)
    for item in items:
        time_ns = item.number * IMAGE_PERIOD_NS
        names = _name_peers(robot, len(item.xyz_camera))
        yield build_image(time_ns, robot, _load_jpeg(item.path), "jpeg")
        sources = ["truth", *(["published"] if len(item.published) else [])]
        yield build_labels(time_ns, robot, _build_labels(item, names), sources)
        roll, pitch = to_attitude_zyx(item.roll_rad, item.pitch_rad)
        fields = {"roll_rad": roll, "pitch_rad": pitch}
        yield Sample(time_ns, topics.ATTITUDE(robot), "Attitude", fields)
        xyz_horizontal = item.xyz_camera @ camera_from_horizontal(roll, pitch)
        for peer, xyz in zip(names, xyz_horizontal.tolist(), strict=True):
            yield _build_truth(time_ns, robot, peer, xyz)


def _load_jpeg(path: Path) -> bytes:
    """Load the bytes of an image, which must decode to the size of the published renders."""
    data = path.read_bytes()
    height_px, width_px, _ = codec.decode(data, path).shape
    wanted = (PUBLISHED_RENDER.width_px, PUBLISHED_RENDER.height_px)
    if (width_px, height_px) != wanted:
        raise SourceError(
            f"{path} is {width_px}x{height_px}, the set is {wanted[0]}x{wanted[1]}. Restore it"
        )
    return data


def _name_peers(robot: str, count: int) -> list[str]:
    names = [f"cf{k}" for k in range(2, count + 3)]
    return [name for name in names if name != robot][:count]


def _build_truth(time_ns: int, robot: str, peer: str, xyz: list[float]) -> Sample:
    fields = dict(zip("xyz", xyz, strict=True)) | {
        "frame_id": f"{robot}/horizontal",
        "covariance": [0.0] * 9,
    }
    return Sample(time_ns, topics.TRUTH(robot, peer), "PeerPosition", fields)


def _build_labels(item: LocanetImage, names: list[str]) -> list[dict[str, Any]]:
    """Build the true label of every robot, each followed by the published one if there is one."""
    uv, depth_m = project(item.xyz_camera, PUBLISHED_RENDER.image_from_optical)
    true = np.column_stack([uv, depth_m])
    found: list[dict[str, Any]] = []
    for k, name in enumerate(names):
        box = {"box_px": item.box_px[k].tolist()} if len(item.box_px) else {}
        for source, rows in (("truth", true), ("published", item.published)):
            if len(rows):
                u, v, depth = rows[k].tolist()
                value = {"u_px": u, "v_px": v, "depth_m": depth, "source": source}
                found.append({"peer": name, **value, **box})
    return found


FORMAT = Format(
    "locanet", "a folder of the published synthetic set", can_read, load_content, frozenset()
)
