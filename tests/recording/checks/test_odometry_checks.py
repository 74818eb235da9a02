"""Checks of signs and frames against recorded poses."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray

from dmrl import topics
from dmrl.geometry.rotations import euler_to_quaternion
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, check
from dmrl.recording.checks import odometry_checks as check_motion
from dmrl.recording.checks.odometry_checks import (
    MotionSamples,
    _build_signal,
    _check_attitude,
    _check_velocity,
    _correlate,
    _derive_motion,
    _rms,
)

Columns = dict[str, NDArray[np.float64]]
TIME_S = np.arange(0.0, 30.0, 0.02)


def simulate_flight() -> tuple[Columns, Columns]:
    """Simulate a wide curve with turns about every axis; return measurements and true poses."""
    x, y = 2 * np.sin(0.5 * TIME_S), 1.5 * np.sin(0.8 * TIME_S + 1)
    yaw = 1.4 * np.sin(0.3 * TIME_S) + 0.2 * TIME_S
    roll, pitch = 0.1 * np.sin(1.1 * TIME_S), 0.12 * np.cos(0.9 * TIME_S)
    vx, vy = np.gradient(x, TIME_S), np.gradient(y, TIME_S)
    c, s = np.cos(yaw), np.sin(yaw)
    rng = np.random.default_rng(3)
    noise = rng.normal(0, 0.02, (5, len(TIME_S)))
    measured = {
        "vx_mps": c * vx + s * vy + noise[0],
        "vy_mps": c * vy - s * vx + noise[1],
        "roll_rad": roll + noise[2],
        "pitch_rad": pitch + noise[3],
        "yaw_rate_radps": np.gradient(yaw, TIME_S) + noise[4],
    }
    turns = euler_to_quaternion(np.column_stack([roll, pitch, yaw]))
    return measured, {"x": x, "y": y, **dict(zip(("qx", "qy", "qz", "qw"), turns.T, strict=True))}


def record_and_check(path: Path, said: Columns, poses: Columns, late_s: float = 0.0) -> list[str]:
    """Write the measurements and poses, the poses late by this time; return the findings."""
    with RecordingWriter(path, Provenance("test")) as sink:
        for k, time_s in enumerate(TIME_S):
            row = {name: float(values[k]) for name, values in said.items()}
            now = round((time_s + 1) * 1e9)
            velocity = {name: row[name] for name in ("vx_mps", "vy_mps")}
            turning = {name: row[name] for name in row if name not in velocity}
            sink.write(now, topics.VELOCITY("cf1"), message_class("Velocity")(**velocity))
            sink.write(now, topics.ATTITUDE("cf1"), message_class("Attitude")(**turning))
            place = {"position": {axis: float(poses[axis][k]) for axis in "xy"}}
            turn = {"orientation": {axis: float(poses[f"q{axis}"][k]) for axis in "xyzw"}}
            pose = message_class("PoseInFrame")(frame_id="world", pose={**place, **turn})
            sink.write(now + round(late_s * 1e9), topics.TRUE_POSE("cf1"), pose)
    return [f"{finding.topic}: {finding.text}" for finding in check(path)]


@pytest.mark.heavy
def test_consistent_odometry_gives_no_finding(tmp_path: Path) -> None:
    assert record_and_check(tmp_path / "a.mcap", *simulate_flight()) == []


def test_small_clock_offset_is_not_taken_for_a_wrong_sign(tmp_path: Path) -> None:
    assert record_and_check(tmp_path / "a.mcap", *simulate_flight(), late_s=0.3) == []


@pytest.mark.parametrize("name", ["roll_rad", "pitch_rad", "yaw_rate_radps"])
def test_opposite_sign_is_found(tmp_path: Path, name: str) -> None:
    measured, poses = simulate_flight()
    found = record_and_check(tmp_path / "a.mcap", measured | {name: -measured[name]}, poses)
    assert len(found) == 1 and f"/cf1/attitude: {name} has the opposite sign" in found[0]


@pytest.mark.heavy
def test_velocity_in_another_frame_is_found(tmp_path: Path) -> None:
    measured, poses = simulate_flight()
    vx, vy = measured["vx_mps"], measured["vy_mps"]
    wrong = {
        "does not turn": [np.gradient(poses[axis], TIME_S) for axis in "xy"],
        "to the right": [vx, -vy],
        "Forward seems to be negative": [-vx, vy],
        "Both seem": [-vx, -vy],
        "swapped": [vy, vx],
    }
    for k, (words, (x, y)) in enumerate(wrong.items()):
        found = record_and_check(
            tmp_path / f"{k}.mcap", measured | {"vx_mps": x, "vy_mps": y}, poses
        )
        assert len(found) == 1 and words in found[0] and "/cf1/velocity" in found[0], words


def test_signal_is_sorted_and_finite_without_repeated_times() -> None:
    parts = [np.array([[3.0, 30], [1, 10]]), np.array([[1.0, 11], [2, np.nan], [4, 40]])]
    time_s, values = _build_signal(parts)
    assert time_s.tolist() == [1, 3, 4]
    assert values.tolist() == [[10], [30], [40]]


def build_poses(time_s: NDArray[np.float64], **angles: float) -> NDArray[np.float64]:
    """Return poses (N, 6) at x = 2 t, y = -t with these angular rates, rad/s.

    The columns are x, y and the quaternion.
    """
    turn = np.column_stack([angles.get(n, 0.0) * time_s for n in ("roll", "pitch", "yaw")])
    return np.column_stack([2 * time_s, -time_s, euler_to_quaternion(turn)])


def test_motion_is_the_derivative_of_the_poses() -> None:
    time_s = np.arange(0, 4.01, 0.02)
    found = _derive_motion(time_s, build_poses(time_s, roll=0.1, pitch=-0.2, yaw=1.5))
    for name, wanted in (("velocity", [2.0, -1.0]), ("yaw rate", [1.5])):
        at, values = found[name]
        assert at == pytest.approx(np.arange(0.3, 3.7, 0.05))
        assert values == pytest.approx(np.tile(wanted, (len(at), 1)), abs=1e-6)
    at, values = found["angles"]
    # The slope is taken over 0.3 s around each time; wrapping of the yaw gives no jump.
    assert values == pytest.approx(np.outer(at, [0.1, -0.2, 1.5]), abs=1e-6)


def test_motion_is_unknown_where_poses_are_sparse_or_not_rotations() -> None:
    time_s = np.concatenate([np.arange(0, 3, 0.02), np.arange(5, 8, 0.02)])
    at = _derive_motion(time_s, build_poses(time_s))["velocity"][0]
    assert not ((at > 3.25) & (at < 4.75)).any()
    assert (at < 3.2).any() and (at > 4.8).any()
    shrunk = build_poses(time_s)
    shrunk[:, 2:] *= 0.89
    assert _derive_motion(time_s, shrunk) == {}
    shrunk[:, 2:] *= 0.92 / 0.89
    assert _derive_motion(time_s, shrunk)
    assert _derive_motion(time_s[:99], build_poses(time_s[:99])) == {}
    assert _derive_motion(time_s[:100], build_poses(time_s[:100])) != {}


def test_correlation_and_rms_equal_hand_computed_values() -> None:
    one, other = np.array([1.0, 2.0]), np.array([2.0, -1.0])
    assert _correlate(one, 3 * one) == pytest.approx(1)
    assert _correlate(one, -one) == pytest.approx(-1)
    assert _correlate(one, other) == 0
    assert _correlate(one, np.array([1.0, 0.0])) == pytest.approx(1 / 5**0.5)
    assert _correlate(0 * one, one) == 0
    assert _rms(np.array([[3.0, 4.0], [0.0, 0.0]])) == pytest.approx((25 / 2) ** 0.5)
    assert _rms(np.zeros(0)) == 0


def build_motion(
    speed_mps: float, roll_rad: float = 0.0
) -> tuple[NDArray[np.float64], dict[str, object]]:
    """Return times, s, and the motion of a robot with this RMS speed along x and RMS roll."""
    time_s = np.arange(0, 10, 0.05)
    world = speed_mps * 2**0.5 * np.sin(4 * np.pi * time_s)[:, None] * [1.0, 0.0]
    tilt = roll_rad * 2**0.5 * np.sin(2 * np.pi * time_s)
    angles = np.column_stack([tilt, 0 * tilt, 0 * tilt])
    return time_s, {
        "velocity": (time_s, world),
        "angles": (time_s, angles),
        "yaw rate": (time_s, 0 * tilt[:, None]),
    }


@pytest.mark.parametrize(("speed_mps", "count"), [(0.09, 0), (0.11, 1)])
def test_slow_robot_gives_no_finding(speed_mps: float, count: int) -> None:
    time_s, motion = build_motion(speed_mps)
    said = -motion["velocity"][1]  # type: ignore[index]
    assert len(list(_check_velocity((time_s, said), motion))) == count  # type: ignore[arg-type]
    assert len(list(_check_velocity((time_s, 10 * said), motion))) == count  # type: ignore[arg-type]
    assert not list(_check_velocity((time_s[:99], said[:99]), motion))  # type: ignore[arg-type]
    assert not list(_check_velocity((time_s, said), {}))


@pytest.mark.parametrize(("share", "count"), [(0.55, 0), (0.45, 0)])
def test_velocity_with_weak_correlation_is_not_doubted(share: float, count: int) -> None:
    time_s, motion = build_motion(1.0)
    forward = motion["velocity"][1][:, 0]  # type: ignore[index]
    other = 2**0.5 * np.cos(4 * np.pi * time_s)
    said = share * forward - (1 - share**2) ** 0.5 * other
    rows = np.column_stack([said, 0 * said])
    assert len(list(_check_velocity((time_s, rows), motion))) == count  # type: ignore[arg-type]


@pytest.mark.parametrize(("share", "count"), [(-0.85, 1), (-0.75, 0)])
def test_velocity_that_matches_another_frame_is_doubted(share: float, count: int) -> None:
    time_s, motion = build_motion(1.0)
    forward = motion["velocity"][1][:, 0]  # type: ignore[index]
    said = share * forward + (1 - share**2) ** 0.5 * 2**0.5 * np.cos(4 * np.pi * time_s)
    rows = np.column_stack([said, 0 * said])
    assert len(list(_check_velocity((time_s, rows), motion))) == count  # type: ignore[arg-type]


@pytest.mark.parametrize(("tilt", "count"), [(0.019, 0), (0.021, 1)])
def test_tilts_under_0_02_rad_are_not_doubted(tilt: float, count: int) -> None:
    time_s, motion = build_motion(1.0, tilt)
    said = -np.column_stack([motion["angles"][1][:, :2], 0 * time_s]) + 5.0  # type: ignore[index]
    found = list(_check_attitude((time_s, said), motion))  # type: ignore[arg-type]
    assert ["roll_rad" in text for text in found] == [True] * count
    assert not list(_check_attitude((time_s[:99], said[:99]), motion))  # type: ignore[arg-type]


@pytest.mark.parametrize(("rate", "count"), [(0.09, 0), (0.11, 1)])
def test_slow_turns_are_not_doubted(rate: float, count: int) -> None:
    time_s, motion = build_motion(1.0)
    true = rate * 2**0.5 * np.sin(2 * np.pi * time_s)
    motion["yaw rate"] = (time_s, true[:, None])
    said = np.column_stack([0 * true, 0 * true, -true])
    found = list(_check_attitude((time_s, said), motion))  # type: ignore[arg-type]
    assert ["yaw_rate_radps" in text for text in found] == [True] * count
    weak = np.column_stack([0 * true, 0 * true, -0.4 * true + 0.5 * np.cos(2 * np.pi * time_s)])
    assert not list(_check_attitude((time_s, weak), motion))  # type: ignore[arg-type]


def test_motion_samples_are_limited_in_number_and_topics(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(check_motion, "SAMPLES_MAX", 7)
    moved = MotionSamples()
    times = np.arange(5) * 10**9
    batch = pa.RecordBatch.from_pydict({"log_time": times, "vx_mps": times / 1e9, "vy_mps": -times})
    for _ in range(3):
        moved.add_batch("/cf1/velocity", batch)
    moved.add_batch("/cf1/tracks", batch)
    assert moved.parts.keys() == {"/cf1/velocity"}
    rows = np.concatenate(moved.parts["/cf1/velocity"])
    assert rows[:, 0].tolist() == rows[:, 1].tolist() == [0, 1, 2, 3, 4, 0, 1]


def test_true_poses_precede_estimated_poses() -> None:
    moved, times = MotionSamples(), np.arange(400) * 20_000_000
    ahead = 2e-9 * times

    def pose(x: NDArray[np.float64]) -> pa.RecordBatch:
        turn = dict.fromkeys("xyz", 0 * x) | {"w": 0 * x + 1}
        parts = {"position": {"x": x, "y": 0 * x}, "orientation": turn}
        held = [
            pa.StructArray.from_arrays([pa.array(v) for v in part.values()], list(part))
            for part in parts.values()
        ]
        both = pa.StructArray.from_arrays(held, list(parts))
        return pa.RecordBatch.from_pydict({"log_time": times, "pose": both})

    speed = {"log_time": times, "vx_mps": 0 * ahead + 2, "vy_mps": 0 * ahead}
    moved.add_batch(topics.VELOCITY("cf1"), pa.RecordBatch.from_pydict(speed))
    assert list(moved.find_contradictions()) == []
    moved.add_batch(topics.POSE("cf1"), pose(-ahead))
    assert ["Forward seems" in text for _, text in moved.find_contradictions()] == [True]
    moved.add_batch(topics.TRUE_POSE("cf1"), pose(ahead))
    assert list(moved.find_contradictions()) == []
