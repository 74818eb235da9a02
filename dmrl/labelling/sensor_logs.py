"""What a recording says of every robot and pair, as the estimators want it.

What cannot be used is left out with a line that says so.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from dmrl import topics
from dmrl.estimation.model.pair import RATE_HZ, Array, Pair, Track, usable_ranges
from dmrl.estimation.signals.sensor_tracks import Signals, track
from dmrl.labelling.sensor_file import Sensors
from dmrl.recording import Contents
from dmrl.recording.checks.unit_checks import unit_doubts

LEAST_S = 5.0
"""Shortest common stretch of two logs that is worth estimating."""
LEAST_RANGES = 20
MOST = 1e6
"""No sensor says so many metres, radians or metres per second; their squares are no numbers."""
SENSED = (topics.ATTITUDE, topics.VELOCITY, topics.HEIGHT, topics.RANGE)
"""What positions are estimated from."""
NOTHING = Sensors()


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
        """When the last of the sensors begins, seconds."""
        return max(float(s[0][0]) for s in (self.attitude, self.velocity, self.height))

    @property
    def end_s(self) -> float:
        """When the first of the sensors ends, seconds."""
        return min(float(s[0][-1]) for s in (self.attitude, self.velocity, self.height))

    def track(self, grid_s: Array) -> Track:
        """The sensors on a time grid."""
        times, attitude = self.attitude
        return track((times, attitude[:, 2:]), self.velocity, self.height, grid_s)


@dataclass(frozen=True, slots=True)
class Logs:
    """Everything that can be estimated from.

    Parameters
    ----------
    start_ns
        Log time of second zero.
    robots
        By name.
    pairs
        By (robot, peer) in the order of their names; both directions' ranges together.
    flying
        Robots with a log of any kind, in a pair or not: they may be in view. (What only stands
        in ranges may be an anchor.)
    warnings
        One line for each thing that was left out or looks wrong.
    """

    start_ns: int
    robots: dict[str, RobotLog]
    pairs: dict[tuple[str, str], Pair]
    flying: frozenset[str]
    warnings: list[str]


def read_logs(held: Contents, range_offset_m: float = 0.0, known: Sensors = NOTHING) -> Logs:
    """The logs of a recording.

    Parameters
    ----------
    held
        A recording, best with what `SENSED` names.
    range_offset_m
        Subtracted from every range.
    known
        What is known of the sensors, and taken out of what they say.

    Raises
    ------
    RecordingError
        If a topic carries another message, or the file is damaged.
    """
    warnings: list[str] = []
    links = [n for t in held.topics if (n := topics.names(topics.RANGE, t))]
    names = sorted({name for link in links for name in link.values()})
    robots = {}
    for name in names:
        log = _robot(held, name, known, warnings)
        if log is not None:
            robots[name] = log
    pairs = {}
    for one, other in combinations(names, 2):
        both_ways = topics.uwb_range(one, other), topics.uwb_range(other, one)
        found = [
            _signals(held, topic, ("range_m",), warnings)
            for topic in both_ways
            if topic in held.topics
        ]
        ranges = [
            (r[0], known.ranges((one, other), r[1] - range_offset_m))
            for r in found
            if r is not None
        ]
        pair = _pair(robots, (one, other), ranges, known, warnings)
        if pair is not None:
            pairs[one, other] = pair
    flying = _flying(held)
    paired = {name for pair in pairs for name in pair}
    warnings += [
        f"{name}: it has a log but no position, so no image counts as one without it"
        for name in sorted(flying - paired if pairs else ())
    ]
    return Logs(held.start_ns, robots, pairs, flying, warnings)


def _flying(held: Contents) -> frozenset[str]:
    """Robots with a log of their own. They may be in view, also where no position is known."""
    kinds = [row.pattern for row in topics.OWN_SENSORS]
    return frozenset(name for kind in kinds for name in topics.robots(list(held.topics), kind))


def _robot(held: Contents, name: str, known: Sensors, warnings: list[str]) -> RobotLog | None:
    wanted = {
        topics.attitude(name): ("roll_rad", "pitch_rad", "yaw_rate_radps"),
        topics.velocity(name): ("vx_mps", "vy_mps"),
        topics.height(name): ("height_m",),
    }
    if missing := [topic for topic in wanted if topic not in held.topics]:
        warnings.append(f"{name}: no {' and no '.join(missing)}; its pairs are left out")
        return None
    signals = [_signals(held, t, fields, warnings) for t, fields in wanted.items()]
    attitude, velocity, height = signals
    if attitude is None or velocity is None or height is None:
        return None
    attitude[1][:, 2] = known.yaw_rate(name, attitude[1][:, 2])
    return RobotLog(attitude, (velocity[0], known.velocity(name, velocity[1])), height)


def _signals(
    held: Contents, topic: str, fields: tuple[str, ...], warnings: list[str]
) -> Signals | None:
    """Samples of a topic that can be computed with; None, with a warning, where there is none."""
    table = held.table(topic, fields)
    warnings += [f"{topic}: {doubt}" for doubt in unit_doubts(topic, table)]
    values = np.column_stack([table[field].to_numpy() for field in fields]).astype(float)
    time_ns, received_ns = (table[c].to_numpy() for c in ("log_time", "publish_time"))
    good = np.asarray((abs(values) < MOST).all(axis=1))
    if bad := int((~good).sum()):
        warnings.append(
            f"{topic}: {bad} of {len(good)} samples are not finite, or {MOST:g} and more; left out"
        )
    # Messages are in log-time order, but the order they came in tells of a clock that was set back.
    if back := int((np.diff(received_ns) < -1_000_000_000).sum()):
        warnings.append(f"{topic}: its clock goes back {back} times; samples overlap there")
    if not good.any():
        warnings.append(f"{topic}: nothing to use; its pairs are left out")
        return None
    return (time_ns[good] - held.start_ns) * 1e-9, values[good]


def _pair(
    robots: dict[str, RobotLog],
    names: tuple[str, str],
    ranges: list[Signals],
    known: Sensors,
    warnings: list[str],
) -> Pair | None:
    """A pair on its common time grid; None, with a warning, where it cannot be used."""
    name = "-".join(names)
    if not ranges or not all(robot in robots for robot in names):
        return None
    logs = [robots[robot] for robot in names]
    start_s, end_s = max(log.start_s for log in logs), min(log.end_s for log in logs)
    if end_s - start_s < LEAST_S:
        warnings.append(
            f"{name}: their logs share {max(end_s - start_s, 0.0):.1f} s, under {LEAST_S:g} s; "
            "left out. Do their clocks agree?"
        )
        return None
    measured = _ranges_within(name, ranges, start_s, end_s, warnings)
    if measured is None:
        return None
    grid_s = start_s + np.arange(int((end_s - start_s) * RATE_HZ) + 1) / RATE_HZ
    tracks = [log.track(grid_s) for log in logs]
    for robot, sensed in zip(names, tracks, strict=True):
        if sensed.gap.any():
            silent_s = sensed.gap.sum() / RATE_HZ
            warnings.append(f"{name}: {robot} is silent for {silent_s:.1f} s; unconverged there")
    time_s, range_m = measured
    on_grid = time_s <= grid_s[-1]  # which ends up to a step before the logs do
    ranged = time_s[on_grid], range_m[on_grid]
    return Pair(grid_s, tracks[0], tracks[1], *ranged, known_std=known.std(names))


def _ranges_within(
    name: str, ranges: list[Signals], start_s: float, end_s: float, warnings: list[str]
) -> tuple[Array, Array] | None:
    """Times and usable ranges of a pair, in order; None, with a warning, where they are too few."""
    # Both directions measure the same distance, so they count as one series.
    time_s = np.concatenate([r[0] for r in ranges])
    range_m = np.concatenate([r[1][:, 0] for r in ranges])
    order = np.argsort(time_s, kind="stable")
    time_s, range_m = time_s[order], range_m[order]
    good = usable_ranges(time_s, range_m)
    if bad := int((~good).sum()):
        warnings.append(f"{name}: {bad} of {len(good)} ranges are not in (0, 60] m; left out")
    good &= (time_s >= start_s) & (time_s <= end_s)
    if good.sum() < LEAST_RANGES:
        warnings.append(f"{name}: {good.sum()} usable ranges, under {LEAST_RANGES}; left out")
        return None
    return time_s[good], range_m[good]
