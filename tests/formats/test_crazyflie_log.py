"""What is known of a Crazyflie's log variables, against rotations that are worked out apart."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.formats.crazyflie_log import _pose, attitude_of, streams, yaw_rate_of
from dmrl.formats.log_block import Block, Series, unpacked_quaternion
from dmrl.geometry.frames import Array, camera_from_horizontal
from dmrl.geometry.turns import euler_zyx, quaternion_zyx

MS = 1_000_000
TIMES = np.arange(3) * 10 * MS
ANGLE = st.floats(-1.4, 1.4)


def block(name: str, **columns: list[float]) -> Block:
    values = {key.replace("__", "."): np.array(v, np.float32) for key, v in columns.items()}
    return Block(name, TIMES[: len(next(iter(values.values())))], values)


def turned(quaternion: Array) -> Array:
    """(3, 3) world from body of x, y, z, w: how it turns the axes."""
    x, y, z, w = quaternion
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross)


def body(roll: float, pitch: float, yaw: float) -> Array:
    """(3, 3) Rz(yaw) Ry(pitch) Rx(roll)."""
    c, s = np.cos(yaw), np.sin(yaw)
    heading = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(heading @ camera_from_horizontal(roll, pitch).T)


@given(ANGLE, ANGLE, st.floats(-3, 3))
def test_quaternions_and_angles_are_one_rotation(roll: float, pitch: float, yaw: float) -> None:
    (quaternion,) = quaternion_zyx(np.array([[roll, pitch, yaw]]))
    np.testing.assert_allclose(turned(quaternion), body(roll, pitch, yaw), atol=1e-9)
    np.testing.assert_allclose(euler_zyx(quaternion[None])[0], [roll, pitch, yaw], atol=1e-6)


@given(st.integers(0, 3), st.lists(st.integers(-511, 511), min_size=3, max_size=3))
def test_packed_quaternions_are_unpacked(largest: int, others: list[int]) -> None:
    # Only where the one that is left out is the largest, which is how they are packed.
    small = np.array(others) / 511 * np.sqrt(0.5)
    if (rest := 1 - (small**2).sum()) < (small**2).max():
        return
    packed = largest
    for value in others:
        packed = packed << 10 | (value < 0) << 9 | abs(value)
    (found,) = unpacked_quaternion(np.array([packed]))
    wanted = np.insert(small, largest, np.sqrt(rest))
    np.testing.assert_allclose(found, wanted, atol=1e-12)


@given(ANGLE, ANGLE, st.floats(-3, 3))
def test_a_steady_turn_is_found_in_the_body_rates(roll: float, pitch: float, rate: float) -> None:
    attitude = Series(TIMES, np.tile([roll, pitch, 0.0], (3, 1)))
    p, q, r = np.degrees(body(roll, pitch, 0.0).T @ [0.0, 0.0, rate])
    gyro = block("imu", gyro__x=[p] * 3, gyro__y=[q] * 3, gyro__z=[r] * 3)
    np.testing.assert_allclose(yaw_rate_of([gyro], attitude), rate, atol=1e-5)


def test_without_a_gyroscope_the_yaw_tells_its_rate() -> None:
    yaw = Series(TIMES, np.column_stack([0 * TIMES, 0 * TIMES, 2e-9 * TIMES]))
    assert yaw_rate_of([], yaw) == pytest.approx(2.0)
    only_z = block("imu", gyro__z=[90.0] * 3)
    assert yaw_rate_of([only_z], yaw) == pytest.approx(np.pi / 2)
    packed = block("z", stateEstimateZ__rateYaw=[1500.0] * 3)
    assert yaw_rate_of([packed], yaw) == pytest.approx(1.5)
    assert yaw_rate_of([], Series(TIMES[:1], yaw.values[:1])).tolist() == [0.0]


def test_logged_degrees_are_nose_up_and_unwrapped() -> None:
    angles = {"roll": [10.0] * 3, "pitch": [20.0] * 3, "yaw": [170.0, -170.0, -150.0]}
    logged = block("a", **{f"stateEstimate__{name}": v for name, v in angles.items()})
    found = attitude_of([logged])
    assert found is not None
    assert np.degrees(found.values[0]) == pytest.approx([10, -20, 170])
    assert np.degrees(found.values[:, 2]) == pytest.approx([170, 190, 210])


def test_velocity_is_turned_into_the_robots_own_axes() -> None:
    state = {"roll": [0.0] * 3, "pitch": [0.0] * 3, "yaw": [90.0] * 3}
    logged = {**state, "vx": [1.0] * 3, "vy": [2.0] * 3, "vz": [3.0] * 3, "z": [0.7] * 3}
    blocks = [block("a", **{f"stateEstimate__{name}": v for name, v in logged.items()})]
    found = {s.topic: s.fields for stream in streams("cf1", blocks, {}) for s in stream}
    assert found["/cf1/velocity"] == pytest.approx({"vx_mps": 2, "vy_mps": -1, "vz_mps": 3})
    assert found["/cf1/height"]["height_m"] == pytest.approx(0.7)


def test_a_leaning_beam_is_longer_than_the_height() -> None:
    state = {"roll": [30.0] * 3, "pitch": [-20.0] * 3, "yaw": [0.0] * 3}
    blocks = [
        block("a", **{f"stateEstimate__{name}": v for name, v in state.items()}),
        block("b", range__zrange=[1000.0, 8000.0, 0.0]),
    ]
    found = [s for stream in streams("cf1", blocks, {}) for s in stream if "height" in s.topic]
    (height,) = found
    lean = np.cos(np.radians(30)) * np.cos(np.radians(20))
    assert height.fields["height_m"] == pytest.approx(lean)


def test_ranges_are_metres_and_fresh() -> None:
    floats = block("a", ranging__distance2=[1.5, 1.5, 2.5])
    whole = Block("b", TIMES, {"ranging.distance3": np.array([1500, 61_000, 1200], np.uint16)})
    found = [
        (s.topic, s.time_ns, s.fields["range_m"])
        for stream in streams("cf1", [floats, whole], {"3": "anchor"})
        for s in stream
        if "range" in s.topic
    ]
    assert found == [
        ("/cf1/range/cf2", 0, 1.5),
        ("/cf1/range/cf2", 20 * MS, 2.5),
        ("/cf1/range/anchor", 0, 1.5),
        ("/cf1/range/anchor", 20 * MS, 1.2),
    ]


def test_a_place_without_a_turn_is_level_and_looks_along_x() -> None:
    place = Series(np.arange(3), np.arange(9.0).reshape(3, 3))
    found = _pose(place, None)
    assert found is not None and _pose(None, place) is None
    assert found[0].tolist() == [0, 1, 2]
    assert found[1].tolist() == [
        [0, 1, 2, 0, 0, 0, 1],
        [3, 4, 5, 0, 0, 0, 1],
        [6, 7, 8, 0, 0, 0, 1],
    ]
