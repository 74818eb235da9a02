"""Folders that the nanocockpit client saves: ``metadata.csv``, ``camera_raw/``, ``camera_rgb/``.

A row per image contains its file, its number (uint8) and time on the camera's clock (uint32
microseconds, wraps in 71.6 minutes), and the robot's last state: millimetres, millimetres per
second, a compressed quaternion, milliradians per second. Raw images are converted to RGB; where
they are missing, the colour ones are used.
"""

import re
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
from dmrl.formats.files.text_table import Dialect, TextTable, read_table
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
WRAP_NS = 1000 << 32
WHOLE_NUMBER = re.compile(r"\s*[+-]?\d{1,18}\s*")
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
    names, table, text = _load_metadata(source / METADATA_FILE)
    paths = [_find_image(source, name) for name in names]
    found = settle_times(unwrap(table[TIME_COLUMN], 32) * 1000, text.name_row)
    paths, time_ns = [paths[row] for row in found.rows], found.time_ns
    table = {name: column[found.rows] for name, column in table.items()}
    lost = int((np.diff(unwrap(table[NUMBER_COLUMN], 8)) - 1).clip(0).sum())
    if lost:
        say(f"{source}: {lost} images were lost in transmission, by their numbers")
    state_ns = time_ns + _wrap_to_int32(table[STATE_TIME_COLUMN] - table[TIME_COLUMN]) * 1000
    if (state_ns[table[STATE_TIME_COLUMN] != 0] < 0).any():  # it came before the clock wrapped
        time_ns, state_ns = time_ns + WRAP_NS, state_ns + WRAP_NS
    streams = [_iter_images(source, paths, time_ns, options)]
    return Content(merge_by_time(streams + _build_state_streams(table, state_ns, options, source)))


def _wrap_to_int32(ticks: Times) -> Times:
    """Wrap differences of two 32-bit counters to the range of int32."""
    return np.asarray((ticks + (1 << 31)) % (1 << 32) - (1 << 31))


def _load_metadata(path: Path) -> tuple[list[str], dict[str, Times], TextTable]:
    """Load the names of the images, the other columns as integers, and the rows they are of.

    Lines that cannot be used are left out and counted.
    """
    text = read_table(path, REQUIRED_COLUMNS, Dialect(","))
    if missing := [name for name in REQUIRED_COLUMNS if name not in text.columns]:
        raise SourceError(f"{path}:1: no column {', '.join(missing)}. Restore the file")
    cells = zip(*(text.columns[name] for name in REQUIRED_COLUMNS[1:]), strict=True)
    good = [k for k, row in enumerate(cells) if all(map(WHOLE_NUMBER.fullmatch, row))]
    odd = sorted({*range(len(text.lines))} - {*good})
    reason = "lines with numbers that are not whole"
    leave_out(reason, text.name_row(odd[0]) if odd else path, len(odd))
    if not good:
        raise SourceError(f"{path} has no row of whole numbers. Restore the file")
    text = text.select(good)
    columns = {name: np.array(text.columns[name], np.int64) for name in REQUIRED_COLUMNS[1:]}
    return text.columns[FILE_COLUMN], columns, text


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
    SOURCE_OPTIONS | {"camera", "size_px", "as_stored"},
)
