"""Preintegrate odometry between keyframes.

The logs are integrated once at 100 Hz, so that the estimators step at 10 Hz. Odometry of a robot
runs in a frame fixed at its start. The relative motion from a keyframe k to a time t, in the
robot's frame at k, is then exact for any t.
"""

from dataclasses import dataclass

import numpy as np

from dmrl.estimation.model.pair import Array, SensorTrack

QUARTER_TURN: Array = np.array([[0.0, -1.0], [1.0, 0.0]])
"""Rotation by 90 degrees. The derivative of a rotation by its angle is QUARTER_TURN @ rotation."""


def rotation_matrix(angle_rad: Array) -> Array:
    """Return (..., 2, 2) counter-clockwise rotation matrices of angles in radians."""
    out = np.empty((*np.shape(angle_rad), 2, 2))
    out[..., 0, 0] = out[..., 1, 1] = np.cos(angle_rad)
    out[..., 1, 0] = np.sin(angle_rad)
    out[..., 0, 1] = -out[..., 1, 0]
    return out


@dataclass(frozen=True, slots=True)
class Odometry:
    """Dead reckoning of one robot over a flight.

    Parameters
    ----------
    time_s
        (K,) uniform grid, seconds.
    heading_rad
        (K,) integral of the yaw rate, radians.
    position_m
        (K, 2) integral of the velocity in the frame of the start, metres.
    bias_jacobian_s
        (K, 2, 2) derivative of the position by a velocity bias, metres per m/s.
    """

    time_s: Array
    heading_rad: Array
    position_m: Array
    bias_jacobian_s: Array

    def interpolate_at(self, time_s: Array) -> tuple[Array, Array, Array]:
        """Interpolate heading (N,), position (N, 2) and bias Jacobian (N, 2, 2) at times."""
        step = (time_s - self.time_s[0]) / (self.time_s[1] - self.time_s[0])
        low = np.clip(step.astype(int), 0, len(self.time_s) - 2)
        share = step - low

        def blend_samples(values: Array) -> Array:
            part = share.reshape(-1, *[1] * (values.ndim - 1))
            return np.asarray(values[low] * (1 - part) + values[low + 1] * part)

        return (
            blend_samples(self.heading_rad),
            blend_samples(self.position_m),
            blend_samples(self.bias_jacobian_s),
        )

    def relative_motion(self, from_s: Array, to_s: Array) -> "RelativeMotion":
        """Return the motion between pairs of times, in the robot's frame at the first of each."""
        heading, position, drift = self.interpolate_at(from_s)
        later_heading, later, later_drift = self.interpolate_at(to_s)
        back = rotation_matrix(-heading)
        return RelativeMotion(
            turn_rad=later_heading - heading,
            shift_m=np.einsum("nij,nj->ni", back, later - position),
            bias_jacobian_s=back @ (later_drift - drift),
        )


@dataclass(frozen=True, slots=True)
class RelativeMotion:
    """Relative motions of one robot.

    Parameters
    ----------
    turn_rad
        (N,) change of heading, radians.
    shift_m
        (N, 2) change of position in the robot's frame at the start of each motion, metres.
    bias_jacobian_s
        (N, 2, 2) derivative of the shift by a velocity bias, metres per m/s.
    """

    turn_rad: Array
    shift_m: Array
    bias_jacobian_s: Array

    def first(self, count: int) -> "RelativeMotion":
        """Return the first motions."""
        return RelativeMotion(
            self.turn_rad[:count], self.shift_m[:count], self.bias_jacobian_s[:count]
        )


def preintegrate(track: SensorTrack, time_s: Array) -> Odometry:
    """Integrate a robot's velocity and yaw rate by the trapezoidal rule.

    Parameters
    ----------
    track
        Sensor signals of the robot.
    time_s
        (K,) uniform time grid of the signals, seconds.
    """
    heading = _integrate(track.yaw_rate_radps, time_s)
    turned = rotation_matrix(heading)
    velocity = np.column_stack([track.vx_mps, track.vy_mps])
    position = _integrate(np.einsum("kij,kj->ki", turned, velocity), time_s)
    return Odometry(time_s, heading, position, _integrate(turned, time_s))


def dead_reckon_path(track: SensorTrack, time_s: Array) -> Array:
    """Return the (K, 2) positions that `preintegrate` gives, in less memory."""
    heading = _integrate(track.yaw_rate_radps, time_s)
    c, s = np.cos(heading), np.sin(heading)
    velocity = [c * track.vx_mps - s * track.vy_mps, s * track.vx_mps + c * track.vy_mps]
    return np.column_stack([_integrate(along, time_s) for along in velocity])


def _integrate(rate: Array, time_s: Array) -> Array:
    """Integrate (K, ...) rates over time by the trapezoidal rule."""
    dt_s = np.diff(time_s).reshape(-1, *[1] * (rate.ndim - 1))
    out = np.zeros_like(rate)
    np.cumsum(0.5 * (rate[1:] + rate[:-1]) * dt_s, axis=0, out=out[1:])
    return out


def rotate(matrices: Array, vectors: Array) -> Array:
    """Multiply (..., 2, 2) matrices with (..., 2) vectors, pair by pair."""
    x, y = vectors[..., 0], vectors[..., 1]
    out = np.empty(np.broadcast_shapes(matrices.shape[:-1], vectors.shape))
    for k in range(2):
        out[..., k] = matrices[..., k, 0] * x + matrices[..., k, 1] * y
    return out
