"""Log blocks written by the Crazyflie client: CSV with ``Timestamp`` in milliseconds first.

Each log block has its own file, ``<block>-<date>T<time>.csv``. A column without any decimal point
contains integers, which distinguishes millimetres from metres. A single file, or a folder of
such files, is the log of one robot. In a folder of folders, each folder is a robot, named after
it.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.errors import EmptySource, SourceError
from dmrl.formats.base import SOURCE_OPTIONS, Content, Format, Options, build_content
from dmrl.formats.clocks import settle_times, unwrap
from dmrl.formats.crazyflie import log_variables
from dmrl.formats.crazyflie.log_block import LogBlock, unwrap_between_blocks
from dmrl.formats.files.text_table import Dialect, read_table
from dmrl.geometry.frames import Array
from dmrl.terminal.left_out import leave_out

TIME_COLUMN = "Timestamp"
NS_PER_MS = 1_000_000
TIMESTAMP_BITS = 24  # milliseconds in a log packet
MAX_TIME_MS = 2**63 / NS_PER_MS
INTEGER_CELL = re.compile(r"\s*[+-]?\d+\s*")
EMPTY_NAME = re.compile(r"column_\d+")  # given by read_table
DATE_SUFFIX = re.compile(r"-\d{8}T\d{2}-\d{2}-\d{2}$")


def can_read(source: Path) -> bool:
    """Return whether a source is a CSV file that begins with ``Timestamp``, or contains one."""
    return bool(_list_robot_files(source, "cf1"))


def _list_robot_files(source: Path, robot: str) -> dict[str, list[Path]]:
    """List the log files of each robot."""
    if source.is_file():
        return {robot: [source]} if _is_log(source) else {}
    if own := sorted(path for path in source.glob("*.csv") if _is_log(path)):
        return {robot: own}
    folders = [path for path in sorted(source.iterdir()) if path.is_dir()]
    below = {folder.name: sorted(filter(_is_log, folder.glob("*.csv"))) for folder in folders}
    return {name: paths for name, paths in below.items() if paths}


def _is_log(path: Path) -> bool:
    if path.suffix != ".csv":
        return False
    with path.open("rb") as stream:
        return stream.read(len(TIME_COLUMN) + 1) == f"{TIME_COLUMN},".encode()


def load_content(source: Path, options: Options) -> Content:
    """Load the samples of the log blocks.

    Parameters
    ----------
    source
        A file, a robot's folder, or a folder with one folder per robot.
    options
        ``robot`` and ``names``.

    Raises
    ------
    SourceError
        If there is no log file, or a line differs from its header: names the line.
    """
    robots = _list_robot_files(source, options.robot)
    if not robots:
        raise SourceError(
            f"no CSV file that begins with {TIME_COLUMN} in {source}. Pass another source"
        )
    if options.robot not in robots:
        options.refuse("robot", f"has no effect: the folders of {source} are named after robots")
    streams: list[log_variables.SampleStream] = []
    for name, blocks in _read_robots(robots).items():
        robot = options.names.get(name, name)
        if blocks:
            streams += log_variables.build_streams(robot, blocks, options.names, source)
    return build_content(streams)


def _read_robots(robots: Mapping[str, list[Path]]) -> dict[str, list[LogBlock]]:
    """Read the blocks of each robot. Files without a row are left out if others have one."""
    read: dict[str, list[LogBlock]] = {name: [] for name in robots}
    empty: dict[Path, EmptySource] = {}
    for name, paths in robots.items():
        _refuse_two_flights(paths)
        for path in paths:
            try:
                read[name].append(read_block(path))
            except EmptySource as e:
                empty[path] = e
    if not any(read.values()):
        raise next(iter(empty.values()))
    for path in empty:
        leave_out("files without a row", path)
    return {
        name: unwrap_between_blocks(blocks, NS_PER_MS << TIMESTAMP_BITS)
        for name, blocks in read.items()
    }


def _refuse_two_flights(paths: Sequence[Path]) -> None:
    """Raise SourceError if two files of a robot are the same block, logged at two times."""
    first: dict[str, Path] = {}
    for path in paths:
        if (other := first.setdefault(_name_block(path), path)) is not path:
            raise SourceError(
                f"{other} and {path.name} are the same log block of two flights. Keep each flight "
                "in a folder of its own"
            )


def _name_block(path: Path) -> str:
    return DATE_SUFFIX.sub("", path.stem)


def read_block(path: Path) -> LogBlock:
    """Read one file. Lines that cannot be used are left out and counted.

    Raises
    ------
    SourceError
        If the file is not a log of the client, or has no row that can be used.
    """
    text = read_table(path, [TIME_COLUMN], Dialect(","))
    if next(iter(text.columns)) != TIME_COLUMN or any(map(EMPTY_NAME.fullmatch, text.columns)):
        raise SourceError(f"{path}:1: not {TIME_COLUMN} and names of variables. Pass another file")
    values = {name: text.parse_numbers(name) for name in text.columns}
    time_ms = values.pop(TIME_COLUMN)
    known = np.flatnonzero(np.isfinite([] if time_ms is None else time_ms))
    if time_ms is None or not len(known):
        raise EmptySource(f"{path}: no number in {TIME_COLUMN}. Pass another file")
    leave_out("rows without a time", path, len(time_ms) - len(known))
    if (largest := np.abs(time_ms[known]).max()) >= MAX_TIME_MS:
        raise SourceError(
            f"{path}: {largest:.0f} in {TIME_COLUMN} is after the year 2262, in the milliseconds "
            "of the client. State its unit: --columns map.toml (docs/sources.md)"
        )
    parts_ms, whole_ms = np.modf(time_ms[known])
    time_ns = unwrap(whole_ms, TIMESTAMP_BITS) * NS_PER_MS + np.rint(parts_ms * 1e6).astype(int)
    found = settle_times(time_ns, lambda row: text.name_row(int(known[row])))
    rows = known[found.rows]
    columns = {
        name: _restore_type([text.columns[name][k] for k in rows], column[rows])
        for name, column in values.items()
        if column is not None
    }
    return LogBlock(_name_block(path), found.time_ns, columns)


def _restore_type(cells: list[str], values: Array) -> NDArray[Any]:
    """Restore the type of a column: the client writes integers without a decimal point."""
    whole = all(INTEGER_CELL.fullmatch(cell) for cell in cells)
    if whole and np.abs(values).max() < 2**31:
        return values.astype(np.int32)
    return values


FORMAT = Format(
    "cfclient", "log blocks of the Crazyflie client", can_read, load_content, SOURCE_OPTIONS
)
