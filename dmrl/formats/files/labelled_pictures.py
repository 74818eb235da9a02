"""Pictures with labels, as YOLO, COCO, Pascal VOC and folders of pictures have them in common.

A box gives the pixel: the label is its centre. Its class, through ``--names``, is the peer; the
second one of a class in a picture is ``<class>-2``. A label without depth has ``depth_m`` 0 and an
infinite ``sigma_depth_m``.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from dmrl.errors import SettingError, SourceError
from dmrl.formats.base import Content, Options
from dmrl.formats.files.label_csv import LabelRow
from dmrl.formats.files.pictures import PICTURE_OPTIONS, Crop, PictureConverter
from dmrl.geometry.camera_file import read_camera
from dmrl.geometry.frames import Camera
from dmrl.guards import limits
from dmrl.guards.paths import refuse_pipes
from dmrl.samples.sample import Sample, build_labels, find_intervals
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import say

IMAGE_SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".ppm", ".pgm", ".bmp"),
    *(".tif", ".tiff", ".webp", ".gif"),
)
CALIBRATION_FILE = "calibration.toml"
SPLIT_NAMES = {"train": "train", "test": "test", "dev": "val"}
SPLIT_NAMES |= dict.fromkeys(("val", "valid", "validation"), "val")
"""Splits by the names of folders."""
WIDTH_STD_RATIO = 0.098
"""Standard deviation of the seen width of a square over its mean, at a random yaw.

A square of side 1 is |cos| + |sin| wide: 4/pi on average, with a variance of 1 + 2/pi - 16/pi^2.
"""
EDGE_STD_PX = 1.0
"""Standard deviation of an edge of a box that was drawn by hand, pixels."""
BORDER_PX = 1.0
"""A box this near to the border of its picture may be cut off there."""
OVERHANG_PX, OVERHANG_SHARE = 2.0, 0.1
"""Boxes that reach further out of their picture are doubted: pixels, or the share of a side."""
SAME_FOCAL_SHARE = 0.02
"""Focal lengths of two calibrations of one lens differ by less than this share. No record of how
the value was chosen."""
MAX_DEPTH_M = 100.0
"""Larger depths are doubted: a robot of 0.1 m is less than a pixel wide, at 100 px focal length."""

LABELLED_OPTIONS = PICTURE_OPTIONS | {"rate_hz", "robot_width_m"}

SHARES = (1.0, 1.0)
"""Size to which normalised coordinates refer."""

Box = tuple[str, Sequence[float]]
"""Class, and left, top, right, bottom."""
MoreSamples = Callable[[Path, int, Crop], Iterator[Sample]]


@dataclass(frozen=True, slots=True)
class LabelledPicture:
    """One picture with its labels.

    Parameters
    ----------
    path
        The picture.
    split
        Its split; None: in no split.
    rows
        Its labels; empty: nobody is in view; None: not labelled. A row without a peer counts as no
        label, but names its source.
    size_px
        Width and height to which the labels refer; ``SHARES``: they are shares of the size of the
        picture; None: its pixels.
    """

    path: Path
    split: str | None = None
    rows: Sequence[LabelRow] | None = None
    size_px: tuple[float, float] | None = None


def is_picture(path: Path) -> bool:
    """Return whether a path is a picture by its name; hidden files are not."""
    return path.suffix.lower() in IMAGE_SUFFIXES and path.name[0] != "." and path.is_file()


def natural_key(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Return a sort key that puts img2 before img10."""
    parts = re.split(r"(\d+)", str(path))
    return tuple((0, int(p), p) if k % 2 else (1, 0, p) for k, p in enumerate(parts))


def list_pictures(source: Path) -> list[Path]:
    """Return all pictures below a folder, in natural order, without hidden folders and files."""
    refuse_pipes(source)
    found = (path for path in source.rglob("*") if is_picture(path))
    visible = (p for p in found if not any(n[0] in "._" for n in p.relative_to(source).parts))
    return sorted(visible, key=natural_key)


def find_split(relative: PurePosixPath | Path, stated: Mapping[str, str]) -> str | None:
    """Return the split of a path: the one stated for it or for a folder of it, else by its name."""
    for path in (relative, *relative.parents):
        if path.as_posix() in stated:
            return stated[path.as_posix()]
    named = (SPLIT_NAMES.get(part.lower()) for part in relative.parts[:-1])
    return next(filter(None, named), None)


def locate(source: Path, text: str) -> Path | None:
    """Return the longest end of a path, as another machine wrote it, that exists in a folder."""
    parts = [p for p in PurePosixPath(text.replace("\\", "/")).parts if p not in ("/", ".", "..")]
    ends = (Path(*parts[k:]) for k in range(len(parts)))
    return next((end for end in ends if (source / end).exists()), None)


def name_peers(classes: Sequence[str], names: Mapping[str, str]) -> list[str]:
    """Return the peer of each box of a picture from its class."""
    seen: Counter[str] = Counter()
    peers = []
    for name in classes:
        peer = re.sub(r"[^A-Za-z0-9_-]", "_", names.get(name, name)) or "_"
        seen[peer] += 1
        peers.append(peer if seen[peer] == 1 else f"{peer}-{seen[peer]}")
    return peers


def build_rows(file: str, boxes: Sequence[Box], names: Mapping[str, str]) -> list[LabelRow]:
    """Return a label without depth at the centre of each box of a picture.

    Parameters
    ----------
    file
        Name of the picture.
    boxes
        Class, and left, top, right, bottom.
    names
        Peers by class.

    Raises
    ------
    ValueError
        If one is no box, or there are too many.
    """
    if len(boxes) > limits.PEERS:
        raise ValueError(f"more than {limits.PEERS} boxes")
    peers = name_peers([name for name, _ in boxes], names)
    return [_build_row(file, peer, box) for peer, (_, box) in zip(peers, boxes, strict=True)]


def drop_repeats(boxes: Sequence[Box], where: object) -> list[Box]:
    """Return the boxes of a picture without those that repeat one, class and all."""
    found = list({(name, tuple(map(float, box))): (name, box) for name, box in boxes}.values())
    leave_out("boxes that repeat another of their picture", where, len(boxes) - len(found))
    return found


def _build_row(file: str, peer: str, box_px: Sequence[float]) -> LabelRow:
    left, top, right, bottom = (float(edge) for edge in box_px)
    if not (left < right and top < bottom and math.isfinite(right + bottom - left - top)):
        raise ValueError("a box has no area")
    sigmas = (0.0, 0.0, math.inf)
    centre = (left + right) / 2, (top + bottom) / 2
    return LabelRow(file, peer, *centre, 0.0, (left, top, right, bottom), sigmas=sigmas)


def build_picture_content(
    source: Path, pictures: Sequence[tuple[int, LabelledPicture]], options: Options
) -> Content:
    """Build the content of labelled pictures with their times, in time order."""
    if options.robot_width_m is not None and options.camera is None:
        raise SettingError("--robot-width-m needs the focal length. Pass --camera")
    in_pixels = [p for _, p in pictures if p.size_px != SHARES]
    report_doubts(source, [row for p in in_pixels for row in p.rows or ()], options.robot)
    return Content(
        samples=iter_picture_samples(source, pictures, options),
        total=sum(1 + (p.rows is not None) for _, p in pictures) + (options.camera is not None),
        split=find_intervals((time_ns, picture.split) for time_ns, picture in pictures),
    )


def iter_picture_samples(
    source: Path,
    pictures: Iterable[tuple[int, LabelledPicture]],
    options: Options,
    more: MoreSamples | None = None,
) -> Iterator[Sample]:
    """Yield the calibration, then each image, its labels, and ``more`` of the picture.

    Pictures that cannot be decoded are left out with their labels.
    """
    converter = PictureConverter(options, source)
    doubts: Counter[str] = Counter()
    for time_ns, picture in pictures:
        labelled = any(row.peer for row in picture.rows or ())
        data = picture.path.read_bytes()
        found = converter.convert(time_ns, data, picture.path, labelled=labelled)
        if found is None:
            continue
        crop, samples = found
        yield from samples
        if (rows := _to_pixels(picture, crop)) is not None:
            doubts.update(filter(None, (_doubt_place(row, crop) for row in rows if row.peer)))
            rows = [estimate_depth(row, crop, options) for row in rows]
            peers = [crop.crop_label(row).to_fields() for row in rows if row.peer]
            sources = {row.source for row in rows} or {"hand"}
            yield build_labels(time_ns, options.robot, peers, sources)
        if more is not None:
            yield from more(picture.path, time_ns, crop)
    converter.report()
    for doubt, count in doubts.items():
        say(f"{source}: doubt: {count} labels {doubt}")


def _doubt_place(row: LabelRow, crop: Crop) -> str:
    """Return a doubt about the place of a label in its picture; empty: none."""
    size = crop.from_width_px, crop.from_height_px
    edges = row.box_px or (row.u_px, row.v_px) * 2
    over_px = max(-edges[0], -edges[1], edges[2] - size[0], edges[3] - size[1])
    if not (0 <= row.u_px <= size[0] and 0 <= row.v_px <= size[1]):
        return "are centred outside their picture: corners for width and height, or u for v?"
    if over_px > max(OVERHANG_PX, OVERHANG_SHARE * min(edges[2] - edges[0], edges[3] - edges[1])):
        return "have a box that reaches out of its picture: corners for centre and size?"
    return ""


def _to_pixels(picture: LabelledPicture, crop: Crop) -> list[LabelRow] | None:
    """Return the labels in pixels of the picture; None if it has none of its size."""
    if picture.rows is None or picture.size_px is None:
        return None if picture.rows is None else list(picture.rows)
    size = crop.from_width_px, crop.from_height_px
    if picture.size_px == SHARES:
        return [row.scale(*size) for row in picture.rows]
    if picture.size_px != size:
        leave_out("pictures with labels for another size", picture.path)
        return None
    return list(picture.rows)


def estimate_depth(row: LabelRow, crop: Crop, options: Options) -> LabelRow:
    """Return a label with the depth at which the robot is as wide as its box, if it has none.

    A box at the border of the picture may be cut off and gives no depth.
    """
    camera: Camera | None = options.camera
    if row.depth_m or not row.box_px or options.robot_width_m is None or camera is None:
        return row
    left, _, right, _ = row.box_px
    if left < BORDER_PX or right > crop.from_width_px - BORDER_PX:
        return row
    width_px = right - left
    depth_m = camera.fx_px * options.robot_width_m / width_px
    ratio = math.hypot(WIDTH_STD_RATIO, math.sqrt(2) * EDGE_STD_PX / width_px)
    sigmas = (*row.sigmas[:2], depth_m * ratio)
    return replace(row, depth_m=depth_m, sigmas=sigmas, depth_from_box=True)


def report_doubts(source: Path, rows: Sequence[LabelRow], robot: str) -> None:
    """Print a line for each kind of label that is probably wrong."""
    seen = [row for row in rows if row.peer]
    boxed = [row for row in seen if row.box_px]
    normalised = len(seen) > 1 and all(0 <= row.u_px <= 1 and 0 <= row.v_px <= 1 for row in seen)
    doubts = {
        "have u_px and v_px in [0, 1]: shares of the image size? They are pixels here": (
            len(seen) * normalised
        ),
        f"have a depth over {MAX_DEPTH_M:g} m: millimetres? They are metres here": sum(
            row.depth_m > MAX_DEPTH_M for row in seen
        ),
        "have their centre outside their box": sum(not row.is_centre_in_box() for row in boxed),
        f"are of {robot}, which carries the camera (--robot)": sum(r.peer == robot for r in seen),
    }
    for doubt, count in doubts.items():
        if count:
            say(f"{source}: doubt: {count} of {len(seen)} labels {doubt}")


def add_own_camera(source: Path, options: Options) -> Options:
    """Return options with the camera of the folder's own file, unless the user gave one."""
    own = source / CALIBRATION_FILE
    if not own.is_file():
        return options
    if options.camera is not None:
        _warn_of_other_lens(own, options.camera)
        return options
    return replace(options, camera=read_camera(own))


def _warn_of_other_lens(own: Path, given: Camera) -> None:
    """Print a line if the folder's own file has another focal length than the given camera."""
    with suppress(SourceError):  # the file has no effect
        fx_px = read_camera(own).fx_px
        if abs(given.fx_px / fx_px - 1) > SAME_FOCAL_SHARE:
            say(
                f"{own}: doubt: its fx_px is {fx_px:.1f}, that of --camera {given.fx_px:.1f}, "
                "which is used. If the pictures are by the folder's camera, leave --camera out"
            )


def build_set_content(
    source: Path, pictures: Iterable[LabelledPicture], options: Options
) -> Content:
    """Build the content of pictures at nominal times, split by split: a split is one interval."""
    order = {"train": 0, "val": 1, "test": 2, None: 4}
    ordered = sorted(pictures, key=lambda p: (order.get(p.split, 3), p.split or ""))
    if not ordered:
        raise SourceError(f"{source}: no picture of the set is there. Pass the folder with them")
    options = add_own_camera(source, options)
    timed = [(round(k * 1e9 / options.rate_hz), picture) for k, picture in enumerate(ordered)]
    return build_picture_content(source, timed, options)
