"""Folders that the nanocockpit client saves: ``metadata.csv``, ``camera_raw/``, ``camera_rgb/``.

A row per image contains its file, its number (uint8) and time on the camera's clock (uint32
microseconds, wraps in 71.6 minutes), and the robot's last state: millimetres, millimetres per
second, a compressed quaternion, milliradians per second. Raw images are converted to RGB; where
they are missing, the colour ones are used.
"""

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from dmrl.errors import SourceError
from dmrl.formats.base import Content, Format, Options
from dmrl.formats.crazyflie import log_variables
from dmrl.formats.crazyflie.log_block import Block
from dmrl.formats.timestamps import unwrap
from dmrl.images import codec
from dmrl.images.bayer import rgb_of
from dmrl.samples.flight import Times, in_order
from dmrl.samples.sample import Sample, calibration, image
from dmrl.terminal.progress import say

METADATA = "metadata.csv"
FOLDERS = ("camera_raw", "camera_rgb")
FILE, NUMBER = "filename", "frame_id"
TIME, STATE_TIME = "frame_gap8_timestamp", "state_gap8_timestamp"
STATE = ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "quat")
RATES = ("rateRoll", "ratePitch", "rateYaw")
NEEDED = (FILE, NUMBER, TIME, STATE_TIME, *(f"state_{name}" for name in (*STATE, *RATES)))


def recognises(source: Path) -> bool:
    """Return whether a folder has the client's ``metadata.csv`` and an image folder."""
    path = source / METADATA
    if not path.is_file() or not any((source / folder).is_dir() for folder in FOLDERS):
        return False
    with path.open("rb") as stream:
        return stream.read(len(FILE) + 1) == f"{FILE},".encode()


def content(source: Path, options: Options) -> Content:
    """Load the samples of a folder: images, and the robot's state as the camera received it.

    Parameters
    ----------
    source
        The folder.
    options
        ``robot`` and ``camera``, which must have the size of the images.

    Raises
    ------
    SourceError
        If the table lacks a column, or an image is missing or cannot be decoded.
    MissingExtra
        If images are raw and OpenCV is not installed.
    """
    names, table = _read(source / METADATA)
    paths = [_picture(source, name) for name in names]
    time_ns = unwrap(table[TIME], 32) * 1000
    lost = int((np.diff(unwrap(table[NUMBER], 8)) - 1).clip(0).sum())
    if lost:
        say(f"{source}: {lost} images were lost in transmission, by their numbers")
    state_ns = time_ns + _nearest(table[STATE_TIME] - table[TIME]) * 1000
    streams = [_pictures(paths, np.maximum.accumulate(time_ns), options)]
    return Content(in_order(streams + _state(table, state_ns, options, source)))


def _nearest(ticks: Times) -> Times:
    """Wrap differences of two 32-bit counters to the range of int32."""
    return np.asarray((ticks + (1 << 31)) % (1 << 32) - (1 << 31))


def _read(path: Path) -> tuple[list[str], dict[str, Times]]:
    """Load the names of the images, and the other columns as integers."""
    head, rows = _lines(path)
    if missing := [name for name in NEEDED if name not in head]:
        raise SourceError(f"{path}:1: no column {', '.join(missing)}. Restore the file")
    if rows and len(rows[-1]) != len(head):
        say(f"{path}: its last line is cut short; left out")
        rows.pop()
    if not rows:
        raise SourceError(f"{path} has no rows. Pass another folder")
    places = [head.index(name) for name in NEEDED[1:]]
    values = [_integers(row, places, f"{path}:{line}") for line, row in enumerate(rows, 2)]
    try:
        columns = np.array(values, np.int64).T
    except OverflowError:
        raise SourceError(f"{path}: a number beyond 64 bits. Restore the file") from None
    return [row[head.index(FILE)] for row in rows], dict(zip(NEEDED[1:], columns, strict=True))


def _lines(path: Path) -> tuple[list[str], list[list[str]]]:
    """Parse a CSV file into the names of its columns and its rows."""
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            head, *rows = list(csv.reader(stream)) or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as e:
        raise SourceError(f"{path} cannot be read as CSV: {e}. Restore the file") from None
    return head, rows


def _integers(row: list[str], places: list[int], where: str) -> list[int]:
    try:
        return [int(row[place]) for place in places]
    except (ValueError, IndexError):
        raise SourceError(f"{where}: not a file and whole numbers. Fix the line") from None


def _picture(source: Path, name: str) -> Path:
    stem = Path(name).stem
    for folder, suffix in zip(FOLDERS, (".png", ".jpg"), strict=True):
        if (path := source / folder / f"{stem}{suffix}").is_file():
            return path
    raise SourceError(f"no image {stem} in {source / FOLDERS[0]}. Restore it")


def _pictures(paths: Sequence[Path], time_ns: Times, options: Options) -> Iterator[Sample]:
    if options.camera is not None:
        yield calibration(int(time_ns[0]), options.robot, options.camera)
    for path, moment in zip(paths, time_ns.tolist(), strict=True):
        data = path.read_bytes()
        rgb = codec.decode(data, path)
        if path.parent.name == FOLDERS[0]:
            if min(rgb.shape[:2]) < 4:
                raise SourceError(f"{path} is smaller than 4 x 4 pixels. Restore it")
            yield image(moment, options.robot, codec.encode_png(rgb_of(rgb[..., 0].copy())), "png")
        else:
            yield image(moment, options.robot, data, "jpeg")


def _state(
    table: dict[str, Times], state_ns: Times, options: Options, source: Path
) -> list[log_variables.Stream]:
    """Build the streams of the robot's log, with each received state once."""
    stamps = table[STATE_TIME]
    fresh = (stamps != 0) & np.concatenate([[True], np.diff(stamps) != 0])
    if not fresh.any():
        return []
    columns = {
        f"stateEstimateZ.{name}": table[f"state_{name}"][fresh].astype(float)
        for name in (*STATE, *RATES)
    }
    block = Block("stateEstimateZ", state_ns[fresh], columns)
    return log_variables.streams(options.robot, [block], options.names, source)


FORMAT = Format("nanocockpit", "a folder of the nanocockpit client", recognises, content)
