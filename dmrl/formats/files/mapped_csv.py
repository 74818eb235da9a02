"""Foreign CSV files, read by a table that defines their columns (`column_map`).

A file is the log of one robot; a folder has one per robot, named after its file. Every column is
kept unchanged, on ``/<robot>/log/columns``. Flights of NanoBench are recognised by their columns.
"""

import csv
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from dmrl.errors import SourceError
from dmrl.formats.base import SOURCE_OPTIONS, Content, Format, Options, build_content
from dmrl.formats.crazyflie import log_variables
from dmrl.formats.crazyflie.log_block import LogBlock, TimeSeries
from dmrl.formats.crazyflie.log_variables import SampleStream
from dmrl.formats.crazyflie.state import find_attitude
from dmrl.formats.files.column_map import ANGLE_UNITS, RATE_UNITS, ColumnMap, read_column_map
from dmrl.geometry.frames import Array
from dmrl.samples import flight
from dmrl.samples.flight import Times
from dmrl.terminal.progress import say

NANOBENCH_TABLE = Path(__file__).parent / "nanobench.toml"
SEPARATORS = ",;\t"
BUILTIN_TABLES = {"nanobench": NANOBENCH_TABLE}
"""Column tables of this package, by name."""

# The Crazyflie's variable of each quantity, and the factor from dmrl's unit to its unit.
CRAZYFLIE_VARIABLES = {
    "roll": ("stateEstimate.roll", 1 / ANGLE_UNITS["deg"]),
    "pitch": ("stateEstimate.pitch", -1 / ANGLE_UNITS["deg"]),
    "yaw": ("stateEstimate.yaw", 1 / ANGLE_UNITS["deg"]),
    "yaw_rate": ("stateEstimateZ.rateYaw", 1e3),
    "gyro_y": ("gyro.y", 1 / RATE_UNITS["deg/s"]),
    "gyro_z": ("gyro.z", 1 / RATE_UNITS["deg/s"]),
    "height": ("stateEstimate.z", 1.0),
    **{name: (f"stateEstimate.{name}", 1.0) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")},
    **{f"true_{n}": (f"locSrv.{n}", 1.0) for n in ("x", "y", "z", "qx", "qy", "qz", "qw")},
}
MAX_TILT_RAD = np.pi
MAX_TURN_RATE_RATIO = 10.0
"""Largest ratio between a gyroscope and the slope of the yaw before their units are doubted."""


def can_read(source: Path) -> bool:
    """Return whether a source is a CSV file with all columns of a table of this package."""
    if not source.is_file() or source.suffix.lower() != ".csv":
        return False
    return read_column_map(NANOBENCH_TABLE).names <= set(_parse_header(source)[0])


def _parse_header(path: Path) -> tuple[list[str], str]:
    """Parse the names of the columns, and their separator."""
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as stream:
        first = stream.readline(1 << 16)
    separator = max(SEPARATORS, key=first.count)
    names = next(csv.reader([first], delimiter=separator), [])
    return [name.strip() for name in names], separator


def load_content(source: Path, options: Options) -> Content:
    """Load the samples of the log of a robot, or of one per file of a folder.

    Parameters
    ----------
    source
        The file or folder.
    options
        ``columns``, the table (default: NanoBench's); ``robot`` of a single file; ``names`` of
        those of a folder.

    Raises
    ------
    SourceError
        If the table is wrong, a column is missing, or a cell is no number: names file and line.
    """
    path = options.columns or NANOBENCH_TABLE
    table = read_column_map(BUILTIN_TABLES.get(str(path), path))
    files = {options.robot: source}
    if source.is_dir():
        paths = sorted(p for p in source.iterdir() if p.suffix.lower() == ".csv")
        files = {options.names.get(p.stem, p.stem): p for p in paths}
    if not files:
        raise SourceError(f"no CSV file in {source}. Pass a folder with one per robot")
    return build_content(s for n, p in files.items() for s in _iter_streams(n, p, table))


def _iter_streams(robot: str, path: Path, table: ColumnMap) -> Iterator[SampleStream]:
    time_ns, cells = _load_columns(path, table)
    yield log_variables.build_raw_stream(robot, LogBlock("columns", time_ns, cells))
    values = {key: cells[c.name] * c.scale for key, c in table.columns.items() if key != "time"}
    logged = {
        CRAZYFLIE_VARIABLES[k][0]: v * CRAZYFLIE_VARIABLES[k][1]
        for k, v in values.items()
        if k in CRAZYFLIE_VARIABLES
    }
    block = LogBlock("columns", time_ns, logged)
    attitude = find_attitude([block])
    _warn_about_units(path, time_ns, values, attitude)
    if "vx" in values:
        frame = table.columns["vx"].frame
        logged |= _rotate_to_world(path, time_ns, values, frame, attitude)
    yield from log_variables.derive_streams(robot, [block], {}, path)
    for peer, column in table.ranges.items():
        range_m = cells[column.name] * column.scale
        usable = (range_m > 0) & (range_m < log_variables.MAX_RANGE_M)
        if refused := int((np.isfinite(range_m) & ~usable).sum()):
            say(f"{path}: {refused} ranges to {peer} left out: not over 0 and under 60 m")
        yield flight.iter_ranges(robot, peer, time_ns[usable], range_m[usable])


def _load_columns(path: Path, table: ColumnMap) -> tuple[Times, dict[str, Array]]:
    """Load the times, and every numeric column, NaN where a cell is empty."""
    names, separator = _parse_header(path)
    if missing := sorted(table.names - set(names)):
        raise SourceError(f"{path}:1: no column {', '.join(missing)}. Fix the table of columns")
    if len(set(names)) < len(names):
        raise SourceError(f"{path}:1: a column appears twice. Rename one")
    rows = _parse_rows(path, separator, len(names))
    time = table.columns["time"]
    at = names.index(time.name)
    moments = np.array(
        [_parse_time_ns(path, line, row[at], time.scale) for line, row in rows], np.int64
    )
    order = np.argsort(moments, kind="stable")
    if (np.diff(moments) < 0).any():
        say(f"{path}: its lines are not in time order; sorted")
    return moments[order], {
        name: values[order]
        for k, name in enumerate(names)
        if (values := _parse_numbers(path, [(n, row[k]) for n, row in rows], name, table))
        is not None
    }


def _parse_rows(path: Path, separator: str, cells: int) -> list[tuple[int, list[str]]]:
    """Parse the line number and cells of every row below the header, with equally many cells."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.reader(stream, delimiter=separator)
            next(reader)
            rows = [(reader.line_num, row) for row in reader if row]
    except (OSError, UnicodeDecodeError, csv.Error) as e:
        raise SourceError(f"{path} cannot be read as CSV: {e}. Pass another file") from None
    if rows and len(rows[-1][1]) < cells:
        say(f"{path}: its last line is cut short; left out")
        rows.pop()
    if not rows:
        raise SourceError(f"{path} has no rows. Pass another file")
    for line, row in rows:
        if len(row) != cells:
            raise SourceError(f"{path}:{line}: {len(row)} cells, not {cells}. Fix the line")
    return rows


def _parse_time_ns(path: Path, line: int, cell: str, scale: float) -> int:
    """Parse whole nanoseconds exactly: a float has too few digits for those since 1970."""
    try:
        time_ns = int((Decimal(cell.strip()) * Decimal(scale)).to_integral_value())
    except (InvalidOperation, ValueError, OverflowError):
        raise SourceError(f"{path}:{line}: {cell!r} is no time. Fix the line") from None
    if not 0 <= time_ns < 1 << 63:
        raise SourceError(f"{path}:{line}: time {cell} is before 1970 or after 2262. Fix its unit")
    return time_ns


def _parse_numbers(
    path: Path, cells: Sequence[tuple[int, str]], name: str, table: ColumnMap
) -> Array | None:
    """Parse a column; None for a text column that the table does not use."""
    values = np.full(len(cells), np.nan)
    for k, (line, cell) in enumerate(cells):
        try:
            values[k] = float(cell) if cell.strip() else np.nan
        except ValueError:
            if name not in table.names:
                return None
            raise SourceError(f"{path}:{line}: {name} is {cell!r}, no number. Fix it") from None
    return values


def _rotate_to_world(
    path: Path, time_ns: Times, values: Mapping[str, Array], frame: str, attitude: TimeSeries | None
) -> dict[str, Array]:
    """Rotate velocity to the frame in which yaw is measured, as the Crazyflie logs it."""
    v = [values[name] for name in ("vx", "vy", "vz") if name in values]
    if frame != "world":
        if attitude is None or (frame == "body" and len(v) < 3):
            wanted = "[vz], [roll], [pitch] and [yaw]" if frame == "body" else "an attitude"
            raise SourceError(f"{path}: velocity in frame {frame} needs {wanted} in the table")
        roll, pitch, yaw = attitude.interpolate(time_ns).T
        if frame == "body":
            v = _rotate_to_horizontal(v, roll, pitch)
        c, s = np.cos(yaw), np.sin(yaw)
        v = [c * v[0] - s * v[1], s * v[0] + c * v[1], *v[2:]]
    return dict(zip(("stateEstimate.vx", "stateEstimate.vy", "stateEstimate.vz"), v, strict=False))


def _rotate_to_horizontal(v: Sequence[Array], roll: Array, pitch: Array) -> list[Array]:
    """Rotate a velocity from the body frame to the horizontal one: Ry(pitch) Rx(roll)."""
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    left, up = cr * v[1] - sr * v[2], sr * v[1] + cr * v[2]
    return [cp * v[0] + sp * up, left, -sp * v[0] + cp * up]


def _warn_about_units(
    path: Path, time_ns: Times, values: Mapping[str, Array], attitude: TimeSeries | None
) -> None:
    """Warn about units that cannot be right."""
    for name in ("roll", "pitch"):
        most = float(np.nanmax(np.abs(values.get(name, np.zeros(1)))))
        if most > MAX_TILT_RAD:
            say(f"{path}: {name} reaches {most:.0f} rad. Is its unit deg?")
    gyro = values.get("gyro_z", values.get("yaw_rate"))
    if gyro is None or attitude is None or len(time_ns) < 3:
        return
    slope = np.gradient(attitude.interpolate(time_ns)[:, 2], np.maximum(np.arange(len(time_ns)), 0))
    step_s = float(np.median(np.diff(time_ns))) * 1e-9
    told, seen = (float(np.nanpercentile(np.abs(x), 90)) for x in (gyro, slope / max(step_s, 1e-9)))
    if seen > 0 and told > MAX_TURN_RATE_RATIO * max(seen, 0.05):
        say(f"{path}: turning rates are {told / seen:.0f} times the slope of yaw. Are they deg/s?")
    elif told > 0 and seen > MAX_TURN_RATE_RATIO * max(told, 0.05):
        say(f"{path}: turning rates are 1/{seen / told:.0f} of the slope of yaw. Are they rad/s?")


FORMAT = Format(
    "columns",
    "a CSV file and a table of its columns",
    can_read,
    load_content,
    SOURCE_OPTIONS | {"columns"},
)
