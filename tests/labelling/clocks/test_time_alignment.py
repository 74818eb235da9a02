"""Clock offsets are found by aligning signals of a known motion."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl import topics
from dmrl.geometry.rotations import euler_to_quaternion
from dmrl.images.codec import encode_png
from dmrl.labelling.clocks.time_alignment import (
    MIN_MOCAP_STEP_S,
    _keep_increasing,
    _most_certain,
    _pose_signals,
    estimate_camera_clock,
    estimate_mocap_clocks,
    estimate_range_clocks,
)
from dmrl.labelling.flight_log import read_flight
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter

TIME_S = np.arange(0, 30, 0.05)
LATE_S = 0.13


def draw_smooth_signal(seed: int, time_s: Any, per_s: float = 1.0) -> Any:
    """Return a sum of random waves, and its derivative."""
    rng = np.random.default_rng(seed)
    rates, phases = rng.uniform(0.5, 4.0, 5) * per_s, rng.uniform(0, 6, 5)
    waves = np.sin(np.outer(time_s, rates) + phases)
    return waves.sum(axis=1) / 5, (np.cos(np.outer(time_s, rates) + phases) * rates).sum(axis=1) / 5


def estimate_from_mocap(path: Path, only: str, tf: bool = False) -> Any:
    """Record a robot with a late log that moves along one axis only; estimate its clock.

    Motion capture gives the poses on /pose/truth, or on /tf.
    """
    (roll, _), (pitch, _) = (draw_smooth_signal(k, TIME_S) for k in (1, 2))
    yaw, yaw_rate = draw_smooth_signal(3, TIME_S)
    high, _ = draw_smooth_signal(4, TIME_S)
    moves = {"roll": 0, "pitch": 0, "yaw rate": 0, "height": 0} | {only: 0.3}
    angles = np.column_stack(
        [moves["roll"] * roll, moves["pitch"] * pitch, moves["yaw rate"] * yaw]
    )
    turns = euler_to_quaternion(angles)
    with RecordingWriter(path, Provenance("test")) as sink:
        for k, time_s in enumerate(TIME_S.tolist()):
            time_ns, own_ns = round(time_s * 1e9), round((time_s + LATE_S) * 1e9)
            turn = dict(zip("xyzw", turns[k].tolist(), strict=True))
            place = {"x": 0.0, "y": 0.0, "z": 1 + moves["height"] * high[k]}
            if tf:
                frame = {"child_frame_id": "cf1/horizontal", "translation": place, "rotation": turn}
                transforms = message_class("FrameTransforms")(transforms=[frame])
                sink.write(time_ns, topics.TRANSFORMS, transforms)
            else:
                pose = message_class("PoseInFrame")(pose={"position": place, "orientation": turn})
                sink.write(time_ns, topics.TRUE_POSE("cf1"), pose)
            rate = moves["yaw rate"] * yaw_rate[k]
            names = ("roll_rad", "pitch_rad", "yaw_rate_radps")
            own = dict(zip(names, [*angles[k, :2], rate], strict=True))
            sink.write(own_ns, topics.ATTITUDE("cf1"), message_class("Attitude")(**own))
            sink.write(own_ns, topics.HEIGHT("cf1"), message_class("Height")(height_m=place["z"]))
    return estimate_mocap_clocks(read_flight(path))


@pytest.mark.parametrize("only", ["roll", "pitch", "yaw rate", "height"])
def test_motion_capture_and_a_robot_agree_in_each_signal(tmp_path: Path, only: str) -> None:
    found = estimate_from_mocap(tmp_path / "a.mcap", only)
    assert found.keys() == {"cf1"}
    assert found["cf1"].by == only
    assert found["cf1"].offset_s == pytest.approx(-LATE_S, abs=0.01)


def test_horizontal_frames_of_motion_capture_count_too(tmp_path: Path) -> None:
    assert estimate_from_mocap(tmp_path / "a.mcap", "height", tf=True)["cf1"].by == "height"


def test_ranges_both_ways_set_the_second_robots_clock(tmp_path: Path) -> None:
    path, rng = tmp_path / "a.mcap", np.random.default_rng(0)
    time_s = np.arange(0, 60, 0.05)
    away, _ = draw_smooth_signal(5, time_s, 0.5)
    with RecordingWriter(path, Provenance("test")) as sink:
        for k, moment in enumerate(time_s.tolist()):
            link = ("cf1", "cf2") if k % 2 else ("cf2", "cf1")
            stamp_s = moment + (0.0 if k % 2 else LATE_S)
            heard = message_class("UwbRange")(range_m=3 + away[k] + rng.normal(0, 0.01))
            sink.write(round(stamp_s * 1e9), topics.RANGE(*link), heard)
            sink.write(round(moment * 1e9), topics.RANGE("cf1", "cf3"), heard)
    held = read_flight(path)
    assert held.ranges.keys() == {("cf1", "cf2"), ("cf2", "cf1"), ("cf1", "cf3")}
    found = estimate_range_clocks(held)
    assert found.keys() == {("cf1", "cf2")}
    assert found["cf1", "cf2"].offset_s == pytest.approx(-LATE_S, abs=0.03)
    assert found["cf1", "cf2"].by == "ranges"


@pytest.mark.parametrize("axis", ["yaw rate", "pitch rate"])
@pytest.mark.heavy
def test_a_camera_and_its_robot_turn_the_same_way(tmp_path: Path, axis: str) -> None:
    path, rng = tmp_path / "a.mcap", np.random.default_rng(0)
    scene = rng.integers(0, 256, (12, 16), np.uint8).repeat(12, 0).repeat(12, 1)
    image_s = np.arange(0, 23, 0.1)
    angle, _ = draw_smooth_signal(6, image_s, 0.6)
    shift = np.rint(20 * angle).astype(int)  # pixels by which the scene moves right or up
    own_s = np.arange(0, 23, 0.05)
    own, rate = draw_smooth_signal(6, own_s, 0.6)
    with RecordingWriter(path, Provenance("test")) as sink:
        for moment, px in zip(image_s.tolist(), shift.tolist(), strict=True):
            turned = (0, px) if axis == "yaw rate" else (-px, 0)
            seen = np.roll(scene, turned, (0, 1))[16:128, 16:176]
            rgb = np.repeat(seen[..., None], 3, axis=2)
            picture = message_class("CompressedImage")(data=encode_png(rgb), format="png")
            sink.write(round((moment + LATE_S) * 1e9), topics.CAMERA_IMAGE("cf1"), picture)
        for k, moment in enumerate(own_s.tolist()):
            turn = {"yaw_rate_radps": rate[k]} if axis == "yaw rate" else {"pitch_rad": own[k]}
            sink.write(
                round(moment * 1e9), topics.ATTITUDE("cf1"), message_class("Attitude")(**turn)
            )
    found = estimate_camera_clock(read_flight(path), "cf1", {})
    assert found is not None
    assert found.by == axis
    assert found.offset_s == pytest.approx(-LATE_S, abs=0.02)
    assert estimate_camera_clock(read_flight(path), "cf2", {}) is None


def test_repeated_or_backward_times_and_nan_are_left_out() -> None:
    time_s = np.array([0.0, 1.0, 1.0, 0.5, 2.0, 3.0])
    kept_s, kept = _keep_increasing(time_s, np.array([5.0, 6.0, 7.0, 8.0, 9.0, np.nan]))
    assert kept_s.tolist() == [0.0, 1.0, 2.0]
    assert kept.tolist() == [5.0, 6.0, 9.0]


def test_pose_signals_equal_own_sensor_signals() -> None:
    time_s = np.arange(0, 4, 0.025)
    (roll, _), (pitch, _), (yaw, yaw_rate), (x, vx), (y, vy) = (
        draw_smooth_signal(k, time_s) for k in range(5)
    )
    angles = np.column_stack([0.8 * roll, 0.9 * pitch, 8 * yaw])
    assert np.abs(angles[:, 2]).max() > np.pi  # the yaw of the pose wraps
    rows = np.column_stack([x, 2 * y, 1 + roll, euler_to_quaternion(angles)])
    found = _pose_signals(time_s, rows)
    assert found["roll"][1] == pytest.approx(0.8 * roll)
    assert found["pitch"][1] == pytest.approx(0.9 * pitch)
    assert found["height"][1] == pytest.approx(1 + roll)
    middle = (time_s[1:] + time_s[:-1]) / 2
    assert (found["yaw rate"][0] == middle).all()
    assert found["yaw rate"][1] == pytest.approx(np.interp(middle, time_s, 8 * yaw_rate), abs=0.1)
    speed = np.interp(middle, time_s, np.hypot(vx, 2 * vy))
    assert found["speed"][1] == pytest.approx(speed, abs=0.1)


def test_poses_that_are_too_near_to_each_other_are_left_out() -> None:
    rows = np.tile([0.0, 0, 1, 0, 0, 0, 1], (4, 1))
    time_s = np.array([0.0, 0.5, 1.0, 1.5]) * MIN_MOCAP_STEP_S
    assert _pose_signals(time_s, rows)["height"][0].tolist() == [0.0, MIN_MOCAP_STEP_S]
    assert _pose_signals(time_s[:2], rows[:2]) == {}


def test_most_certain_signal_sets_the_clock() -> None:
    rng = np.random.default_rng(0)
    one, two = (draw_smooth_signal(k, TIME_S)[0] for k in (7, 8))
    noisy = two + rng.normal(0, 0.2, len(two))
    reference = {"vague": (TIME_S, two), "sharp": (TIME_S, one), "alone": (TIME_S, one)}
    other = {"vague": (TIME_S + 0.1, noisy), "sharp": (TIME_S + LATE_S, one)}
    found = _most_certain(reference, other)
    assert found is not None
    assert (found.by, found.offset_s) == ("sharp", pytest.approx(-LATE_S, abs=0.001))
    assert _most_certain(reference, {}) is None
