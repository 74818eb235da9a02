"""Euler angles and quaternions, compared with products of rotation matrices."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.geometry.frames import Array
from dmrl.geometry.rotations import euler_to_quaternion, quaternion_to_euler

TILT = st.floats(-1.5, 1.5)
TURN = st.floats(-3.1, 3.1)
HALF = np.sqrt(0.5)


def rotation_matrix(axis: int, angle: float) -> Array:
    """Return the (3, 3) right-handed rotation by an angle, rad, about axis 0, 1 or 2."""
    c, s = np.cos(angle), np.sin(angle)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    out = np.eye(3)
    out[first, first] = out[second, second] = c
    out[first, second], out[second, first] = -s, s
    return out


def matrix_from_quaternion(quaternion: Array) -> Array:
    """Return (3, 3) world from body of a quaternion x, y, z, w: v + 2 w (q x v) + 2 q x (q x v)."""
    x, y, z, w = quaternion
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross)


@given(TURN, TILT, TURN)
def test_roll_is_first_then_pitch_then_yaw(roll: float, pitch: float, yaw: float) -> None:
    (quaternion,) = euler_to_quaternion(np.array([[roll, pitch, yaw]]))
    assert np.linalg.norm(quaternion) == pytest.approx(1)
    wanted = rotation_matrix(2, yaw) @ rotation_matrix(1, pitch) @ rotation_matrix(0, roll)
    np.testing.assert_allclose(matrix_from_quaternion(quaternion), wanted, atol=1e-9)


@given(TURN, TILT, TURN, st.sampled_from([1.0, -1.0]))
def test_euler_angles_round_trip_through_quaternions(
    roll: float, pitch: float, yaw: float, sign: float
) -> None:
    angles = np.array([[roll, pitch, yaw], [0.1, 0.2, 0.3]])
    np.testing.assert_allclose(
        quaternion_to_euler(sign * euler_to_quaternion(angles)), angles, atol=1e-6
    )


@pytest.mark.parametrize(
    ("quaternion", "angles"),
    [
        ((HALF, 0, 0, HALF), (np.pi / 2, 0, 0)),  # right side down
        ((0, np.sin(0.5), 0, np.cos(0.5)), (0, 1.0, 0)),  # nose down
        ((0, 0, HALF, HALF), (0, 0, np.pi / 2)),  # to the left
        ((0, 0, 1, 0), (0, 0, np.pi)),
        ((0, 0, 0, 1), (0, 0, 0)),
    ],
)
def test_single_axis_rotations_equal_hand_computed_values(
    quaternion: tuple[float, ...], angles: tuple[float, float, float]
) -> None:
    np.testing.assert_allclose(quaternion_to_euler(np.array([quaternion]))[0], angles, atol=1e-7)


def test_rounding_beyond_straight_down_is_no_error() -> None:
    steep = np.array([[0.0, HALF + 1e-9, 0.0, HALF + 1e-9], [0.0, -HALF - 1e-9, 0.0, HALF + 1e-9]])
    np.testing.assert_allclose(quaternion_to_euler(steep)[:, 1], [np.pi / 2, -np.pi / 2])
