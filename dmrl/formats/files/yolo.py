"""YOLO sets: pictures with a text file each, one line a box: ``class x y width height``.

Coordinates are shares of the size of the picture, the box's centre first. A line of a class and
three points or more is a polygon, which gives the box around it; where ``kpt_shape`` is stated,
keypoints follow the box and are left out.

Label files lie in ``labels/`` where the pictures lie in ``images/``, or beside the pictures. Class
names are ``names`` of ``data.yaml``, or the lines of ``classes.txt`` or ``obj.names``. The split
of a picture is that of ``data.yaml``, else that of its folder: ``train``, ``val``, ``valid`` or
``test``.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

from dmrl.errors import MissingExtra, SourceError
from dmrl.formats.base import Content, Format, Options, read_text
from dmrl.formats.files.label_csv import LabelRow
from dmrl.formats.files.labelled_pictures import (
    LABELLED_OPTIONS,
    SHARES,
    LabelledPicture,
    build_rows,
    build_set_content,
    drop_repeats,
    find_split,
    is_picture,
    list_pictures,
    locate,
)
from dmrl.guards.bounded_parsing import parse_number, parse_yaml
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import say

DESCRIPTIONS = ("data.yaml", "data.yml", "dataset.yaml", "dataset.yml")
NAME_FILES = ("classes.txt", "obj.names", "labels/classes.txt")
BOX_LINE = re.compile(rb"\d+( +[01]?\.\d+){4}")
SNIFFED_PICTURES = 20
SPLIT_KEYS = ("train", "test", "val")
MAX_SHARE = 1.001
"""Largest coordinate; above 1 by the rounding of other programs only."""
UNREADABLE = "label files that are not YOLO's; their pictures have no labels"
NO_LABEL_FILE = "pictures have no label file and are taken to show nobody (--unlabelled)"


def can_read(source: Path) -> bool:
    """Return whether a folder has YOLO's description, class names, or label files."""
    if not source.is_dir() or (source / "labels.csv").is_file():
        return False
    if any((source / name).is_file() for name in (*DESCRIPTIONS, *NAME_FILES)):
        return True
    folders = [source, *(path for path in source.iterdir() if path.is_dir())]
    if any((folder / "images").is_dir() and (folder / "labels").is_dir() for folder in folders):
        return True
    pictures = (path for folder in folders for path in folder.iterdir() if is_picture(path))
    beside = (path.with_suffix(".txt") for path in islice(pictures, SNIFFED_PICTURES))
    return any(path.is_file() and BOX_LINE.match(path.read_bytes()[:200]) for path in beside)


@dataclass(frozen=True, slots=True)
class _Description:
    """Class names by number, splits by picture or folder, and whether boxes have keypoints."""

    names: Mapping[int, str] = field(default_factory=dict)
    splits: Mapping[str, str] = field(default_factory=dict)
    keypoints: bool = False


def load_content(source: Path, options: Options) -> Content:
    """Load the samples of a set: images split by split, with their labels.

    Parameters
    ----------
    source
        The folder of the set.
    options
        ``names`` of peers by class, ``rate_hz``, ``unlabelled``, ``robot_width_m``, and those of
        `PictureConverter`.

    Raises
    ------
    SourceError
        If there is no picture, the description cannot be read, or no label file can.
    MissingExtra
        If there is a description and PyYAML is not installed.
    """
    about = _read_description(source)
    paths = list_pictures(source)
    labels = {path: _find_label_file(source, path) for path in paths}
    found = {label for label in labels.values() if label is not None}
    pictures = [
        LabelledPicture(
            path,
            find_split(path.relative_to(source), about.splits),
            _read_rows(label, path, about, options),
            SHARES,
        )
        for path, label in labels.items()
    ]
    if found and not any(p.rows is not None and labels[p.path] for p in pictures):
        raise SourceError(f"{source}: no label file is YOLO's, such as {min(found)}. Fix them")
    if not options.unlabelled and (bare := sum(label is None for label in labels.values())):
        say(f"{source}: {bare} {NO_LABEL_FILE}")
    for lost in _list_label_files(source) - found:
        leave_out("label files without a picture", lost)
    return build_set_content(source, pictures, options)


def _read_description(source: Path) -> _Description:
    found = next((source / n for n in DESCRIPTIONS if (source / n).is_file()), None)
    if found is None:
        listed = next((source / n for n in NAME_FILES if (source / n).is_file()), None)
        lines = read_text(listed).splitlines() if listed else []
        if listed is None:
            say(f"{source}: no class names, so they are class0, class1, ... (--names class0=cf2)")
        return _Description({k: line.strip() for k, line in enumerate(lines) if line.strip()})
    try:
        told = parse_yaml(read_text(found))
        names = told.get("names", {})
        pairs = names.items() if isinstance(names, dict) else enumerate(names)
        listed_names = {int(number): str(name) for number, name in pairs}
        splits = _read_splits(source, told)
    except ModuleNotFoundError as e:
        raise MissingExtra("pyyaml", "yolo", str(found)) from e
    except (ValueError, TypeError, AttributeError) as e:
        why = " ".join(str(e).split())[:200]
        raise SourceError(f"{found} does not describe a YOLO set: {why}. Fix the file") from None
    return _Description(listed_names, splits, bool(told.get("kpt_shape")))


def _read_splits(source: Path, told: Mapping[str, Any]) -> dict[str, str]:
    """Return the splits of folders and pictures, which other machines may have named."""
    splits: dict[str, str] = {}
    for split in SPLIT_KEYS:
        stated = told.get(split) or []
        for text in [stated] if isinstance(stated, str) else stated:
            place = locate(source, str(text))
            if place is not None and place.suffix == ".txt":
                lines = read_text(source / place).split("\n")
                places = [locate(source, line.strip()) for line in lines if line.strip()]
            else:
                places = [place]
            for path in filter(None, places):
                splits.setdefault(path.as_posix(), split)
    return splits


def _find_label_file(source: Path, picture: Path) -> Path | None:
    """Return the label file of a picture: under labels/ for images/, or beside it."""
    parts = picture.relative_to(source).with_suffix(".txt").parts
    beside = picture.with_suffix(".txt")
    for k in reversed(range(len(parts) - 1)):
        if parts[k] == "images":
            beside = source.joinpath(*parts[:k], "labels", *parts[k + 1 :])
            break
    return next((p for p in (beside, picture.with_suffix(".txt")) if p.is_file()), None)


def _list_label_files(source: Path) -> set[Path]:
    return {path for path in source.rglob("labels/**/*.txt") if path.name != "classes.txt"}


def _read_rows(
    label: Path | None, picture: Path, about: _Description, options: Options
) -> list[LabelRow] | None:
    """Return the labels of a picture as shares of its size; None: it is not labelled."""
    if label is None:
        return None if options.unlabelled else []
    boxes, line = [], 0
    try:
        for text in read_text(label).splitlines():
            line += 1
            if words := text.split():
                boxes.append(_parse_line(words, about))
        return build_rows(picture.name, drop_repeats(boxes, label), options.names)
    except (ValueError, SourceError) as e:
        leave_out(UNREADABLE, f"{label}:{line}: {str(e)[:200]}")
        return None


def _parse_line(words: Sequence[str], about: _Description) -> tuple[str, tuple[float, ...]]:
    """Return the class and the box (left, top, right, bottom) of a line."""
    number, *values = map(parse_number, words)
    if not number.is_integer():
        raise ValueError(f"{words[0]} is no number of a class")
    name = about.names.get(int(number), f"class{number:.0f}")
    boxed = len(values) in (4, 5) or about.keypoints
    if not all(math.isfinite(v) and abs(v) <= MAX_SHARE for v in values[: 4 if boxed else None]):
        raise ValueError("coordinates are not shares of the picture's size, from 0 to 1")
    if boxed:
        u, v, width, height = values[:4]
        return name, (u - width / 2, v - height / 2, u + width / 2, v + height / 2)
    if len(values) < 6 or len(values) % 2:
        raise ValueError(f"{len(words)} numbers are no box and no polygon")
    if len(values) == 6 and words[-1].isdecimal():  # as trackers write it
        raise ValueError("a box with a confidence and a track, or a triangle. Cut the last two off")
    return name, (min(values[::2]), min(values[1::2]), max(values[::2]), max(values[1::2]))


FORMAT = Format("yolo", "a YOLO set", can_read, load_content, LABELLED_OPTIONS | {"unlabelled"})
