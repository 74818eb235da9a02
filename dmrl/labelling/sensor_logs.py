"""Sensor logs of every robot and pair, in the form that the estimators take.

Unusable samples are left out with a warning.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pyarrow as pa

from dmrl import topics
from dmrl.estimation.model.pair import (
    GRID_RATE_HZ,
    MAX_RANGE_M,
    Array,
    Pair,
    SensorTrack,
    usable_ranges,
)
from dmrl.estimation.signals.sensor_tracks import Signals, build_track
from dmrl.labelling.flight_log import SENSOR_FIELDS, FlightLog, RobotPair, Samples
from dmrl.labelling.sensor_file import SensorConstants
from dmrl.recording.checks.unit_checks import check_units
from dmrl.recording.protobuf.arrow_arrays import to_arrow
from dmrl.terminal.left_out import leave_out

MIN_DURATION_S = 5.0
"""Shortest common stretch of two logs that is estimated, seconds."""
MIN_RANGES = 20
"""Fewest ranges of a pair that is estimated."""
MAX_VALUE = 1e6
"""Largest value of a sensor, metres, radians or metres per second; larger ones overflow squared."""
NO_CONSTANTS = SensorConstants()
SentRanges = tuple[Array, Array, bool]
"""Times, ranges, and whether the second robot of the pair measured them."""


@dataclass(frozen=True, slots=True)
class RobotLog:
    """One robot's own sensors, as logged.

    Parameters
    ----------
    attitude
        Roll, pitch (rad), yaw rate (rad/s).
    velocity
        Forward, left, m/s.
    height
        Metres.
    """

    attitude: Signals
    velocity: Signals
    height: Signals

    @property
    def start_s(self) -> float:
        """Return when the last of the sensors begins, seconds."""
        return max(float(s[0][0]) for s in (self.attitude, self.velocity, self.height))

    @property
    def end_s(self) -> float:
        """Return when the first of the sensors ends, seconds."""
        return min(float(s[0][-1]) for s in (self.attitude, self.velocity, self.height))

    def to_track(self, grid_s: Array) -> SensorTrack:
        """Return the sensors on a time grid."""
        times, attitude = self.attitude
        return build_track((times, attitude[:, 2:]), self.velocity, self.height, grid_s)


@dataclass(frozen=True, slots=True)
class SensorLogs:
    """Sensor logs of all robots and pairs that can be estimated.

    Parameters
    ----------
    start_ns
        Log time of second zero.
    robots
        By name.
    pairs
        By (robot, peer) in the order of their names; both directions' ranges together.
    flying
        Robots with a log of any kind, in a pair or not: they may be in view. (A robot that only
        has ranges may be an anchor.)
    warnings
        One line for each sensor that was left out or is suspicious.
    """

    start_ns: int
    robots: dict[str, RobotLog]
    pairs: dict[RobotPair, Pair]
    flying: frozenset[str]
    warnings: list[str]


def build_sensor_logs(
    flight: FlightLog,
    range_offset_m: float = 0.0,
    known: SensorConstants = NO_CONSTANTS,
    *,
    detections: bool = False,
) -> SensorLogs:
    """Return the sensor logs of a flight.

    Parameters
    ----------
    flight
        With the topics `flight_log.SENSOR_TOPICS`.
    range_offset_m
        Subtracted from every range.
    known
        Sensor errors that are removed from the samples.
    detections
        Whether robots with a detector count as a pair without ranges too.
    """
    warnings: list[str] = []
    seeing = set(flight.detections) if detections else set()
    names = sorted(
        {name for link in flight.ranges for name in link}
        | (set(flight.velocity) if seeing else set())
    )
    robots = {}
    for name in names:
        log = _build_robot_log(flight, name, known, warnings)
        if log is not None:
            robots[name] = log
    pairs = {}
    for both in combinations(names, 2):
        ranges = _list_ranges(flight, both, range_offset_m, known, warnings)
        pair = _build_pair(robots, both, ranges, known, warnings, sighted=bool(seeing & {*both}))
        if pair is not None:
            pairs[both] = pair
        elif any(link in flight.ranges for link in (both, both[::-1])):
            leave_out("pairs of robots without the logs that they need", "-".join(both))
    flying = _find_flying(flight)
    paired = {name for pair in pairs for name in pair}
    warnings += [
        f"{name}: it has a log but no position, so no image counts as one without it"
        for name in sorted(flying - paired if pairs else ())
    ]
    return SensorLogs(flight.start_ns, robots, pairs, flying, warnings)


def _list_ranges(
    flight: FlightLog,
    names: RobotPair,
    range_offset_m: float,
    known: SensorConstants,
    warnings: list[str],
) -> list[SentRanges]:
    """Return the ranges of each direction of a pair that has usable ones."""
    out = []
    for link in (names, names[::-1]):
        if link in flight.ranges:
            topic = topics.RANGE(*link)
            found = _to_signals(flight, topics.RANGE, topic, flight.ranges[link], warnings)
            if found is not None:
                range_m = known.correct_ranges(names, found[1] - range_offset_m)
                out.append((found[0], range_m, link != names))
    return out


def _find_flying(flight: FlightLog) -> frozenset[str]:
    """Return the robots with a log of their own. They may be in view even without a position."""
    kinds = [row.pattern for row in topics.OWN_SENSORS]
    return frozenset(
        name for kind in kinds for name in topics.list_robots(list(flight.topics), kind)
    )


def _build_robot_log(
    flight: FlightLog, name: str, known: SensorConstants, warnings: list[str]
) -> RobotLog | None:
    found = {
        topics.ATTITUDE: flight.attitude.get(name),
        topics.VELOCITY: flight.velocity.get(name),
        topics.HEIGHT: flight.height.get(name),
    }
    if missing := [p.format(robot=name) for p, samples in found.items() if samples is None]:
        warnings.append(f"{name}: no {' and no '.join(missing)}; its pairs are left out")
        return None
    attitude, velocity, height = (
        _to_signals(flight, pattern, pattern.format(robot=name), samples, warnings)
        for pattern, samples in found.items()
        if samples is not None
    )
    if attitude is None or velocity is None or height is None:
        return None
    if name in known.robots:
        yaw_rate = known.correct_yaw_rate(name, attitude[1][:, 2])
        attitude = attitude[0], np.column_stack([attitude[1][:, :2], yaw_rate])
        velocity = velocity[0], known.correct_velocity(name, velocity[1])
    return RobotLog(attitude, velocity, height)


def _to_signals(
    flight: FlightLog, pattern: str, topic: str, samples: Samples, warnings: list[str]
) -> Signals | None:
    """Return the usable samples of a topic; None, with a warning, if there are none."""
    values = samples.values
    columns = map(to_arrow, values.T)
    table = pa.table(dict(zip(SENSOR_FIELDS[pattern], columns, strict=True)))
    warnings += [f"{topic}: {doubt}" for doubt in check_units(topic, table)]
    good = np.asarray((abs(values) < MAX_VALUE).all(axis=1))
    if bad := int((~good).sum()):
        reason = f"samples of {topic} that are not finite, or {MAX_VALUE:g} and more"
        leave_out(reason, flight.path, bad)
    if samples.set_back:
        warnings.append(
            f"{topic}: its clock goes back {samples.set_back} times; samples overlap there"
        )
    if not good.any():
        warnings.append(f"{topic}: nothing to use; its pairs are left out")
        return None
    if good.all():  # the arrays of long flights are shared
        return flight.to_seconds(samples.time_ns), values
    return flight.to_seconds(samples.time_ns[good]), values[good]


def _build_pair(
    robots: dict[str, RobotLog],
    names: RobotPair,
    ranges: list[SentRanges],
    known: SensorConstants,
    warnings: list[str],
    *,
    sighted: bool,
) -> Pair | None:
    """Return a pair on its common time grid; None, with a warning, if it cannot be used."""
    name = "-".join(names)
    if not (ranges or sighted) or not all(robot in robots for robot in names):
        return None
    logs = [robots[robot] for robot in names]
    start_s, end_s = max(log.start_s for log in logs), min(log.end_s for log in logs)
    if end_s - start_s < MIN_DURATION_S:
        warnings.append(
            f"{name}: their logs share {max(end_s - start_s, 0.0):.1f} s, under "
            f"{MIN_DURATION_S:g} s; left out. Do their clocks agree?"
        )
        return None
    none = np.zeros(0)
    measured = _select_ranges(name, ranges, start_s, end_s, warnings) if ranges else None
    if measured is None and not sighted:
        return None
    measured = measured or (none, none, none)
    grid_s = start_s + np.arange(int((end_s - start_s) * GRID_RATE_HZ) + 1) / GRID_RATE_HZ
    tracks = [log.to_track(grid_s) for log in logs]
    for robot, one in zip(names, tracks, strict=True):
        if one.dropout.any():
            silent_s = one.dropout.sum() / GRID_RATE_HZ
            warnings.append(f"{name}: {robot} is silent for {silent_s:.1f} s; unconverged there")
    on_grid = measured[0] <= grid_s[-1]  # which ends up to a step before the logs do
    time_s, range_m, sender = (values[on_grid] for values in measured)
    return Pair(
        grid_s, tracks[0], tracks[1], time_s, range_m,
        known_std=known.to_prior_std(names), range_sender=np.asarray(sender, np.int8),
    )  # fmt: skip


def _select_ranges(
    name: str, ranges: list[SentRanges], start_s: float, end_s: float, warnings: list[str]
) -> tuple[Array, Array, Array] | None:
    """Return a pair's usable ranges with their times; None, with a warning, if they are too few."""
    # Both directions measure the same distance, so they form one series.
    time_s = np.concatenate([r[0] for r in ranges])
    range_m = np.concatenate([r[1][:, 0] for r in ranges])
    sender = np.concatenate([np.full(len(r[0]), float(r[2])) for r in ranges])
    order = np.argsort(time_s, kind="stable")
    time_s, range_m, sender = time_s[order], range_m[order], sender[order]
    # Where most are too long, they are in another unit, which the estimator finds.
    positive = range_m[np.isfinite(range_m) & (range_m > 0)]
    far = len(positive) > 0 and np.median(positive) > MAX_RANGE_M
    good = usable_ranges(time_s, range_m, np.inf if far else MAX_RANGE_M)
    if bad := int((~good).sum()):
        leave_out(f"ranges of {name} that are not in (0, 60] m", name, bad)
    good &= (time_s >= start_s) & (time_s <= end_s)
    if good.sum() < MIN_RANGES:
        warnings.append(f"{name}: {good.sum()} usable ranges, under {MIN_RANGES}; left out")
        return None
    return time_s[good], range_m[good], sender[good]
