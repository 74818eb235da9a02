"""Check odometry against poses: signs and frames that contradict the robot's motion.

Wrong units are detected by the size of the values (`unit_checks`). A wrong sign or frame does not
change the size, so measurements are compared with the slope of the poses, at best motion capture.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dmrl import topics
from dmrl.geometry.frames import Array
from dmrl.geometry.rotations import euler_zyx

STEP_S, SLOPE_S = 0.05, 0.3
"""Interval of the compared samples, and window of the slope of a pose, seconds."""
MOST = 20_000
"""Samples kept per topic. The first quarter of an hour is enough."""
LEAST = 100
"""Samples needed for a comparison."""
MOVING_MPS, TURNING_RADPS, TILTED_RAD = 0.1, 0.1, 0.02
"""Root mean square of a motion below which it is not compared, m/s, rad/s and rad."""
UNLIKE, ALIKE = 0.5, 0.8
"""Correlation below which two signals differ, and above which they agree."""
KINDS = {
    topics.VELOCITY: ("vx_mps", "vy_mps"),
    topics.ATTITUDE: ("roll_rad", "pitch_rad", "yaw_rate_radps"),
    topics.POSE: (),
    topics.TRUE_POSE: (),
}
TIED = "or align its clock with the poses': dmrl align --mocap"
Signal = tuple[Array, Array]
"""Increasing times (N,), seconds, and values (N, K)."""


@dataclass(slots=True)
class Moved:
    """Samples of odometry and of poses, by topic."""

    parts: dict[str, list[NDArray[np.float64]]] = field(default_factory=lambda: defaultdict(list))
    counts: dict[str, int] = field(default_factory=lambda: defaultdict(int))

    def add(self, topic: str, batch: pa.RecordBatch) -> None:
        """Keep the messages of a topic, up to `SAMPLES_MAX`, if it describes motion."""
        kind = next((kind for kind in KINDS if topics.names(kind, topic)), None)
        room = MOST - self.counts[topic] if kind else 0
        if kind and room > 0:
            rows = _rows(batch.slice(0, room), KINDS[kind])
            self.parts[topic].append(rows)
            self.counts[topic] += len(rows)

    def doubted(self) -> Iterator[tuple[str, str]]:
        """Yield topic and text for each signal that contradicts its robot's poses."""
        of = {topic: _signal(parts) for topic, parts in self.parts.items()}
        for kind in (topics.VELOCITY, topics.ATTITUDE):
            for topic in sorted(topic for topic in of if topics.names(kind, topic)):
                robot = topics.robots([topic], kind)[0]
                pose = of.get(topics.true_pose(robot), of.get(topics.pose(robot)))
                if pose is not None and len(pose[0]) >= LEAST and len(of[topic][0]) >= LEAST:
                    doubts = _velocity if kind == topics.VELOCITY else _attitude
                    yield from ((topic, text) for text in doubts(of[topic], _motion(*pose)))


def _rows(batch: pa.RecordBatch, fields: tuple[str, ...]) -> NDArray[np.float64]:
    """Return (N, 1 + K) seconds and values; for a pose x, y and a quaternion."""
    columns = [batch["log_time"].to_numpy() * 1e-9]
    if fields:
        columns += [batch[name].to_numpy(zero_copy_only=False) for name in fields]
    else:
        pose = batch["pose"]
        for part, axes in (("position", "xy"), ("orientation", "xyzw")):
            inner = pose.field(part)
            columns += [inner.field(axis).to_numpy(zero_copy_only=False) for axis in axes]
    return np.column_stack(columns).astype(float)


def _signal(parts: list[NDArray[np.float64]]) -> Signal:
    rows = np.concatenate(parts)
    rows = rows[np.isfinite(rows).all(axis=1)]
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    return rows[:, 0], rows[:, 1:]


def _motion(time_s: Array, pose: Array) -> Mapping[str, Signal]:
    """Return world velocity, angles and yaw rate from poses (N, 6), where poses are dense."""
    size = np.linalg.norm(pose[:, 2:], axis=1)
    good = np.abs(size - 1) < 0.1
    time_s, pose, size = time_s[good], pose[good], size[good]
    if len(time_s) < LEAST:
        return {}
    angles = euler_zyx(pose[:, 2:] / size[:, None])
    angles[:, 2] = np.unwrap(angles[:, 2])
    middle = np.arange(time_s[0] + SLOPE_S, time_s[-1] - SLOPE_S, STEP_S)
    before, after = (_at((time_s, np.column_stack([pose[:, :2], angles])), middle + way)
                     for way in (-SLOPE_S / 2, SLOPE_S / 2))  # fmt: skip
    slope, mean = (after - before) / SLOPE_S, (after + before) / 2
    near = np.searchsorted(time_s, middle + SLOPE_S) - np.searchsorted(time_s, middle - SLOPE_S)
    known = near >= 4  # not where motion capture lost the markers
    return {
        "velocity": (middle[known], slope[known, :2]),
        "angles": (middle[known], mean[known, 2:]),
        "yaw rate": (middle[known], slope[known, 4:]),
    }


def _at(signal: Signal, time_s: Array) -> Array:
    return np.column_stack([np.interp(time_s, signal[0], axis) for axis in signal[1].T])


def _velocity(measured: Signal, motion: Mapping[str, Signal]) -> Iterator[str]:
    """Report velocities that are not in the robot's horizontal frame."""
    if not motion:
        return
    time_s, world = motion["velocity"]
    time_s, world, yaw = _within(measured, time_s, world, motion["angles"][1][:, 2])
    said = _at(measured, time_s)
    if len(time_s) < LEAST or min(_rms(said), _rms(world)) < MOVING_MPS:
        return
    c, s = np.cos(yaw), np.sin(yaw)
    forward, left = c * world[:, 0] + s * world[:, 1], c * world[:, 1] - s * world[:, 0]
    if _alike(said, np.column_stack([forward, left])) > UNLIKE:
        return
    others = {
        "They seem to be in a frame that does not turn with it": world,
        "Sideways seems to be positive to the right": np.column_stack([forward, -left]),
        "Forward seems to be negative": np.column_stack([-forward, left]),
        "Both seem to have the wrong sign": -np.column_stack([forward, left]),
        "x and y seem to be swapped": np.column_stack([left, forward]),
    }
    likely = max(others, key=lambda text: _alike(said, others[text]))
    if _alike(said, others[likely]) > ALIKE:
        yield (
            f"velocities contradict the slope of the robot's poses. {likely}: use x forward, "
            f"y left, {TIED}"
        )


def _attitude(measured: Signal, motion: Mapping[str, Signal]) -> Iterator[str]:
    """Report angles and yaw rates with the wrong sign."""
    if not motion:
        return
    time_s, angles = motion["angles"]
    true = np.column_stack([angles[:, :2], motion["yaw rate"][1]])
    time_s, true = _within(measured, time_s, true)
    if len(time_s) < LEAST:
        return
    said = _at(measured, time_s)
    names = (
        ("roll_rad", "positive right side down", TILTED_RAD),
        ("pitch_rad", "positive nose down", TILTED_RAD),
        ("yaw_rate_radps", "positive to the left", TURNING_RADPS),
    )
    for k, (name, way, least) in enumerate(names):
        here, there = said[:, k] - said[:, k].mean(), true[:, k] - true[:, k].mean()
        if min(_rms(here), _rms(there)) > least and _alike(here, there) < -UNLIKE:
            yield f"{name} has the opposite sign to the robot's poses: use {way}, {TIED}"


def _within(measured: Signal, time_s: Array, *values: Array) -> tuple[Array, ...]:
    inside = (time_s >= measured[0][0]) & (time_s <= measured[0][-1])
    return time_s[inside], *(value[inside] for value in values)


def _rms(values: Array) -> float:
    return float(np.sqrt((values**2).sum() / max(len(values), 1)))


def _alike(one: Array, other: Array) -> float:
    """Return the normalised product: 1 for equal signals, -1 for opposite ones."""
    return float((one * other).sum() / np.sqrt((one**2).sum() * (other**2).sum() + 1e-12))
