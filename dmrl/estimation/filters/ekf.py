"""Published relative EKF (Li et al. 2020), vectorized; `filterpy_ekf` is its reference.

State (x, y, psi); the inputs are both robots' velocities and yaw rates. The filters start at (0, 0,
0), as published, which is why they can converge to a wrong position.
"""

from dataclasses import dataclass

import numpy as np

from dmrl.estimation.model.pair import Array, Mask, Pair

RANGE_MARGIN_M = 1e-4
"""Added to every range, metres. It avoids a division by zero at the start (0, 0), as in the
firmware."""


@dataclass(frozen=True, slots=True)
class Preset:
    """Noise of the published filter.

    Parameters
    ----------
    velocity_var, yaw_rate_var
        Variances of the inputs, (m/s)^2 and (rad/s)^2.
    range_std_m
        Standard deviation of a range, metres.
    initial_var
        Initial variances of x, y (m^2), psi (rad^2).
    use_height
        Whether the range contains the height difference.
    """

    velocity_var: float
    yaw_rate_var: float
    range_std_m: float
    initial_var: tuple[float, float, float]
    use_height: bool


PRESETS = {
    "published-sim": Preset(0.25**2, 0.4**2, 0.1, (10.0, 10.0, 0.1), use_height=False),
    "published-firmware": Preset(1.0, 0.7, 2.0, (1000.0, 1000.0, 1.0), use_height=True),
}
"""Noise of the publication's simulation and of its firmware."""


@dataclass(frozen=True, slots=True)
class Steps:
    """Inputs of B filters at K steps. `build_steps` makes them for one pair.

    Parameters
    ----------
    inputs
        (K, B, 6): vx, vy, yaw rate of the peer, then of the observer.
    height_m
        (K, B) peer's height minus the observer's, metres.
    range_m
        (K, B) range that arrived with the step, metres; NaN without one.
    dt_s
        Seconds per step.
    """

    inputs: Array
    height_m: Array
    range_m: Array
    dt_s: float


def build_steps(pair: Pair, preset: Preset) -> Steps:
    """Build the inputs of the filter for one pair, B = 1.

    Ranges go to the nearest step. If several fall on one step, as where both robots range, the last
    counts.
    """
    own, peer = pair.own, pair.peer
    inputs = np.column_stack(
        [peer.vx_mps, peer.vy_mps, peer.yaw_rate_radps, own.vx_mps, own.vy_mps, own.yaw_rate_radps]
    )
    height_m = (peer.height_m - own.height_m) * preset.use_height
    range_m = np.full(len(pair.time_s), np.nan)
    nearest = np.rint((pair.range_time_s - pair.time_s[0]) / pair.dt_s).astype(int)
    range_m[nearest] = pair.range_m
    return Steps(inputs[:, None], height_m[:, None], range_m[:, None], pair.dt_s)


def stack_pairs(steps: list[Steps]) -> Steps:
    """Stack pairs of equal length side by side."""
    return Steps(
        np.concatenate([s.inputs for s in steps], axis=1),
        np.concatenate([s.height_m for s in steps], axis=1),
        np.concatenate([s.range_m for s in steps], axis=1),
        steps[0].dt_s,
    )


def propagate_state(state: Array, inputs: Array, dt_s: float) -> tuple[Array, Array, Array]:
    """Propagate B filters by one step; return the states and their Jacobians.

    Parameters
    ----------
    state
        (B, 3) x, y (m), psi (rad).
    inputs
        (B, 6) as in `Steps`.
    dt_s
        Seconds.

    Returns
    -------
    state : Array
        (B, 3).
    by_state : Array
        (B, 3, 3) Jacobian by the state, at the state before the step.
    by_input : Array
        (B, 3, 6) Jacobian by the inputs.
    """
    x, y, psi = state.T
    vxj, vyj, rj, vxi, vyi, ri = inputs.T
    c, s = np.cos(psi), np.sin(psi)
    rate = np.stack(
        [c * vxj - s * vyj - vxi + ri * y, s * vxj + c * vyj - vyi - ri * x, rj - ri], axis=-1
    )
    zero, one = np.zeros_like(x), np.ones_like(x)
    by_state = np.broadcast_to(np.eye(3), (len(x), 3, 3)).copy()
    by_state[:, 0, 1], by_state[:, 1, 0] = dt_s * ri, -dt_s * ri
    by_state[:, 0, 2], by_state[:, 1, 2] = dt_s * (-s * vxj - c * vyj), dt_s * (c * vxj - s * vyj)
    rows = [
        [c, -s, zero, -one, zero, y],
        [s, c, zero, zero, -one, -x],
        [zero, zero, one, zero, zero, -one],
    ]
    by_input = dt_s * np.stack([np.stack(row, axis=-1) for row in rows], axis=1)
    return state + dt_s * rate, by_state, by_input


def predict_range(state: Array, height_m: Array) -> tuple[Array, Array]:
    """Return the predicted range (B,) of B states, metres, and its Jacobian (B, 3)."""
    x, y = state[:, 0], state[:, 1]
    range_m = np.sqrt(x**2 + y**2 + height_m**2) + RANGE_MARGIN_M
    return range_m, np.stack([x / range_m, y / range_m, np.zeros_like(x)], axis=-1)


def input_variance(preset: Preset) -> Array:
    """Return the (6, 6) covariance of the inputs."""
    v, r = preset.velocity_var, preset.yaw_rate_var
    return np.diag([v, v, r, v, v, r])


def filter_many(steps: Steps, preset: Preset) -> tuple[Array, Array]:
    """Run B filters; return states (K, B, 3) and covariances (K, B, 3, 3).

    This is the vectorized twin of `filterpy_ekf.filter_reference`.

    Parameters
    ----------
    steps
        Inputs of B pairs.
    preset
        Noise and initial variances.
    """
    count, filters = steps.height_m.shape
    noise = input_variance(preset)
    state = np.zeros((filters, 3))
    covariance = np.broadcast_to(np.diag(preset.initial_var), (filters, 3, 3)).copy()
    states, covariances = np.empty((count, filters, 3)), np.empty((count, filters, 3, 3))
    arrived = np.isfinite(steps.range_m)
    for k in range(count):
        state, by_state, by_input = propagate_state(state, steps.inputs[k], steps.dt_s)
        covariance = by_state @ covariance @ by_state.swapaxes(1, 2)
        covariance = covariance + by_input @ noise @ by_input.swapaxes(1, 2)
        if arrived[k].any():
            _update_ranges(state, covariance, steps, k, arrived[k], preset.range_std_m**2)
        states[k], covariances[k] = state, covariance
    return states, covariances


def _update_ranges(
    state: Array, covariance: Array, steps: Steps, k: int, arrived: Mask, variance: float
) -> None:
    """Update the filters with the ranges of step k, in place (Joseph form)."""
    expected, row = predict_range(state[arrived], steps.height_m[k, arrived])
    prior = covariance[arrived]
    cross = np.einsum("bij,bj->bi", prior, row)
    gain = cross / (np.einsum("bi,bi->b", row, cross) + variance)[:, None]
    state[arrived] += gain * (steps.range_m[k, arrived] - expected)[:, None]
    keep = np.eye(3) - gain[:, :, None] * row[:, None, :]
    spread = variance * gain[:, :, None] * gain[:, None, :]
    covariance[arrived] = keep @ prior @ keep.swapaxes(1, 2) + spread
