"""Folders that the nanocockpit client saves: ``metadata.csv``, ``camera_raw/``, ``camera_rgb/``.

A row per image contains its file, its number (uint8) and time on the camera's clock (uint32
microseconds, wraps in 71.6 minutes), and the robot's last state: millimetres, millimetres per
second, a compressed quaternion, milliradians per second. Raw images are converted to RGB; where
they are missing, the colour ones are used.
"""

import csv
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from dmrl.errors import SourceError
from dmrl.formats.base import SOURCE_OPTIONS, Content, Format, Options
from dmrl.formats.clocks import settle_times, unwrap
from dmrl.formats.crazyflie import log_variables
from dmrl.formats.crazyflie.log_block import LogBlock
from dmrl.formats.files.pictures import PictureConverter
from dmrl.samples.flight import Times, merge_by_time
from dmrl.samples.sample import Sample
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import say

METADATA_FILE = "metadata.csv"
IMAGE_FOLDERS = ("camera_raw", "camera_rgb")
FILE_COLUMN, NUMBER_COLUMN = "filename", "frame_id"
TIME_COLUMN, STATE_TIME_COLUMN = "frame_gap8_timestamp", "state_gap8_timestamp"
STATE_COLUMNS = ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "quat")
RATE_COLUMNS = ("rateRoll", "ratePitch", "rateYaw")
REQUIRED_COLUMNS = (
    FILE_COLUMN,
    NUMBER_COLUMN,
    TIME_COLUMN,
    STATE_TIME_COLUMN,
    *(f"state_{name}" for name in (*STATE_COLUMNS, *RATE_COLUMNS)),
)


def can_read(source: Path) -> bool:
    """Return whether a folder has the client's ``metadata.csv`` and an image folder."""
    path = source / METADATA_FILE
    if not path.is_file() or not any((source / folder).is_dir() for folder in IMAGE_FOLDERS):
        return False
    with path.open("rb") as stream:
        return stream.read(len(FILE_COLUMN) + 1) == f"{FILE_COLUMN},".encode()


def load_content(source: Path, options: Options) -> Content:
    """Load the samples of a folder: images, and the robot's state as the camera received it.

    Parameters
    ----------
    source
        The folder.
    options
        ``robot``, and those of `PictureConverter`.

    Raises
    ------
    SourceError
        If the table lacks a column.
    MissingExtra
        If images are raw and OpenCV is not installed.
    """
    names, table = _load_metadata(source / METADATA_FILE)
    paths = [_find_image(source, name) for name in names]
    found = settle_times(
        unwrap(table[TIME_COLUMN], 32) * 1000,
        lambda row: f"{source / METADATA_FILE}:{row + 2}",
    )
    paths, time_ns = [paths[row] for row in found.rows], found.time_ns
    table = {name: column[found.rows] for name, column in table.items()}
    lost = int((np.diff(unwrap(table[NUMBER_COLUMN], 8)) - 1).clip(0).sum())
    if lost:
        say(f"{source}: {lost} images were lost in transmission, by their numbers")
    state_ns = time_ns + _wrap_to_int32(table[STATE_TIME_COLUMN] - table[TIME_COLUMN]) * 1000
    streams = [_iter_images(source, paths, time_ns, options)]
    return Content(merge_by_time(streams + _build_state_streams(table, state_ns, options, source)))


def _wrap_to_int32(ticks: Times) -> Times:
    """Wrap differences of two 32-bit counters to the range of int32."""
    return np.asarray((ticks + (1 << 31)) % (1 << 32) - (1 << 31))


def _load_metadata(path: Path) -> tuple[list[str], dict[str, Times]]:
    """Load the names of the images, and the other columns as integers."""
    head, rows = _parse_csv(path)
    if missing := [name for name in REQUIRED_COLUMNS if name not in head]:
        raise SourceError(f"{path}:1: no column {', '.join(missing)}. Restore the file")
    if rows and len(rows[-1]) != len(head):
        leave_out("lines that are cut short", f"{path}:{len(rows) + 1}")
        rows.pop()
    if not rows:
        raise SourceError(f"{path} has no rows. Pass another folder")
    places = [head.index(name) for name in REQUIRED_COLUMNS[1:]]
    values = [_parse_integers(row, places, f"{path}:{line}") for line, row in enumerate(rows, 2)]
    try:
        columns = np.array(values, np.int64).T
    except OverflowError:
        raise SourceError(f"{path}: a number beyond 64 bits. Restore the file") from None
    return [row[head.index(FILE_COLUMN)] for row in rows], dict(
        zip(REQUIRED_COLUMNS[1:], columns, strict=True)
    )


def _parse_csv(path: Path) -> tuple[list[str], list[list[str]]]:
    """Parse a CSV file into the names of its columns and its rows."""
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            head, *rows = list(csv.reader(stream)) or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as e:
        raise SourceError(f"{path} cannot be read as CSV: {e}. Restore the file") from None
    return head, rows


def _parse_integers(row: list[str], places: list[int], where: str) -> list[int]:
    try:
        return [int(row[place]) for place in places]
    except (ValueError, IndexError):
        raise SourceError(f"{where}: not a file and whole numbers. Fix the line") from None


def _find_image(source: Path, name: str) -> Path | None:
    stem = Path(name).stem
    for folder, suffix in zip(IMAGE_FOLDERS, (".png", ".jpg"), strict=True):
        if (path := source / folder / f"{stem}{suffix}").is_file():
            return path
    leave_out("rows without their picture", f"{source / METADATA_FILE}: {name}")
    return None


def _iter_images(
    source: Path, paths: Sequence[Path | None], time_ns: Times, options: Options
) -> Iterator[Sample]:
    converter = PictureConverter(options, source)
    for path, moment in zip(paths, time_ns.tolist(), strict=True):
        if path is None:
            continue
        # The client's raw pictures are grey files of a colour sensor.
        converter.options = replace(options, raw=path.parent.name == IMAGE_FOLDERS[0])
        converted = converter.convert(moment, path.read_bytes(), path)
        yield from converted[1] if converted else ()
    converter.report()


def _build_state_streams(
    table: dict[str, Times], state_ns: Times, options: Options, source: Path
) -> list[log_variables.SampleStream]:
    """Build the streams of the robot's log, with each received state once."""
    stamps = table[STATE_TIME_COLUMN]
    fresh = (stamps != 0) & np.concatenate([[True], np.diff(stamps) != 0])
    if not fresh.any():
        return []
    columns = {
        f"stateEstimateZ.{name}": table[f"state_{name}"][fresh].astype(float)
        for name in (*STATE_COLUMNS, *RATE_COLUMNS)
    }
    block = LogBlock("stateEstimateZ", state_ns[fresh], columns)
    return log_variables.build_streams(options.robot, [block], options.names, source)


FORMAT = Format(
    "nanocockpit",
    "a folder of the nanocockpit client",
    can_read,
    load_content,
    SOURCE_OPTIONS | {"camera", "size_px"},
)
