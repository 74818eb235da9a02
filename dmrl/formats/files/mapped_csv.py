"""Foreign CSV files, read by a table that defines their columns (`column_map`).

A file is the log of one robot, or of several, if the table says how columns or rows name them; a
folder has one file per robot, named after it. Every column is kept unchanged, on
``/<robot>/log/columns``. Flights of NanoBench are recognised by their columns.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from dmrl import topics
from dmrl.errors import SourceError
from dmrl.formats.base import SOURCE_OPTIONS, Content, Format, Options, add_names, build_content
from dmrl.formats.clocks import find_new_values
from dmrl.formats.crazyflie import log_variables
from dmrl.formats.crazyflie.log_block import LogBlock, TimeSeries
from dmrl.formats.crazyflie.log_variables import SampleStream
from dmrl.formats.crazyflie.state import find_attitude
from dmrl.formats.files.column_map import (
    ANGLE_UNITS,
    LENGTH_UNITS,
    QUANTITIES,
    RATE_UNITS,
    Column,
    read_column_map,
)
from dmrl.formats.files.robot_columns import RobotLog, read_robot_logs
from dmrl.formats.files.text_table import TABLE_SUFFIXES, TextTable, read_names
from dmrl.geometry.frames import Array
from dmrl.samples.flight import Times, integrate_yaw
from dmrl.samples.sample import Columns
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import say

NANOBENCH_TABLE = Path(__file__).parent / "nanobench.toml"
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
MAX_TURN_RATE_RATIO = 10.0
"""Largest ratio between a gyroscope and the slope of the yaw before their units are doubted."""
UNIT_NORM_ERROR = 0.1
"""Largest difference from 1 of the length of a quaternion."""
UNIT_IN_NAME = re.compile(r".*[\s_\[(/]([A-Za-zµ°]+(?:/s)?)[\])]?")
UNIT_WORDS = {"°": "deg", "degrees": "deg", "radians": "rad", "µs": "us", "°/s": "deg/s"}
"""Units as headers write them, and as tables do."""


def can_read(source: Path) -> bool:
    """Return whether a source is a CSV file with all columns of a table of this package."""
    if not source.is_file() or source.suffix.lower() not in TABLE_SUFFIXES:
        return False
    wanted = read_column_map(NANOBENCH_TABLE).names
    return wanted <= set(read_names(source, wanted))


def load_content(source: Path, options: Options) -> Content:
    """Load the samples of the log of a robot, or of several in a file or folder.

    Parameters
    ----------
    source
        The file or folder.
    options
        ``columns``, the table (default: NanoBench's); ``robot`` of a file that names none;
        ``names`` of robots and peers.

    Raises
    ------
    SourceError
        If the table is wrong, a column is missing, or nothing can be used: names file and line.
    """
    path = options.columns or NANOBENCH_TABLE
    table = read_column_map(BUILTIN_TABLES.get(str(path), path))
    files = {options.robot: source}
    if source.is_dir():
        held = [p for p in sorted(source.iterdir()) if p.is_file() and p.name[0] != "."]
        kinds = [[p for p in held if p.suffix.lower() == suffix] for suffix in TABLE_SUFFIXES]
        files = {p.stem: p for p in next(filter(None, kinds), [])}
    if not files:
        raise SourceError(f"no CSV file in {source}. Pass a folder with one per robot")
    logs = read_robot_logs(files, table)
    if source.is_dir() or [log.robot for log in logs] != [options.robot]:
        options.refuse("robot", f"has no effect: {source} names its robots. Use --names")
    options = replace(options, names=add_names(options.names, table.renames))
    return build_content(s for log in logs for s in iter_robot_streams(log, options))


def iter_robot_streams(
    log: RobotLog, options: Options, *, raw: bool = True
) -> Iterator[SampleStream]:
    """Yield the streams of a robot; ``raw``: also every column of numbers as it is."""
    robot, path = options.names.get(log.robot, log.robot), log.text.path
    time = log.columns["time"]
    text, time_ns = log.text.order_by_time(time.name, time.scale)
    used = {column.name for column in (*log.columns.values(), *log.ranges.values())}
    cells = {
        name: column
        for name in text.columns
        if (column := text.parse_numbers(name, used=name in used - {time.name})) is not None
    }
    if raw:
        yield log_variables.build_raw_stream(robot, LogBlock("columns", time_ns, cells))
    values = {
        key: _to_values(key, one, cells, text, len(time_ns))
        for key, one in log.columns.items()
        if key != "time"
    }
    for key, one in (*log.columns.items(), *log.ranges.items()):
        _doubt_header_unit(key, one, text)
    yield from _iter_sensor_streams(robot, path, time_ns, values, log)
    for peer, one in _name_peers(robot, log, options).items():
        range_m = _to_values(f"range.{peer}", one, cells, text, len(time_ns))
        if log.peer_column:
            told = text.columns[log.peer_column]
            mine = [options.names.get(cell.strip(), cell.strip()) == peer for cell in told]
            range_m = np.where(mine, range_m, np.nan)
        yield _build_ranges(robot, peer, time_ns, range_m, one, path)


def _name_peers(robot: str, log: RobotLog, options: Options) -> dict[str, Column]:
    """Return the range to each peer, by its name in the recording.

    Raises
    ------
    SourceError
        If a column would be the range to two peers.
    """
    named = {options.names.get(peer, peer): one for peer, one in log.ranges.items()}
    named.pop(robot, None)
    if not named and log.columns.keys() == {"time"}:
        say(f"{log.text.path}: nothing is of {robot}, which has no range to itself. Try: --robot")
    for one, other in combinations(named, 2) if not log.peer_column else ():
        if named[one].name == named[other].name:
            raise SourceError(
                f"{log.text.path}: {named[one].name} cannot be the range of {robot} to both {one} "
                f"and {other}. Name the column with the peer of each row: [peer]"
            )
    return named


def _to_values(
    key: str, column: Column, cells: Mapping[str, Array], text: TextTable, count: int
) -> Array:
    """Return a quantity in dmrl's unit, NaN where it is not known."""
    if column.value is not None:
        return np.full(count, column.value * column.scale)
    if column.name not in cells:
        cell = text.columns[column.name][0]
        raise SourceError(
            f"{text.name_row(0)}: {column.name} is {cell!r}, and no cell of it is a number. Fix it"
        )
    values = cells[column.name] * column.scale
    if np.isnan(values).all():
        say(f"{text.path}: no row has a value in {column.name}, so there is no {key}")
    infinite = np.flatnonzero(np.isinf(values))
    if len(infinite):
        leave_out(f"infinite values of {key}", text.path, len(infinite))
        values[infinite] = np.nan
    return values


def _doubt_header_unit(key: str, column: Column, text: TextTable) -> None:
    """Report a unit in the header that is not the one in the table."""
    in_name = UNIT_IN_NAME.fullmatch(column.name)
    told = text.units.get(column.name) or (in_name[1] if in_name else "")
    told = UNIT_WORDS.get(told, told)
    if told in QUANTITIES.get(key, LENGTH_UNITS) and column.unit and told != column.unit:
        say(f"{text.path}: the header has {column.name} in {told}, the table in {column.unit}")


def _build_ranges(
    robot: str, peer: str, time_ns: Times, range_m: Array, column: Column, path: Path
) -> SampleStream:
    """Build the stream of the ranges to a peer: possible ones, each measurement once."""
    if column.held is not False:
        usable = (range_m > 0) & (range_m < log_variables.MAX_RANGE_M)
        polled = column.held is True
        held = usable & ~find_new_values(np.where(usable, range_m, np.nan), polled=polled)
        if not polled:
            reason = f"ranges to {peer} that repeat the last one, which the log holds"
            leave_out(f"{reason} (held in the table decides it)", path, int(held.sum()))
        range_m = np.where(held, np.nan, range_m)
    return log_variables.build_ranges(robot, peer, time_ns, range_m, path)


def _iter_sensor_streams(
    robot: str, path: Path, time_ns: Times, values: dict[str, Array], log: RobotLog
) -> Iterator[SampleStream]:
    """Yield attitude, velocity, height and poses."""
    has_yaw = "yaw" in values or "qw" in values
    _complete_attitude(path, time_ns, values)
    _drop_bad_quaternions(path, values)
    logged = {
        CRAZYFLIE_VARIABLES[k][0]: v * CRAZYFLIE_VARIABLES[k][1]
        for k, v in values.items()
        if k in CRAZYFLIE_VARIABLES
    }
    block = LogBlock("columns", time_ns, logged)
    attitude = find_attitude([block])
    if has_yaw:
        _warn_about_turning_rates(path, time_ns, values, attitude)
    if "vx" in values:
        frame = log.columns["vx"].frame
        if frame == "world":
            if not has_yaw:
                raise SourceError(
                    f"{path}: velocity in frame world needs [yaw] or [qw] in the table, measured "
                    'in that frame. If it turns with the robot: frame = "horizontal"'
                )
            names = [name for name in ("vx", "vy", "vz") if name in values]
            logged |= {f"stateEstimate.{name}": values[name] for name in names}
        else:
            yield _build_velocity(robot, path, time_ns, values, frame, attitude)
    yield from log_variables.derive_streams(robot, [block], {}, path)
    lacking = {
        "attitude": attitude is None,
        "velocity": not _has_values(values, "vx"),
        "height": not (_has_values(values, "height") or _has_values(values, "z")),
    }
    if any(lacking.values()) and not all(lacking.values()):
        absent = " and no ".join(name for name, lacks in lacking.items() if lacks)
        say(f"{path}: no {absent}, which dmrl label needs")


def _has_values(values: Mapping[str, Array], key: str) -> bool:
    return key in values and bool(np.isfinite(values[key]).any())


def _complete_attitude(path: Path, time_ns: Times, values: dict[str, Array]) -> None:
    """Add a yaw that is the integral of the yaw rate, and level roll and pitch, if they lack."""
    rate = values.get("yaw_rate", values.get("gyro_z"))
    if "qw" in values or rate is None:
        return
    if "roll" not in values:
        say(f"{path}: no roll and pitch in the table: the robot is taken as level")
        values |= {"roll": np.zeros(len(time_ns)), "pitch": np.zeros(len(time_ns))}
    if "yaw" not in values and np.isfinite(rate).any():
        values["yaw"] = integrate_yaw(time_ns, rate)


def _drop_bad_quaternions(path: Path, values: dict[str, Array]) -> None:
    """Leave out quaternions that are not of length 1."""
    for before in ("", "true_"):
        names = [f"{before}{name}" for name in ("qx", "qy", "qz", "qw")]
        if names[0] not in values:
            continue
        norm = np.linalg.norm([values[name] for name in names], axis=0)
        bad = np.isfinite(norm) & (np.abs(norm - 1) >= UNIT_NORM_ERROR)
        leave_out(f"quaternions of {names[0]} that are not of length 1", path, int(bad.sum()))
        for name in names:
            values[name] = np.where(bad, np.nan, values[name])


def _build_velocity(
    robot: str,
    path: Path,
    time_ns: Times,
    values: Mapping[str, Array],
    frame: str,
    attitude: TimeSeries | None,
) -> SampleStream:
    """Build the stream of velocities in the robot's horizontal frame, from that or the body's."""
    v = [values[name] for name in ("vx", "vy", "vz") if name in values]
    if frame == "body":
        if attitude is None or len(v) < 3:
            raise SourceError(
                f"{path}: velocity in frame body needs [vz], [roll] and [pitch] in the table"
            )
        roll, pitch, _ = attitude.interpolate(time_ns).T
        v = _rotate_to_horizontal(v, roll, pitch)
    known = np.isfinite(v).all(axis=0)
    names = ("vx_mps", "vy_mps", "vz_mps")
    fields = {name: part[known] for name, part in zip(names, v, strict=False)}
    return Columns(topics.VELOCITY(robot), "Velocity", time_ns[known], fields)


def _rotate_to_horizontal(v: Sequence[Array], roll: Array, pitch: Array) -> list[Array]:
    """Rotate a velocity from the body frame to the horizontal one: Ry(pitch) Rx(roll)."""
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    left, up = cr * v[1] - sr * v[2], sr * v[1] + cr * v[2]
    return [cp * v[0] + sp * up, left, -sp * v[0] + cp * up]


def _warn_about_turning_rates(
    path: Path, time_ns: Times, values: Mapping[str, Array], attitude: TimeSeries | None
) -> None:
    """Warn about turning rates whose unit cannot be right."""
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
