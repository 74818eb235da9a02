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
from dmrl.geometry.rotations import quaternion_to_euler
from dmrl.recording.protobuf.arrow_arrays import to_numpy

SAMPLE_STEP_S, SLOPE_WINDOW_S = 0.05, 0.3
"""Interval of the compared samples, and window of the slope of a pose, seconds."""
SAMPLES_MAX = 20_000
"""Samples kept per topic. The first quarter of an hour is enough."""
SAMPLES_MIN = 100
"""Samples needed for a comparison."""
MOVING_MIN_MPS, TURNING_MIN_RADPS, TILTED_MIN_RAD = 0.1, 0.1, 0.02
"""Root mean square of a motion below which it is not compared, m/s, rad/s and rad."""
CORRELATION_LOW, CORRELATION_HIGH = 0.5, 0.8
"""Correlation below which two signals differ, and above which they agree."""
MOTION_FIELDS = {
    topics.VELOCITY: ("vx_mps", "vy_mps"),
    topics.ATTITUDE: ("roll_rad", "pitch_rad", "yaw_rate_radps"),
    topics.POSE: (),
    topics.TRUE_POSE: (),
    topics.HEIGHT: ("height_m",),
    topics.RANGE: ("range_m",),
}
FLOOR_NEAR_M, FLOOR_SHARE = 0.05, 0.9
"""Distance from the robot's height within which this share of the ranges are to the floor."""
HELD_SHARE = 0.4
"""Share of repeated ranges from which a logger seems to hold them."""
ALIGN_HINT = "or align its clock with the poses': dmrl align --mocap"
Signal = tuple[Array, Array]
"""Increasing times (N,), seconds, and values (N, K)."""


@dataclass(slots=True)
class MotionSamples:
    """Samples of odometry and of poses, by topic."""

    parts: dict[str, list[NDArray[np.float64]]] = field(default_factory=lambda: defaultdict(list))
    counts: dict[str, int] = field(default_factory=lambda: defaultdict(int))

    def add_batch(self, topic: str, batch: pa.RecordBatch) -> None:
        """Keep the messages of a topic, up to `SAMPLES_MAX`, if it describes motion."""
        kind = next((kind for kind in MOTION_FIELDS if topics.parse_topic(kind, topic)), None)
        room = SAMPLES_MAX - self.counts[topic] if kind else 0
        if kind and room > 0:
            rows = _extract_rows(batch.slice(0, room), MOTION_FIELDS[kind])
            self.parts[topic].append(rows)
            self.counts[topic] += len(rows)

    def find_contradictions(self) -> Iterator[tuple[str, str]]:
        """Yield topic and text for each signal that contradicts its robot's poses."""
        every = {topic: _build_signal(parts) for topic, parts in self.parts.items()}
        of = {topic: signal for topic, signal in every.items() if len(signal[0]) >= SAMPLES_MIN}
        yield from _check_ranges(of)
        for kind, doubts in (
            (topics.VELOCITY, _check_velocity),
            (topics.ATTITUDE, _check_attitude),
        ):
            for topic in sorted(topic for topic in of if topics.parse_topic(kind, topic)):
                robot = topics.list_robots([topic], kind)[0]
                pose = of.get(topics.TRUE_POSE(robot), of.get(topics.POSE(robot)))
                motion = {} if pose is None else _derive_motion(*pose)
                yield from ((topic, text) for text in doubts(of[topic], motion))


def _check_ranges(of: Mapping[str, Signal]) -> Iterator[tuple[str, str]]:
    """Yield ranges that never change, are held, or are the height of their own robot."""
    for topic, (time_s, range_m) in sorted(of.items()):
        names = topics.parse_topic(topics.RANGE, topic)
        repeated = float((np.diff(range_m[:, 0]) == 0).mean())
        if names and not np.ptp(range_m):
            yield topic, f"all ranges are {range_m[0, 0]:.3g} m. Does the sensor measure?"
        elif names and repeated > HELD_SHARE:
            text = f"{repeated:.0%} of the ranges repeat the one before them"
            yield topic, f"{text}. Does the log hold them? A held value is no measurement"
        height = of.get(topics.HEIGHT(names["robot"])) if names else None
        if names is None or height is None:
            continue
        near = np.abs(range_m - _interpolate(height, time_s)) < FLOOR_NEAR_M
        if near.mean() > FLOOR_SHARE:
            text = f"{near.mean():.0%} of the ranges are the robot's own height"
            yield topic, f"{text}. Is it a range to the floor, and not to {names['peer']}?"


def _extract_rows(batch: pa.RecordBatch, fields: tuple[str, ...]) -> NDArray[np.float64]:
    """Return (N, 1 + K) seconds and values; for a pose x, y and a quaternion."""
    columns = [to_numpy(batch["log_time"]) * 1e-9]
    if fields:
        columns += [to_numpy(batch[name]) for name in fields]
    else:
        place, turn = (batch["pose"].field(part) for part in ("position", "orientation"))
        axes = *(place.field(axis) for axis in "xy"), *(turn.field(axis) for axis in "xyzw")
        columns += [to_numpy(axis) for axis in axes]
    return np.column_stack(columns).astype(float)


def _build_signal(parts: list[NDArray[np.float64]]) -> Signal:
    rows = np.concatenate(parts)
    rows = rows[np.isfinite(rows).all(axis=1)]
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    return rows[:, 0], rows[:, 1:]


def _derive_motion(time_s: Array, pose: Array) -> Mapping[str, Signal]:
    """Return world velocity, angles and yaw rate from poses (N, 6), where poses are dense."""
    size = np.linalg.norm(pose[:, 2:], axis=1)
    good = np.abs(size - 1) < 0.1
    time_s, pose, size = time_s[good], pose[good], size[good]
    if len(time_s) < SAMPLES_MIN:
        return {}
    angles = quaternion_to_euler(pose[:, 2:] / size[:, None])
    angles[:, 2] = np.unwrap(angles[:, 2])
    middle = np.arange(time_s[0] + SLOPE_WINDOW_S, time_s[-1] - SLOPE_WINDOW_S, SAMPLE_STEP_S)
    sides = middle[:, None] + np.array([-SLOPE_WINDOW_S, SLOPE_WINDOW_S])
    held = time_s, np.column_stack([pose[:, :2], angles])
    before, after = (_interpolate(held, (middle + side) / 2) for side in sides.T)
    slope, mean = (after - before) / SLOPE_WINDOW_S, (after + before) / 2
    near = np.diff(np.searchsorted(time_s, sides), axis=1)[:, 0]
    dense = near >= 4  # not where motion capture lost the markers
    return {
        "velocity": (middle[dense], slope[dense, :2]),
        "angles": (middle[dense], mean[dense, 2:]),
        "yaw rate": (middle[dense], slope[dense, 4:]),
    }


def _interpolate(signal: Signal, time_s: Array) -> Array:
    return np.column_stack([np.interp(time_s, signal[0], axis) for axis in signal[1].T])


def _check_velocity(measured: Signal, motion: Mapping[str, Signal]) -> Iterator[str]:
    """Report velocities that are not in the robot's horizontal frame."""
    if not motion:
        return
    time_s, world = motion["velocity"]
    time_s, world, yaw = _crop_to_signal(measured, time_s, world, motion["angles"][1][:, 2])
    measured_mps = _interpolate(measured, time_s)
    if len(time_s) < SAMPLES_MIN or min(_rms(measured_mps), _rms(world)) < MOVING_MIN_MPS:
        return
    c, s = np.cos(yaw), np.sin(yaw)
    forward, left = c * world[:, 0] + s * world[:, 1], c * world[:, 1] - s * world[:, 0]
    if _correlate(measured_mps, np.column_stack([forward, left])) > CORRELATION_LOW:
        return
    others = {
        "They seem to be in a frame that does not turn with it": world,
        "Sideways seems to be positive to the right": np.column_stack([forward, -left]),
        "Forward seems to be negative": np.column_stack([-forward, left]),
        "Both seem to have the wrong sign": -np.column_stack([forward, left]),
        "x and y seem to be swapped": np.column_stack([left, forward]),
    }
    likely = max(others, key=lambda text: _correlate(measured_mps, others[text]))
    if _correlate(measured_mps, others[likely]) > CORRELATION_HIGH:
        yield (
            f"velocities contradict the slope of the robot's poses. {likely}: use x forward, "
            f"y left, {ALIGN_HINT}"
        )


def _check_attitude(measured: Signal, motion: Mapping[str, Signal]) -> Iterator[str]:
    """Report angles and yaw rates with the wrong sign."""
    if not motion:
        return
    time_s, angles = motion["angles"]
    true = np.column_stack([angles[:, :2], motion["yaw rate"][1]])
    time_s, true = _crop_to_signal(measured, time_s, true)
    if len(time_s) < SAMPLES_MIN:
        return
    measured_values = _interpolate(measured, time_s)
    names = (
        ("roll_rad", "positive right side down", TILTED_MIN_RAD),
        ("pitch_rad", "positive nose down", TILTED_MIN_RAD),
        ("yaw_rate_radps", "positive to the left", TURNING_MIN_RADPS),
    )
    for k, (name, rule, least) in enumerate(names):
        one, other = (part[:, k] - part[:, k].mean() for part in (measured_values, true))
        opposite = _correlate(one, other) < -CORRELATION_LOW
        if opposite and min(_rms(one), _rms(other)) > least:
            yield f"{name} has the opposite sign to the robot's poses: use {rule}, {ALIGN_HINT}"


def _crop_to_signal(measured: Signal, time_s: Array, *values: Array) -> tuple[Array, ...]:
    inside = (time_s >= measured[0][0]) & (time_s <= measured[0][-1])
    return time_s[inside], *(value[inside] for value in values)


def _rms(values: Array) -> float:
    return float(np.sqrt((values**2).sum() / max(len(values), 1)))


def _correlate(one: Array, other: Array) -> float:
    """Return the normalised product: 1 for equal signals, -1 for opposite ones."""
    return float((one * other).sum() / np.sqrt((one**2).sum() * (other**2).sum() + 1e-12))
