"""Preintegrated odometry, compared with closed-form arcs."""

import numpy as np
import pytest

from dmrl.estimation.model.odometry import preintegrate, rotation_matrix
from dmrl.estimation.model.pair import Array, SensorTrack

TIME_S = 3 + np.arange(0, 20.001, 0.01)
VX, VY, TURN = 0.4, -0.2, 0.5


def build_arc(turn: float = TURN, vx: float = VX, vy: float = VY) -> SensorTrack:
    """Return the log of a robot on a circle, with constant velocity in its frame and yaw rate."""
    ones = np.ones(len(TIME_S))
    return SensorTrack(
        vx * ones, vy * ones, turn * ones, 1 + 0.1 * (TIME_S - 3), np.zeros(len(ones), bool)
    )


def compute_arc(lasts_s: Array, turn: float = TURN) -> Array:
    """Return (N, 2) displacements of that robot after some seconds, frame of the start."""
    z = (VX + 1j * VY) * (np.exp(1j * turn * lasts_s) - 1) / (1j * turn)
    return np.column_stack([z.real, z.imag])


def test_preintegrated_motion_equals_arcs_in_start_frame() -> None:
    from_s, to_s = np.array([3.0, 4.003, 10.0, 12.0]), np.array([3.5, 6.011, 10.0, 11.0])
    found = preintegrate(build_arc(), TIME_S).relative_motion(from_s, to_s)
    lasts = to_s - from_s
    assert found.turn_rad == pytest.approx(TURN * lasts)
    assert found.shift_m == pytest.approx(compute_arc(lasts), abs=1e-4)
    for axis, step in ((0, {"vx": VX + 1e-3}), (1, {"vy": VY + 1e-3})):
        biased = preintegrate(build_arc(**step), TIME_S).relative_motion(from_s, to_s)
        slope = (biased.shift_m - found.shift_m) / 1e-3
        assert found.bias_jacobian_s[:, :, axis] == pytest.approx(slope, abs=1e-9)
    assert rotation_matrix(np.array([np.pi / 2]))[0] @ [1, 0] == pytest.approx([0, 1])
