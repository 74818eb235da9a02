"""Samples made of Crazyflie log variables, against independently computed rotations."""

from itertools import chain

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.formats.crazyflie.log_block import LogBlock, TimeSeries, find_series, unpack_quaternions
from dmrl.formats.crazyflie.log_variables import (
    _combine_pose,
    build_streams,
    compute_yaw_rate,
    find_attitude,
)
from dmrl.formats.crazyflie.state import find_in_metres, find_orientation, find_quaternions
from dmrl.geometry.frames import Array, camera_from_horizontal
from dmrl.geometry.rotations import euler_to_quaternion, quaternion_to_euler
from dmrl.samples.sample import Sample

from ..reading import group_by_topic

MS = 1_000_000
TIMES = np.arange(3) * 10 * MS
ANGLE = st.floats(-1.4, 1.4)


def make_block(name: str, **columns: list[float]) -> LogBlock:
    """Return a log block with rows every 10 ms; ``__`` in a name stands for a dot."""
    values = {key.replace("__", "."): np.array(v, np.float32) for key, v in columns.items()}
    return LogBlock(name, TIMES[: len(next(iter(values.values())))], values)


def matrix_from_quaternion(quaternion: Array) -> Array:
    """Return the (3, 3) matrix world from body of a quaternion x, y, z, w."""
    x, y, z, w = quaternion
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross)


def matrix_from_euler(roll: float, pitch: float, yaw: float) -> Array:
    """Return the (3, 3) matrix world from body: Rz(yaw) Ry(pitch) Rx(roll), radians."""
    c, s = np.cos(yaw), np.sin(yaw)
    heading = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(heading @ camera_from_horizontal(roll, pitch).T)


@given(ANGLE, ANGLE, st.floats(-3, 3))
def test_quaternions_and_angles_are_one_rotation(roll: float, pitch: float, yaw: float) -> None:
    (quaternion,) = euler_to_quaternion(np.array([[roll, pitch, yaw]]))
    np.testing.assert_allclose(
        matrix_from_quaternion(quaternion), matrix_from_euler(roll, pitch, yaw), atol=1e-9
    )
    np.testing.assert_allclose(
        quaternion_to_euler(quaternion[None])[0], [roll, pitch, yaw], atol=1e-6
    )


@given(st.integers(0, 3), st.lists(st.integers(-511, 511), min_size=3, max_size=3))
def test_packed_quaternions_are_unpacked(largest: int, others: list[int]) -> None:
    # The firmware leaves out the largest component. Other examples are impossible.
    small = np.array(others) / 511 * np.sqrt(0.5)
    if (rest := 1 - (small**2).sum()) < (small**2).max():
        return
    packed = largest
    for value in others:
        packed = packed << 10 | (value < 0) << 9 | abs(value)
    (found,) = unpack_quaternions(np.array([packed]))
    wanted = np.insert(small, largest, np.sqrt(rest))
    np.testing.assert_allclose(found, wanted, atol=1e-12)


@given(ANGLE, ANGLE, st.floats(-3, 3))
def test_a_steady_turn_is_found_in_the_body_rates(roll: float, pitch: float, rate: float) -> None:
    attitude = TimeSeries(TIMES, np.tile([roll, pitch, 0.0], (3, 1)))
    p, q, r = np.degrees(matrix_from_euler(roll, pitch, 0.0).T @ [0.0, 0.0, rate])
    gyro = make_block("imu", gyro__x=[p] * 3, gyro__y=[q] * 3, gyro__z=[r] * 3)
    np.testing.assert_allclose(compute_yaw_rate([gyro], attitude), rate, atol=1e-5)


def test_yaw_rate_is_derived_from_yaw_without_gyroscope() -> None:
    yaw = TimeSeries(TIMES, np.column_stack([0 * TIMES, 0 * TIMES, 2e-9 * TIMES]))
    assert compute_yaw_rate([], yaw) == pytest.approx(2.0)
    late = TimeSeries(17 * 10**17 + TIMES, yaw.values)  # no loss of precision on a clock of today
    assert compute_yaw_rate([], late) == pytest.approx(2.0, rel=1e-9)
    only_z = make_block("imu", gyro__z=[90.0] * 3)
    assert compute_yaw_rate([only_z], yaw) == pytest.approx(np.pi / 2)
    packed = make_block("z", stateEstimateZ__rateYaw=[1500.0] * 3)
    assert compute_yaw_rate([packed], yaw) == pytest.approx(1.5)
    assert compute_yaw_rate([], TimeSeries(TIMES[:1], yaw.values[:1])).tolist() == [0.0]


def test_logged_degrees_are_nose_up_and_unwrapped() -> None:
    angles = {"roll": [10.0] * 3, "pitch": [20.0] * 3, "yaw": [170.0, -170.0, -150.0]}
    logged = make_block("a", **{f"stateEstimate__{name}": v for name, v in angles.items()})
    found = find_attitude([logged])
    assert found is not None
    assert np.degrees(found.values[0]) == pytest.approx([10, -20, 170])
    assert np.degrees(found.values[:, 2]) == pytest.approx([170, 190, 210])


def test_velocity_is_turned_into_the_robots_own_axes() -> None:
    state = {"roll": [0.0] * 3, "pitch": [0.0] * 3, "yaw": [90.0] * 3}
    logged = {**state, "vx": [1.0] * 3, "vy": [2.0] * 3, "vz": [3.0] * 3, "z": [0.7] * 3}
    blocks = [make_block("a", **{f"stateEstimate__{name}": v for name, v in logged.items()})]
    found = {s.topic: s.fields for stream in build_streams("cf1", blocks, {}) for s in stream}
    assert found["/cf1/velocity"] == pytest.approx({"vx_mps": 2, "vy_mps": -1, "vz_mps": 3})
    assert found["/cf1/height"]["height_m"] == pytest.approx(0.7)


def test_a_leaning_beam_is_longer_than_the_height() -> None:
    state = {"roll": [30.0] * 3, "pitch": [-20.0] * 3, "yaw": [0.0] * 3}
    blocks = [
        make_block("a", **{f"stateEstimate__{name}": v for name, v in state.items()}),
        make_block("b", range__zrange=[1000.0, 8000.0, 2000.0]),
    ]
    found = [
        s for stream in build_streams("cf1", blocks, {}) for s in stream if "height" in s.topic
    ]
    lean = np.cos(np.radians(30)) * np.cos(np.radians(20))
    assert [s.fields["height_m"] for s in found] == pytest.approx([lean, 2 * lean])


def test_ranges_are_in_metres_and_repeated_values_dropped() -> None:
    floats = make_block("a", ranging__distance2=[1.5, 1.5, 2.5])
    whole = LogBlock("b", TIMES, {"ranging.distance3": np.array([1500, 61_000, 1200], np.uint16)})
    found = [
        (s.topic, s.time_ns, s.fields["range_m"])
        for stream in build_streams("cf1", [floats, whole], {"3": "anchor"})
        for s in stream
        if "range" in s.topic
    ]
    assert found == [
        ("/cf1/range/cf2", 0, 1.5),
        ("/cf1/range/cf2", 20 * MS, 2.5),
        ("/cf1/range/anchor", 0, 1.5),
        ("/cf1/range/anchor", 20 * MS, 1.2),
    ]


def test_pose_without_orientation_is_level_and_faces_x() -> None:
    place = TimeSeries(np.arange(3), np.arange(9.0).reshape(3, 3))
    found = _combine_pose(place, None)
    assert found is not None and _combine_pose(None, place) is None
    assert found[0].tolist() == [0, 1, 2]
    assert found[1].tolist() == [
        [0, 1, 2, 0, 0, 0, 1],
        [3, 4, 5, 0, 0, 0, 1],
        [6, 7, 8, 0, 0, 0, 1],
    ]


def read_samples(*blocks: LogBlock, **names: str) -> dict[str, list[Sample]]:
    """Return the samples of cf1's log by topic; ``cf<number>=name`` renames a peer."""
    numbers = {key.removeprefix("cf"): name for key, name in names.items()}
    return group_by_topic(chain(*build_streams("cf1", blocks, numbers)))


def test_series_is_of_the_first_complete_block_without_its_non_finite_rows() -> None:
    one, two = make_block("a", x=[1, 2, 3]), make_block("b", x=[4, np.nan, 6], y=[7, 8, 9])
    found = find_series([one, two], ["y", "x"])
    assert found is not None
    assert found.time_ns.tolist() == [0, 20 * MS]
    assert found.values.tolist() == [[7, 4], [9, 6]]
    assert found.select_column(1).values.tolist() == [[4], [6]]
    assert found.interpolate(np.array([-5, 5, 10, 99]) * MS).tolist() == [
        [7, 4],
        [7.5, 4.5],
        [8, 5],
        [9, 6],
    ]
    assert find_series([one, two], ["x", "z"]) is None
    assert find_series([make_block("a", x=[np.nan])], ["x"]) is None
    assert find_series([make_block("a", x=[np.nan]), two], ["x"]) is not None


def test_rows_out_of_order_are_put_in_order_with_all_their_columns() -> None:
    times = np.array([30, 10, 20]) * MS
    logged = LogBlock("my block", times, {"a": np.array([3, 1, 2]), "b": np.array([30, 10, 20])})
    (found,) = read_samples(logged).values()
    assert {s.topic for s in found} == {"/cf1/log/my_block"}
    assert [(s.time_ns, s.fields["a"], s.fields["b"]) for s in found] == [
        (10 * MS, 1, 10),
        (20 * MS, 2, 20),
        (30 * MS, 3, 30),
    ]


@pytest.mark.parametrize(("norm", "kept"), [(0.91, 1), (0.89, 0), (1.09, 1), (1.11, 0)])
def test_quaternions_far_from_unit_norm_are_dropped(norm: float, kept: int) -> None:
    rows = [[0.0, norm], [0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]
    names = ("stateEstimate__qx", "stateEstimate__qy", "stateEstimate__qz", "stateEstimate__qw")
    found = find_quaternions([make_block("a", **dict(zip(names, rows, strict=True)))])
    assert found is not None
    assert found.values.tolist() == [[0, 0, 1, 0], [1, 0, 0, 0]][: 1 + kept]
    assert found.time_ns.tolist() == [0, 10 * MS][: 1 + kept]
    assert find_quaternions([make_block("a", **{name: [0.0] for name in names})]) is None


def test_state_in_millimetres_is_used_if_metres_are_missing() -> None:
    packed = make_block("z", stateEstimateZ__x=[1500.0], stateEstimateZ__y=[-20.0])
    plain = make_block("p", stateEstimate__x=[3.0], stateEstimate__y=[4.0])
    for blocks, wanted in (([packed, plain], [[3.0, 4.0]]), ([packed], [[1.5, -0.02]])):
        found = find_in_metres(blocks, "x y")
        assert found is not None and found.values == pytest.approx(np.array(wanted))
    assert find_in_metres([packed, plain], "x y z") is None


def test_missing_angles_of_an_orientation_are_zero() -> None:
    found = find_orientation(
        [make_block("a", stateEstimate__yaw=[90.0], stateEstimate__pitch=[20.0])]
    )
    wanted = euler_to_quaternion(np.array([[0.0, np.radians(-20), np.pi / 2]]))
    assert found is not None and found.values == pytest.approx(wanted)
    assert find_orientation([make_block("a", stateEstimate__x=[1.0])]) is None


def test_angles_of_the_estimate_come_before_the_stabilizer_s() -> None:
    both = make_block("a", stabilizer__roll=[10.0], stateEstimate__roll=[20.0])
    found = find_orientation([both])
    assert found is not None
    assert found.values == pytest.approx(euler_to_quaternion(np.radians([[20.0, 0, 0]])), abs=1e-6)


def test_ranges_are_limited_to_60_m_and_zeros_are_not_reported(
    capsys: pytest.CaptureFixture[str],
) -> None:
    metres = [59.99, 60.0, 61.0, 0.0, -1.0, np.nan, 0.01]
    times = np.arange(7) * MS
    found = read_samples(LogBlock("r", times, {"ranging.distance2": np.array(metres)}))[
        "/cf1/range/cf2"
    ]
    assert [(s.time_ns, s.fields["range_m"]) for s in found] == [(0, 59.99), (6 * MS, 0.01)]
    assert (
        "left out: ranges to cf2 that are not over 0 and under 60 m: 3 (first at the log)"
        in capsys.readouterr().err
    )
    mm = LogBlock("r", times, {"ranging.distance2": 2300.5 + np.arange(7)})
    assert not read_samples(mm).get("/cf1/range/cf2")
    assert "under 60 m (are they in cm or mm?): 7" in capsys.readouterr().err


def test_event_ranges_are_assigned_by_id_and_own_id_is_dropped() -> None:
    event = LogBlock(
        "estDistance",
        TIMES,
        {"id": np.array([2, 1, 2], np.uint8), "distance": np.array([1.5, 7, 2.5], np.float32)},
    )
    found = read_samples(event, cf2="anchor")
    heard = found.pop("/cf1/range/anchor")
    assert [(s.time_ns, s.fields["range_m"]) for s in heard] == [(0, 1.5), (20 * MS, 2.5)]
    assert found.keys() == {"/cf1/log/estDistance"}
    polled = make_block("p", ranging__distance2=[1.4, 1.5, 2.5], ranging__distance3=[3.0, 3.0, 3.1])
    both = read_samples(polled, event)
    assert [s.fields["range_m"] for s in both["/cf1/range/cf2"]] == [1.5, 2.5]
    assert [s.fields["range_m"] for s in both["/cf1/range/cf3"]] == pytest.approx([3.0, 3.1])


@pytest.mark.parametrize(
    ("values", "range_m", "said"),
    [
        (np.array([61.0, 1500.0]), [0.061, 1.5], "61 or more: read as millimetres"),
        (np.array([59.0, 2.0]), [59.0, 2.0], ""),
        (
            np.array([61.5, 2.0]),
            [2.0],
            "left out: ranges to cf2 that are not over 0 and under 60 m: 1",
        ),
        (np.array([61, 1500]), [0.061, 1.5], ""),
        (np.array([2, 59]), [0.002, 0.059], "but is 59 at most. Are they metres?"),
    ],
)
def test_range_unit_is_inferred_from_type_and_magnitude(
    values: np.ndarray, range_m: list[float], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    found = read_samples(LogBlock("r", TIMES[:2], {"ranging.distance2": values}))["/cf1/range/cf2"]
    assert [s.fields["range_m"] for s in found] == pytest.approx(range_m)
    err = capsys.readouterr().err
    assert said in err and ("millimetres" in err, "metres?" in err) == (
        "millimetres" in said,
        "metres?" in said,
    )


def test_poses_take_the_nearest_orientation_and_repeated_truth_is_dropped() -> None:
    place = make_block("p", **{f"locSrv__{n}": [1.0, 1.0, 2.0] for n in "xyz"})
    still = {"locSrv__qx": [0.0] * 3, "locSrv__qy": [0.0] * 3}
    turn = make_block("q", **still, locSrv__qz=[0.0, 0.0, 1.0], locSrv__qw=[1.0, 1.0, 0.0])
    found = read_samples(place, turn)
    assert "/cf1/pose" not in found
    poses = [(s.time_ns, s.fields["pose"]) for s in found["/cf1/pose/truth"]]
    assert [(t, p["position"]["z"], p["orientation"]["z"]) for t, p in poses] == [
        (0, 1.0, 0.0),
        (20 * MS, 2.0, 1.0),
    ]
    stamp = found["/cf1/pose/truth"][1].fields["timestamp"]
    assert (stamp["seconds"], stamp["nanos"]) == (0, 20 * MS)
    # Every event is a new measurement, even if its values repeat.
    event = LogBlock("estPose", TIMES, place.columns)
    assert len(read_samples(event, turn)["/cf1/pose/truth"]) == 3


def test_transforms_are_written_every_50_ms() -> None:
    times = np.arange(0, 200, 20) * MS
    columns = {f"stateEstimate.{n}": np.arange(10.0) + k for k, n in enumerate("xyz")}
    found = read_samples(LogBlock("s", times, columns))["/tf"]
    assert [s.time_ns // MS for s in found] == [0, 60, 100, 160]


def test_beam_range_of_8_m_or_more_gives_no_height() -> None:
    found = read_samples(make_block("b", range__zrange=[7999.0, 8001.0, 1.0]))["/cf1/height"]
    assert [s.time_ns for s in found] == [0, 20 * MS]
    assert [s.fields["height_m"] for s in found] == pytest.approx([7.999, 0.001])


def test_frames_and_poses_turn_as_what_was_logged() -> None:
    (quaternion,) = euler_to_quaternion(np.array([[0.3, -0.2, 1.1]]))
    names = [f"locSrv.{n}" for n in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    times = np.array([1_700_000_000_123_456_789])
    rows = [np.array([value]) for value in (1.5, 2.5, 3.5, *quaternion)]
    found = read_samples(LogBlock("estPose", times, dict(zip(names, rows, strict=True))))
    (pose,) = found["/cf1/pose/truth"]
    assert pose.fields["timestamp"] == {"seconds": 1_700_000_000, "nanos": 123_456_789}
    assert pose.fields["frame_id"] == "world"
    assert pose.fields["pose"]["position"] == {"x": 1.5, "y": 2.5, "z": 3.5}
    turn = pose.fields["pose"]["orientation"]
    assert [turn[n] for n in "xyzw"] == pytest.approx(quaternion)
    level, tilted, _ = found["/tf"][0].fields["transforms"]
    assert level["translation"] == {"x": 1.5, "y": 2.5, "z": 3.5}
    heading, tilt = (
        matrix_from_quaternion(np.array([frame["rotation"][n] for n in "xyzw"]))
        for frame in (level, tilted)
    )
    np.testing.assert_allclose(heading @ tilt, matrix_from_quaternion(quaternion), atol=1e-9)
    np.testing.assert_allclose(heading[2], [0, 0, 1], atol=1e-12)


def test_peer_with_zero_ranges_has_no_range_topic(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for kind in (np.uint16, np.float32):
        silent = LogBlock("r", TIMES, {"ranging.distance2": np.zeros(3, kind)})
        assert read_samples(silent).keys() == {"/cf1/log/r"}
        assert len(build_streams("cf1", [silent], {})) == 1
    assert "range" not in capsys.readouterr().err
