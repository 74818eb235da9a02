"""Attitudes and yaw rates from logged angles and quaternions."""

import numpy as np
import pytest
from hypothesis import given

from dmrl.formats.crazyflie.log_block import LogBlock, TimeSeries
from dmrl.formats.crazyflie.log_variables import (
    compute_yaw_rate,
    find_attitude,
)
from dmrl.formats.crazyflie.state import find_orientation, find_quaternions

from .test_log_variables import (
    ANGLE,
    MS,
    TIMES,
    make_block,
    matrix_from_euler,
    matrix_from_quaternion,
)


@pytest.mark.parametrize("missing", ["roll", "pitch", "yaw"])
def test_an_attitude_needs_three_angles_of_one_source(missing: str) -> None:
    angles = {f"stabilizer__{n}": [5.0] * 3 for n in ("roll", "pitch", "yaw") if n != missing}
    assert find_attitude([make_block("a", **angles)]) is None
    assert (
        find_attitude([make_block("a", **angles, **{f"stabilizer__{missing}": [5.0] * 3})])
        is not None
    )


@pytest.mark.parametrize("step_ns", [0, MS])
def test_yaw_rate_is_zero_without_increasing_times(step_ns: int) -> None:
    yaw = np.column_stack([np.zeros(2), np.zeros(2), [0.0, 0.002]])
    found = compute_yaw_rate([], TimeSeries(np.array([5, 5 + step_ns]), yaw))
    assert found == pytest.approx(2.0 if step_ns else 0.0)


def test_rows_that_share_a_time_keep_their_angles_and_the_slope_of_the_yaw() -> None:
    degrees = np.arange(6.0)
    shared = LogBlock(
        "a",
        np.array([0, 1, 1, 3, 4, 5]) * MS,
        {f"stabilizer.{name}": degrees for name in ("roll", "pitch", "yaw")},
    )
    attitude = find_attitude([shared])
    assert attitude is not None
    np.testing.assert_allclose(np.degrees(attitude.values), np.outer(degrees, [1, -1, 1]))
    rate = np.degrees(compute_yaw_rate([], attitude)) * 1e-3
    np.testing.assert_allclose(rate, [1, 1, 1, 1, 1, 1], atol=0.2)


@given(ANGLE, ANGLE, ANGLE)
@pytest.mark.heavy
def test_logged_angles_give_the_orientation_of_a_pose(
    roll: float, pitch: float, yaw: float
) -> None:
    degrees = np.degrees([roll, -pitch, yaw])  # sign of the Crazyflie: pitch is positive nose up
    logged = {f"stateEstimate__{n}": [v] for n, v in zip(("roll", "pitch", "yaw"), degrees)}  # noqa: B905
    found = find_orientation([make_block("a", **logged)])
    assert found is not None
    np.testing.assert_allclose(
        matrix_from_quaternion(found.values[0]), matrix_from_euler(roll, pitch, yaw), atol=1e-5
    )


def test_quaternions_that_are_whole_come_before_packed_ones() -> None:
    whole = make_block("a", stateEstimate__qx=[0.0], stateEstimate__qy=[0.0])
    rest = {"stateEstimate.qz": np.array([1.0]), "stateEstimate.qw": np.array([0.0])}
    whole = LogBlock("a", whole.time_ns, {**whole.columns, **rest})
    packed = LogBlock("z", TIMES[:1], {"stateEstimateZ.quat": np.array([3 << 30])})  # no rotation
    for blocks, wanted in (([whole, packed], [0, 0, 1, 0]), ([packed], [0, 0, 0, 1])):
        found = find_quaternions(blocks)
        assert found is not None and found.values.tolist() == [wanted]
