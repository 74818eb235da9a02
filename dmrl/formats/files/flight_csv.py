"""Flights as a folder of CSV files, one ``<robot>.csv`` per robot, on one clock.

Columns, SI units, angles in radians:

* ``time_s, roll_rad, pitch_rad, yaw_rate_radps, vx_mps, vy_mps, height_m`` are required:
  velocity in the robot's own horizontal frame (x forward, y left, turning with its yaw),
  attitude Rz(yaw) Ry(pitch) Rx(roll), z up, so pitch is positive nose down;
* ``range_<peer>_m`` is optional: UWB distance, empty where there is none; a row with a range may
  leave all of the above but the time empty;
* ``<peer>_x_m, <peer>_y_m, <peer>_z_m`` are optional: true position of the peer in the robot's
  horizontal frame, empty where it is unknown;
* columns of other sensors are optional, named like ``csv`` in dmrl/topics.py.

Images of a robot are in a folder ``<robot>/``, named by their time in nanoseconds, at least
12 digits (zeros in front); ``calibration.toml`` there is its camera.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from dmrl import topics
from dmrl.errors import SourceError
from dmrl.formats.base import Content, Format, Options, refuse_doubles
from dmrl.formats.clocks import Ints
from dmrl.formats.crazyflie.log_variables import build_ranges
from dmrl.formats.files import image_folder
from dmrl.formats.files.labelled_pictures import is_picture
from dmrl.formats.files.pictures import PICTURE_OPTIONS
from dmrl.formats.files.text_table import read_names, read_table
from dmrl.geometry.frames import Array
from dmrl.samples import flight
from dmrl.samples.flight import LOG_COLUMNS, merge_by_time
from dmrl.samples.sample import Sample
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import say
from dmrl.topics import Topic

TIME_COLUMN = "time_s"
REQUIRED_COLUMNS = (TIME_COLUMN, *LOG_COLUMNS)
MIN_GAP_S = 1.0
OWN_SENSOR_COLUMNS = {field for row in topics.OWN_SENSORS for field in row.csv}
OTHER_SENSORS = tuple(
    row
    for row in topics.SENSORS
    if row.csv and row.pattern != topics.RANGE and not set(row.csv) <= set(LOG_COLUMNS)
)
"""Sensors whose columns need no special rule."""


@dataclass(frozen=True, slots=True)
class CsvLog:
    """One CSV file: path, (N,) times, and (N,) columns with NaN for empty cells."""

    path: Path
    time_ns: Ints
    columns: dict[str, Array]

    @property
    def time_s(self) -> Array:
        """(N,) times, seconds."""
        return np.asarray(self.time_ns * 1e-9)

    @property
    def robot(self) -> str:
        """Robot of the file."""
        return self.path.stem

    @property
    def range_peers(self) -> list[str]:
        """Peers to which it has ranges."""
        return [
            name[6:-2]
            for name in self.columns
            if name.startswith("range_") and name[-2:] == "_m" and name not in OWN_SENSOR_COLUMNS
        ]

    @property
    def truth_peers(self) -> list[str]:
        """Peers of which it has true positions."""
        return [
            name[:-4]
            for name in self.columns
            if name.endswith("_x_m")
            and all(f"{name[:-4]}_{axis}_m" in self.columns for axis in "yz")
        ]


def can_read(source: Path) -> bool:
    """Return whether a folder has a CSV file whose first column is ``time_s``."""
    return source.is_dir() and any(
        read_names(path, REQUIRED_COLUMNS)[:1] == [TIME_COLUMN] for path in source.glob("*.csv")
    )


def load_content(source: Path, options: Options | None = None) -> Content:
    """Load the samples of a flight, in time order. Reports suspicious values on stderr.

    Parameters
    ----------
    source
        The folder.
    options
        ``names`` of robots; ``camera`` and ``size_px`` of the images.

    Raises
    ------
    SourceError
        If a column is missing, no row can be used, time goes back, or two robots share no time:
        names the file, and the line.
    """
    paths = sorted(source.glob("*.csv")) if source.is_dir() else []
    if not paths:
        raise SourceError(f"no <robot>.csv in {source}. Pass a folder with a file per robot")
    logs = [read_log(path) for path in paths]
    _check_overlap(logs)
    options = options or Options()
    if not any((source / log.robot).is_dir() for log in logs):
        for name in ("camera", "size_px"):
            options.refuse(name, f"has no effect: {source} has no folder of pictures of a robot")
    refuse_doubles(topics.ATTITUDE(options.names.get(log.robot, log.robot)) for log in logs)
    streams = [stream for log in logs for stream in _iter_streams(log, options.names)]
    streams += [
        stream for log in logs for stream in _iter_image_streams(source / log.robot, options)
    ]
    return Content(merge_by_time(streams))


def read_log(path: Path) -> CsvLog:
    """Read the file of one robot. Rows that cannot be used are left out and counted.

    Raises
    ------
    SourceError
        If a column is missing, no row can be used, or time goes back.
    """
    text = read_table(path, REQUIRED_COLUMNS)
    if missing := [name for name in REQUIRED_COLUMNS if name not in text.columns]:
        raise SourceError(f"{path} has no column {', '.join(missing)}. Add it, in SI units")
    text, time_ns = text.order_by_time(TIME_COLUMN, 1e9)
    columns = {name: text.parse_numbers(name, used=name != TIME_COLUMN) for name in text.columns}
    held = {name: x for name, x in columns.items() if x is not None}
    known = np.isfinite([held[n] if n in held else time_ns * np.nan for n in LOG_COLUMNS])
    others = np.isfinite([x for name, x in held.items() if name not in REQUIRED_COLUMNS])
    good = known.all(axis=0)
    used = good | (~known.any(axis=0) & others.any(axis=0))  # a row of its own for a range
    if lost := int((~used).sum()):
        row = int(np.argmin(used))
        name = LOG_COLUMNS[int(np.argmin(known[:, row]))]
        leave_out(f"rows without a number for {name} or another", text.name_row(row), lost)
    if good.sum() < 2:
        raise SourceError(f"{path} has fewer than two rows. Add rows, or remove it")
    log = CsvLog(path, time_ns[used], {name: x[used] for name, x in held.items()})
    _check_log(log)
    _report_unused(log, text.columns)
    return log


def _report_unused(log: CsvLog, names: Iterable[str]) -> None:
    """Count the columns of a file that become nothing, such as ``range_cf2`` without its unit."""
    used = {*REQUIRED_COLUMNS, "yaw_rad", *(f"range_{peer}_m" for peer in log.range_peers)}
    used |= {f"{peer}_{axis}_m" for peer in log.truth_peers for axis in "xyz"}
    sensors = [held for row in OTHER_SENSORS for _, held in _iter_sensor_columns(row, log)]
    taken = {id(column) for held in sensors for column in held.values()}
    unused = [n for n in names if n not in used and id(log.columns.get(n)) not in taken]
    if unused:
        leave_out("columns of no known name", f"{log.path}: {unused[0]}", len(unused))


def _check_log(log: CsvLog) -> None:
    steps = np.diff(log.time_s)
    if (gaps := np.flatnonzero(steps > MIN_GAP_S)).size:
        at = log.time_s[gaps[0]]
        say(f"{log.path}: {gaps.size} gaps, the first of {steps[gaps[0]]:.1f} s after {at:.3f} s")


def _check_overlap(logs: list[CsvLog]) -> None:
    for one, other in combinations(logs, 2):
        apart = max(one.time_s[0], other.time_s[0]) - min(one.time_s[-1], other.time_s[-1])
        if apart > 0:
            raise SourceError(
                f"{one.path} and {other.path} share no time: {apart:.0f} s lie between them. "
                "Put both on one clock"
            )
    known = {log.robot for log in logs}
    for log in logs:
        for peer in log.range_peers:
            if peer not in known:
                say(f"{log.path} has ranges to {peer}, but there is no {peer}.csv beside it")


def _iter_streams(log: CsvLog, names: Mapping[str, str]) -> Iterator[Iterable[Sample]]:
    def name(robot: str) -> str:
        return names.get(robot, robot)

    own, time_ns = name(log.robot), log.time_ns
    state = np.isfinite(log.columns[LOG_COLUMNS[0]])
    yield from flight.build_robot_log(
        own, time_ns[state], {name: x[state] for name, x in log.columns.items()}
    )
    for peer in log.range_peers:
        range_m = log.columns[f"range_{peer}_m"]
        if name(peer) == own:
            leave_out(f"ranges of {own} to itself", log.path, int(np.isfinite(range_m).sum()))
            continue
        yield build_ranges(own, name(peer), time_ns, range_m, log.path)
    for peer in log.truth_peers:
        xyz = np.stack([log.columns[f"{peer}_{axis}_m"] for axis in "xyz"], axis=1)
        known = np.flatnonzero(np.isfinite(xyz).all(axis=1))
        yield flight.build_truth(own, name(peer), time_ns[known], xyz[known])
    for row in OTHER_SENSORS:
        for peer, columns in _iter_sensor_columns(row, log):
            who = {"robot": own} | ({"peer": name(peer)} if peer else {})
            topic = topics.format_topic(row.pattern, **who)
            yield flight.build_sensor(topic, row.message, time_ns, columns)


def _iter_sensor_columns(row: Topic, log: CsvLog) -> Iterator[tuple[str, dict[str, Array]]]:
    """Yield the columns of a sensor by the fields of its message, for each peer that has them."""
    if not row.is_pairwise:
        peers = [""]
    else:
        before, _, unit = row.csv[0].rpartition("_")
        found = re.compile(f"{before}_(.+)_{unit}")
        others = (name for name in log.columns if name not in OWN_SENSOR_COLUMNS)
        peers = [m[1] for name in others if (m := found.fullmatch(name))]
    for peer in peers:
        named = {
            field: f"_{peer}_".join(field.rsplit("_", 1)) if peer else field for field in row.csv
        }
        if all(name in log.columns for name in named.values()):
            yield peer, {field: log.columns[name] for field, name in named.items()}


def _iter_image_streams(folder: Path, options: Options) -> Iterator[Iterator[Sample]]:
    if not folder.is_dir():
        return
    for path in sorted(folder.iterdir()):
        named = path.stem.isdecimal() and len(path.stem) >= image_folder.MIN_TIME_DIGITS
        if is_picture(path) and not named:
            raise SourceError(
                f"{path} is not named by its time in nanoseconds, {image_folder.MIN_TIME_DIGITS} "
                "digits or more. Rename it"
            )
    robot = options.names.get(folder.name, folder.name)
    own = replace(options, robot=robot, names={})
    yield image_folder.load_content(folder, own).samples


FORMAT = Format(
    "csv", "a folder of flight logs", can_read, load_content, PICTURE_OPTIONS - {"robot"}
)
