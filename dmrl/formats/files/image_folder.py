"""A folder of images, with labels in a CSV file if there is one; or a single image.

Images: files of ``IMAGE_SUFFIXES``, in the natural order of their names: img2 before img10. If
every name is a date like ``DATE``, as those of phones, it is the time, in UTC; if every name is a
number of 12 digits or more, the numbers are times in nanoseconds, or in the unit of ``UNITS_NS`` in
which a camera can be that fast; if every name is a number like ``SECONDS``, in seconds; otherwise
the images get nominal times, evenly spaced from 0.

Labels: ``labels.csv`` in the folder, or another file. It has one row per peer and image; a row
with an empty peer means that no peer is in view. An image without a row is not labelled.

* ``file, peer`` are required, and ``u_px, v_px`` or ``left_px, top_px, right_px, bottom_px``;
* ``depth_m, visible_share, source, split, sigma_u_px, sigma_v_px, sigma_depth_m`` are optional. An
  empty ``source`` is "hand".

Or ``label.txt`` as the published firmware's tools write it, ``imgNNNNN.ppm roll pitch x y z d``
per line: see ``published_firmware``. Its labels need a camera. Maps of a chip: see
``chip_outputs``.

Pixels are those of the stored image, in pixel-edge coordinates. ``calibration.toml`` in the
folder is the camera of the images as they are stored (keys: see ``Camera``). Images of the
AI-deck's whole sensor, 324x244, with a camera of 320x224 are cropped to the area of that camera,
unless 324x244 is requested.
"""

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from statistics import median

from dmrl.errors import SourceError
from dmrl.formats.aideck import published_firmware
from dmrl.formats.aideck.chip_outputs import load_chip_maps
from dmrl.formats.base import Content, Format, Options, read_text
from dmrl.formats.files.label_csv import read_labels
from dmrl.formats.files.labelled_pictures import (
    IMAGE_SUFFIXES,
    LABELLED_OPTIONS,
    LabelledPicture,
    add_own_camera,
    build_picture_content,
    is_picture,
    iter_picture_samples,
    natural_key,
)
from dmrl.formats.files.pictures import Crop, crop_camera
from dmrl.guards.bounded_parsing import parse_number
from dmrl.guards.paths import refuse_pipes
from dmrl.samples.sample import Sample
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import say

LABELS_FILE = "labels.csv"
AIDECK_LABELS_FILE = "label.txt"
MIN_TIME_DIGITS = 12  # fewer would be under 17 minutes after 1970: a counter, not a time
SECONDS = re.compile(r"[0-9]+\.[0-9]+|1[0-9]{9}")
"""Names that are seconds: with a decimal point, or whole ones of the years 2001 to 2033."""
LONG_NUMBER = re.compile(r"\d{12}|1\d{9}\.\d")
"""Numbers beside other text that may be times."""
DATE = re.compile(
    r"(?:[A-Z]+\d*[_-])?((?:19|20)\d{6})[_T-]?(\d{6})\.?(\d{3}(?:\d{3})?)?(?:[._][A-Z]+)*",
    re.ASCII | re.IGNORECASE,
)
"""Names that are dates, ``YYYYMMDDhhmmss``, with milli- or microseconds or without, in words or
not: ``IMG_20240301_120000_HDR``."""
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
NS_PER_S = 1_000_000_000
UNITS_NS = {"nanoseconds": 1, "microseconds": 1000, "milliseconds": 1_000_000}
MIN_PERIOD_NS = 2_000_000
"""Least period of a camera. Names that are nearer to each other are times of a larger unit."""
MAX_TIME_NS = 2**63 - 1


UNREAD_SUFFIXES = (
    *(".heic", ".heif", ".avif", ".jxl", ".jp2", ".j2k", ".exr", ".tga"),
    *(".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".raf", ".rw2"),
    *(".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".wmv", ".mjpeg"),
)
"""Photos and videos that stand in folders of pictures and are not read."""
UNREAD = (
    "photos and videos of other kinds: save photos as JPEG, cut videos into pictures "
    "(ffmpeg -i VIDEO -r 5 FOLDER/%05d.png)"
)


def can_read(source: Path) -> bool:
    """Return whether a source is an image, or a folder with one, or with photos or videos."""
    files = source.iterdir() if source.is_dir() else [source]
    return any(is_picture(path) or _is_unread(path) for path in files)


def _is_unread(path: Path) -> bool:
    return path.suffix.lower() in UNREAD_SUFFIXES and path.name[0] != "." and path.is_file()


def load_content(source: Path, options: Options) -> Content:
    """Load the samples of a folder: images in time order, with their labels.

    Parameters
    ----------
    source
        The folder.
    options
        All but ``columns``; of ``names`` only "0", the peer of ``label.txt``.

    Raises
    ------
    SourceError
        If there is no image, one cannot be decoded, or the labels do not match them: names
        the file, and the line.
    SettingError
        If the camera does not have the images' size.
    """
    options = add_own_camera(source, options)
    pictures = list_images(source, options.rate_hz)
    nominal = _list_nominal_times(len(pictures), options.rate_hz)
    if [time_ns for time_ns, _ in pictures] != nominal:
        options.refuse("rate_hz", f"has no effect: the pictures of {source} are named by times")
    path = options.labels or source / LABELS_FILE
    known = {picture.name for _, picture in pictures}
    rows = read_labels(path, known) if options.labels or path.is_file() else {}
    labels = {name: (held[0].split, held) for name, held in rows.items()}
    labelled = [(time_ns, LabelledPicture(p, *labels.get(p.name, ()))) for time_ns, p in pictures]
    states = _load_aideck_labels(source / AIDECK_LABELS_FILE, known)
    if states.keys() - rows.keys() and options.camera is None:
        say(
            f"{source / AIDECK_LABELS_FILE} gives no labels without a camera. Pass: --camera aideck"
        )
    content = build_picture_content(path, labelled, options)
    return replace(content, samples=_iter_samples(source, labelled, states, options))


def list_images(source: Path, rate_hz: float) -> list[tuple[int, Path]]:
    """List (time_ns, path) of every image in a folder, in time order.

    Raises
    ------
    SourceError
        If there is none, only some are named by times, or two have the same time.
    """
    paths = _list_files(source)
    if not (odd := _find_odd_date(paths)) and DATE.fullmatch(paths[0].stem):
        say(f"{source}: the names of the pictures are taken for dates in UTC")
        moments = sorted((_parse_date(path.stem), path) for path in paths)
    elif unit_ns := _find_unit_ns(source, paths):
        if odd and unit_ns > 1:  # that many digits are no time in such a unit
            raise SourceError(f"{odd}. Rename it")
        moments = sorted((_parse_time_ns(path, unit_ns), path) for path in paths)
    else:
        _report_nominal_times(paths, odd)
        return list(zip(_list_nominal_times(len(paths), rate_hz), paths, strict=True))
    for (time_ns, path), (next_ns, following) in pairwise(moments):
        if time_ns == next_ns:
            raise SourceError(f"{path} and {following.name} have the same time. Remove one")
    return moments


def _list_files(source: Path) -> list[Path]:
    """List the images in a folder in natural order; count photos and videos of other kinds."""
    if not source.exists():
        raise SourceError(f"no folder {source}. Pass a folder of images")
    refuse_pipes(source)
    files = sorted(source.iterdir() if source.is_dir() else [source], key=natural_key)
    unread = list(filter(_is_unread, files))
    leave_out(UNREAD, unread[0] if unread else source, len(unread))
    for path in files:
        if path.is_symlink() and not path.exists() and path.suffix.lower() in IMAGE_SUFFIXES:
            leave_out("links to pictures that are not there", path)
    paths = list(filter(is_picture, files))
    if not paths:
        raise SourceError(
            f"no image ({', '.join(IMAGE_SUFFIXES)}) in {source}. Pass another folder"
        )
    return paths


def _list_nominal_times(count: int, rate_hz: float) -> list[int]:
    return [round(k * NS_PER_S / rate_hz) for k in range(count)]


def _report_nominal_times(paths: Sequence[Path], odd: str) -> None:
    """Report that the times are nominal though names look like dates or have long numbers."""
    long = [path for path in paths if LONG_NUMBER.search(path.stem) and not path.stem.isdecimal()]
    if odd:
        say(f"{odd}. So the times of the pictures are nominal (--rate-hz)")
    elif long:
        say(
            f"{long[0]}: the number in its name is not taken for a time, so the times of the "
            "pictures are nominal (--rate-hz). If it is one, name them by the number alone"
        )


def _find_unit_ns(source: Path, paths: Sequence[Path]) -> int:
    """Return the unit of the times that the names state, nanoseconds; 0: they are no times.

    Raises
    ------
    SourceError
        If only some of the names are times.
    """
    if all(SECONDS.fullmatch(path.stem) for path in paths):
        say(f"{source}: the names of the pictures are taken for times in seconds")
        return NS_PER_S
    timed = [p for p in paths if p.stem.isdecimal() and len(p.stem) >= MIN_TIME_DIGITS]
    if timed and (odd := sorted(set(paths) - set(timed))):
        raise SourceError(
            f"{odd[0]} is not named by its time in nanoseconds as {timed[0].name} is. "
            "Rename it, or move it out of the folder"
        )
    steps = [after - before for before, after in pairwise(sorted(int(p.stem) for p in timed))]
    period = median(steps) if any(steps) else MIN_PERIOD_NS
    units = [unit for unit, size_ns in UNITS_NS.items() if period * size_ns >= MIN_PERIOD_NS]
    if timed and units != [*UNITS_NS]:
        taken = f"for times in {units[0]}" if units else "for numbers, too near for times"
        say(f"{source}: the names of the pictures are taken {taken}")
    return UNITS_NS[units[0]] if timed and units else 0


def _parse_date(name: str) -> int:
    """Parse nanoseconds since 1970 from a date; raise ValueError, which says why it is none."""
    if not (found := DATE.fullmatch(name)):
        raise ValueError("not like YYYYMMDD_hhmmss")
    moment = datetime.fromisoformat(f"{found[1]}T{found[2]}.{found[3] or 0}+00:00")
    if moment <= EPOCH:
        raise ValueError("before 1970")
    return (moment - EPOCH) // timedelta(microseconds=1) * 1000


def _find_odd_date(paths: Sequence[Path]) -> str:
    """Return what is wrong with the first name that is no date, if any name looks like one."""
    for path in paths if any(DATE.fullmatch(path.stem) for path in paths) else ():
        try:
            _parse_date(path.stem)
        except ValueError as e:
            return f"{path} is no date: {e}"
    return ""


def _parse_time_ns(path: Path, unit_ns: int) -> int:
    time_ns = int(Decimal(path.stem) * unit_ns)
    if time_ns > MAX_TIME_NS:
        raise SourceError(f"{path}: time after the year 2262. Name it by nanoseconds since 1970")
    return time_ns


def _load_aideck_labels(path: Path, files: Collection[str]) -> dict[str, list[float]]:
    """Load six numbers per image from ``label.txt``, if it exists."""
    found: dict[str, list[float]] = {}
    lines = read_text(path).splitlines() if path.is_file() else []
    for number, line in enumerate(lines, 1):
        name, *words = line.replace(",", " ").split() or [""]
        if not name:
            continue
        try:
            values = [parse_number(word) for word in words]
        except ValueError:
            values = []
        if len(values) != len(published_firmware.VARIABLES):
            wanted = " ".join(published_firmware.VARIABLES)
            raise SourceError(f"{path}:{number}: not an image and {wanted}. Fix the line")
        if (name := name.rsplit("/", 1)[-1]) not in files:
            raise SourceError(f"{path}:{number}: no image {name}. Add it, or delete the line")
        found[name] = values
    return found


def _iter_samples(
    source: Path,
    pictures: list[tuple[int, LabelledPicture]],
    states: dict[str, list[float]],
    options: Options,
) -> Iterator[Sample]:
    """Yield the calibration, then each image, its labels, maps, and the firmware's numbers."""
    labelled = {picture.path.name for _, picture in pictures if picture.rows is not None}

    def more(path: Path, time_ns: int, crop: Crop) -> Iterator[Sample]:
        if (maps := load_chip_maps(path, time_ns, options.robot)) is not None and not crop.changes:
            yield maps
        if path.name in states:
            known = options.camera if path.name not in labelled else None
            camera = crop_camera(crop, known) if known else None
            peer = options.names.get("0", "cf2")
            yield from published_firmware.iter_samples(
                time_ns, options.robot, peer, states[path.name], camera
            )

    yield from iter_picture_samples(source, pictures, options, more)


IMAGE_OPTIONS = LABELLED_OPTIONS | {"labels"}
FORMAT = Format("images", "a picture, or a folder of them", can_read, load_content, IMAGE_OPTIONS)
