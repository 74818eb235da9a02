"""COCO sets: JSON files of boxes, with their pictures beside them or in folders of their own.

``annotations/instances_train2017.json`` with ``train2017/``, ``train/_annotations.coco.json`` with
its pictures, or any JSON file with ``images`` and ``annotations``. The split is that in the name of
the file, or of its folder. A ``bbox`` is left, top, width and height in pixel-edge coordinates.
``attributes`` of an annotation may hold ``peer``, ``depth_m``, ``u_px`` and the other columns of
a label, as ``dmrl convert --to coco`` writes them.
"""

import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

from dmrl.errors import SourceError
from dmrl.formats.base import Content, Format, Options
from dmrl.formats.files.label_csv import LabelRow
from dmrl.formats.files.labelled_pictures import (
    LABELLED_OPTIONS,
    SPLIT_NAMES,
    LabelledPicture,
    build_rows,
    build_set_content,
    list_pictures,
)
from dmrl.guards.bounded_parsing import parse_json, parse_number
from dmrl.samples.sample import LABEL_SOURCES
from dmrl.terminal.left_out import leave_out

HEAD_BYTES = 1 << 20
KEYS = re.compile(rb'"(images|annotations|categories)"\s*:\s*\[')
SPLIT_WORDS = re.compile("|".join(sorted(SPLIT_NAMES, key=len, reverse=True)))
Record = Mapping[str, Any]


def can_read(source: Path) -> bool:
    """Return whether a source is, or has, a JSON file with images or annotations of COCO."""
    return any(_is_annotation_file(path) for path in _list_json_files(source))


def _list_json_files(source: Path) -> list[Path]:
    if source.is_file():
        return [source] if source.suffix == ".json" else []
    return sorted(p for depth in ("*.json", "*/*.json") for p in source.glob(depth))


def _is_annotation_file(path: Path) -> bool:
    if path.name.startswith("."):
        return False
    with path.open("rb") as stream:
        return bool(KEYS.search(stream.read(HEAD_BYTES)))


def load_content(source: Path, options: Options) -> Content:
    """Load the samples of a set: images split by split, with their labels.

    Parameters
    ----------
    source
        The folder of the set, or its JSON file.
    options
        ``names`` of peers by category, ``rate_hz``, ``robot_width_m``, and those of
        `PictureConverter`.

    Raises
    ------
    SourceError
        If a JSON file is not COCO's, or none of the pictures is there.
    """
    files = [path for path in _list_json_files(source) if _is_annotation_file(path)]
    # The captions and keypoints of a set are of the same pictures as its boxes.
    boxes = [path for path in files if path.name.startswith("instances")] or files
    root = source if source.is_dir() else source.parent
    found = _PictureIndex(root)
    # A file of a split before one of all pictures.
    boxes.sort(key=lambda path: _find_split(path, root) is None)
    pictures: dict[Path, LabelledPicture] = {}
    for picture in (one for path in boxes for one in _read_file(path, root, found, options)):
        if pictures.setdefault(picture.path, picture) is not picture:
            leave_out("pictures named again, in another JSON file or the same", picture.path)
    if unnamed := [path for path in found.paths if path not in pictures]:
        leave_out("pictures that no JSON file names", unnamed[0], len(unnamed))
    return build_set_content(source, pictures.values(), options)


class _PictureIndex:
    """Pictures below a folder, found by the end of their path."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self.paths = list_pictures(root)
        self._by_name: dict[str, list[Path]] = defaultdict(list)
        for path in self.paths:
            self._by_name[path.name].append(path)

    def find(self, name: str, split: str | None, folder: Path) -> Path | None:
        """Return the picture of this name; of several, that of the split or in the folder."""
        parts = PurePosixPath(name.replace("\\", "/")).parts
        mine = [p for p in self._by_name[parts[-1]] if p.parts[-len(parts) :] == parts]
        mine = mine or (self._by_name[parts[-1]] if parts else [])
        near = [p for p in mine if folder in p.parents and folder.name != "annotations"]
        same = [
            p for p in near or mine if split and _find_split(p.parent / "_", self._root) == split
        ]
        return next(iter(same or near or mine), None)


def _find_split(path: Path, root: Path) -> str | None:
    """Return the split that the name of a file, or of its folder below the root, says."""
    names = [path.stem, *(p.name for p in path.parents if root in p.parents)]
    words = [word for name in names for word in SPLIT_WORDS.findall(name.lower())]
    return SPLIT_NAMES[words[0]] if words else None


def _read_file(
    path: Path, root: Path, found: _PictureIndex, options: Options
) -> Iterator[LabelledPicture]:
    try:
        told = parse_json(path.read_bytes())
        classes = {_to_key(c["id"]): str(c["name"]) for c in told.get("categories", [])}
        by_image: dict[str, list[Record]] = defaultdict(list)
        for annotation in told.get("annotations", []):
            by_image[_to_key(annotation["image_id"])].append(annotation)
        images = [(_to_key(i["id"]), str(i["file_name"]), i) for i in told["images"]]
    except (OSError, ValueError, TypeError, AttributeError, KeyError) as e:
        why = " ".join(f"{type(e).__name__}: {e}".split())[:200]
        raise SourceError(f"{path} is not a COCO file: {why}. Restore the file") from None
    split = _find_split(path, root)
    counts = Counter(number for number, _, _ in images)
    orphans = [a for number, held in by_image.items() if number not in counts for a in held]
    leave_out("boxes of no picture in the file", path, len(orphans))
    for number, name, image in images:
        picture = found.find(name, split, path.parent) if name.strip("/\\") else None
        if picture is None:
            leave_out("pictures of a JSON file that are not there", f"{path}: {name}")
            continue
        where = f"{path}: {name}"
        if counts[number] > 1:
            rows = None
            leave_out("labels of pictures that share an id", f"{where}, {number}")
        else:
            rows = _build_rows(where, picture.name, by_image.get(number, []), classes, options)
        size = image.get("width"), image.get("height")
        yield LabelledPicture(picture, split, rows, None if None in size else size)


def _to_key(number: object) -> str:
    """Return an id as text: some programs write it as a number here and as text there."""
    if isinstance(number, float) and number.is_integer():
        return str(int(number))
    return str(number)


def _build_rows(
    where: str,
    file: str,
    annotations: Sequence[Record],
    classes: Mapping[str, str],
    options: Options,
) -> list[LabelRow] | None:
    """Return the labels of a picture; None if one of them cannot be read."""
    single = [a for a in annotations if not a.get("iscrowd")]
    leave_out("boxes around crowds (iscrowd)", where, len(annotations) - len(single))
    told = {str([a.get(k) for k in ("category_id", "bbox", "attributes")]): a for a in single}
    leave_out("boxes that repeat another of their picture", where, len(single) - len(told))
    single = list(told.values())
    try:
        boxes = [_parse_box(annotation, classes) for annotation in single]
        return list(map(_add_attributes, build_rows(file, boxes, options.names), single))
    except (ValueError, TypeError, KeyError, AttributeError) as e:
        why = " ".join(str(e).split())[:200]
        leave_out("pictures with a box that cannot be read", f"{where}: {why}")
        return None


def _parse_box(
    annotation: Record, classes: Mapping[str, str]
) -> tuple[str, tuple[float, float, float, float]]:
    if not isinstance(annotation.get("bbox"), list):
        raise ValueError("no bbox")
    left, top, width, height = (parse_number(str(edge)) for edge in annotation["bbox"])
    kind = _to_key(annotation["category_id"])
    return classes.get(kind, f"class{kind}"), (left, top, left + width, top + height)


def _add_attributes(row: LabelRow, annotation: Record) -> LabelRow:
    """Return a label with the attributes of its annotation in addition to the box."""
    told = annotation.get("attributes") or {}

    def number(name: str, default: float) -> float:
        value = parse_number(str(told[name])) if name in told else default
        if name in told and not math.isfinite(value):
            raise ValueError(f"{name} is not finite")
        return value

    depth_m = number("depth_m", 0.0)
    return replace(
        row,
        peer=str(told.get("peer") or row.peer),
        source=told["source"] if told.get("source") in LABEL_SOURCES else row.source,
        u_px=number("u_px", row.u_px),
        v_px=number("v_px", row.v_px),
        depth_m=depth_m,
        visible_share=number("visible_share", 0.0),
        sigmas=(
            number("sigma_u_px", 0.0),
            number("sigma_v_px", 0.0),
            number("sigma_depth_m", 0.0 if depth_m else math.inf),
        ),
    )


FORMAT = Format("coco", "a COCO set", can_read, load_content, LABELLED_OPTIONS)
