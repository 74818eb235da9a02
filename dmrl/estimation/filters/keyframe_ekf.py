"""Robust EKF over keyframes for many guesses and pairs at once, and its RTS smoother."""

from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.filters.camera_update import NO_UPDATES, CameraUpdates, update_with_camera
from dmrl.estimation.model.odometry import QUARTER_TURN, rotate, rotation_matrix
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.keyframes import KeyframeProblem, NoiseModel

STATE_SIZE = 5
"""Number of states: x, y, psi and the biases of both yaw rates."""
SHADOWED_RANGE_STD_M = 0.3
"""Standard deviation of a range after its step offset is removed, metres. No record of how the
value was chosen."""
MAX_INNOVATION_SIGMAS = 2.0
"""Innovation beyond which an update is down-weighted, in standard deviations. No record of how the
value was chosen."""


@dataclass(frozen=True, slots=True)
class FilterInputs:
    """Inputs of B filters at K keyframes.

    Every keyframe has one range: the median, which is robust to an outlier.

    Parameters
    ----------
    step_s
        (K, B) seconds to the next keyframe; the last is zero.
    own_turn_rad, peer_turn_rad
        (K, B) turn from this keyframe to the next; the last is zero.
    own_shift_m, peer_shift_m
        (K, B, 2) shift from this keyframe to the next; the last is zero.
    step_var
        (K, B, 5) variance that the step adds to the state.
    range_m, range_var
        (K, B) range, metres, NaN without one, and its variance, m^2.
    own_to_range_m, peer_to_range_m
        (K, B, 2) motions from the keyframe to the mean time of its ranges.
    height_m
        (K, B) peer's height minus the observer's.
    """

    step_s: Array
    own_turn_rad: Array
    peer_turn_rad: Array
    own_shift_m: Array
    peer_shift_m: Array
    step_var: Array
    range_m: Array
    range_var: Array
    own_to_range_m: Array
    peer_to_range_m: Array
    height_m: Array

    def repeat(self, copies: int, keyframes: int) -> Self:
        """Return the first keyframes, with every pair repeated ``copies`` times side by side."""
        columns = (getattr(self, field.name)[:keyframes] for field in fields(self))
        return type(self)(*(np.repeat(column, copies, axis=1) for column in columns))


def build_inputs(problems: list[KeyframeProblem], noise: NoiseModel) -> FilterInputs:
    """Build the inputs of one filter per problem. All need the same number of keyframes."""
    rows = [_pair_inputs(problem, noise) for problem in problems]
    return FilterInputs(*(np.stack(column, axis=1) for column in zip(*rows, strict=True)))


def _pair_inputs(problem: KeyframeProblem, noise: NoiseModel) -> tuple[Array, ...]:
    """Return the columns of `Inputs` for one pair."""
    count = len(problem.keyframe_s)
    per_key = np.bincount(problem.range_keyframe, minlength=count)
    many = np.maximum(per_key, 1)

    def mean_by_keyframe(values: Array) -> Array:
        return np.bincount(problem.range_keyframe, values, minlength=count) / many

    def means_by_keyframe(values: Array) -> Array:
        return np.column_stack([mean_by_keyframe(column) for column in values.T])

    # The variance of a median of n is pi/2 / n of a single one. 0.05 m: unknown range bias.
    variance = 1.5 * noise.range_std_m**2 / many + 0.05**2
    steps_s = np.append(problem.steps_s, 0.0)
    shifts = (problem.own.shift_m, problem.peer.shift_m, step_variance(problem, noise))
    shadowed = problem.range_offset_guess_m
    level = mean_by_keyframe(shadowed)
    return (
        steps_s,
        *(np.append(turn, 0.0) for turn in (problem.own.turn_rad, problem.peer.turn_rad)),
        *(np.vstack([shift, 0.0 * shift[:1]]) for shift in shifts),
        _medians_by_keyframe(problem.range_keyframe, problem.range_m - shadowed, per_key),
        np.where(level != 0, SHADOWED_RANGE_STD_M**2, variance),
        means_by_keyframe(problem.own_to_range.shift_m),
        means_by_keyframe(problem.peer_to_range.shift_m),
        mean_by_keyframe(problem.height_m),
    )


def _medians_by_keyframe(key: NDArray[np.intp], values: Array, per_key: NDArray[np.intp]) -> Array:
    """Return (K,) the median of the values of each keyframe, NaN where there are none."""
    ordered = np.append(values[np.lexsort((values, key))], np.nan)
    first = np.cumsum(per_key) - per_key
    middle = np.stack([first + (per_key - 1) // 2, first + per_key // 2])
    return np.where(per_key > 0, ordered[middle * (per_key > 0)].mean(axis=0), np.nan)


def step_variance(problem: KeyframeProblem, noise: NoiseModel) -> Array:
    """Return (K - 1, 5) variances that each step adds to x, y (m^2), psi (rad^2) and the biases."""
    steps_s, gap_s = problem.steps_s, problem.dropout_s
    shift = 2 * noise.velocity_psd * steps_s + noise.dropout_speed_mps**2 * gap_s
    turn = 2 * noise.yaw_rate_psd * steps_s + noise.dropout_turn_radps**2 * gap_s
    return np.column_stack([shift, shift, turn, np.zeros((len(turn), 2))])


@dataclass(frozen=True, slots=True)
class FilterResult:
    """Result of B filters over K keyframes.

    Parameters
    ----------
    state, covariance
        (K, B, 5), (K, B, 5, 5) of x, y, psi and the biases of the observer's and the peer's yaw
        rate, after the update with the keyframe's range.
    prior, prior_covariance
        The same before the update.
    step
        (K, B, 5, 5) Jacobian of the step to the next keyframe.
    log_likelihood
        (B,) robust log likelihood of the innovations.
    """

    state: Array
    covariance: Array
    prior: Array
    prior_covariance: Array
    step: Array
    log_likelihood: Array


def run_filters(
    inputs: FilterInputs, start: Array, start_std: Array, updates: CameraUpdates = NO_UPDATES
) -> FilterResult:
    """Filter a flight from B initial states.

    Parameters
    ----------
    inputs
        Inputs of B filters.
    start
        (B, 3) x, y (m), psi (rad) at the first keyframe.
    start_std
        (5,) standard deviations of these and of the biases, rad/s.
    updates
        Camera updates by keyframe.
    """
    count, filters = inputs.range_m.shape
    states = (np.empty((count, filters, STATE_SIZE)) for _ in range(2))
    matrices = (np.empty((count, filters, STATE_SIZE, STATE_SIZE)) for _ in range(3))
    (state, prior), (covariance, prior_covariance, step) = states, matrices
    out = FilterResult(state, covariance, prior, prior_covariance, step, np.zeros(filters))
    state = np.concatenate([start, np.zeros((filters, STATE_SIZE - 3))], axis=1)
    covariance = np.broadcast_to(np.diag(start_std**2), (filters, STATE_SIZE, STATE_SIZE)).copy()
    for k in range(count):
        out.prior[k], out.prior_covariance[k] = state, covariance
        _update_ranges(state, covariance, inputs, k, out.log_likelihood)
        for glance in updates.get(k, ()):
            mine = slice(glance.first_filter, glance.first_filter + glance.copies)
            given = state[mine], covariance[mine], inputs.height_m[k, mine]
            update_with_camera(*given, glance, out.log_likelihood[mine])
        out.state[k], out.covariance[k] = state, covariance
        state, step = _propagate(state, inputs, k)
        out.step[k] = step
        covariance = step @ covariance @ step.swapaxes(1, 2)
        covariance += inputs.step_var[k][:, :, None] * np.eye(STATE_SIZE)
    return out


def _propagate(state: Array, inputs: FilterInputs, k: int) -> tuple[Array, Array]:
    """Return (B, 5) states at the next keyframe and the (B, 5, 5) Jacobian."""
    seconds = inputs.step_s[k]
    own_turn = inputs.own_turn_rad[k] - seconds * state[:, 3]
    peer_turn = inputs.peer_turn_rad[k] - seconds * state[:, 4]
    turned = rotate(rotation_matrix(state[:, 2]), inputs.peer_shift_m[k])
    back = rotation_matrix(-own_turn)
    after = state.copy()
    after[:, :2] = rotate(back, state[:, :2] + turned - inputs.own_shift_m[k])
    after[:, 2] += peer_turn - own_turn
    step = np.zeros((len(state), STATE_SIZE, STATE_SIZE))
    step[:, :2, :2] = back
    step[:, :2, 2] = rotate(back, turned @ QUARTER_TURN.T)
    step[:, :2, 3] = seconds[:, None] * (after[:, :2] @ QUARTER_TURN.T)
    step[:, [2, 3, 4], [2, 3, 4]] = 1.0
    step[:, 2, 3], step[:, 2, 4] = seconds, -seconds
    return after, step


def _update_ranges(
    state: Array, covariance: Array, inputs: FilterInputs, k: int, log_likelihood: Array
) -> None:
    """Update the filters with keyframe k's range, in place. Large innovations are down-weighted."""
    seen = np.isfinite(inputs.range_m[k])
    peer = rotate(rotation_matrix(state[:, 2]), inputs.peer_to_range_m[k])
    offset = state[:, :2] + peer - inputs.own_to_range_m[k]
    expected = np.sqrt((offset**2).sum(axis=1) + inputs.height_m[k] ** 2) + 1e-6
    towards = offset / expected[:, None]
    row = np.column_stack([towards, np.einsum("bi,bi->b", towards, peer @ QUARTER_TURN.T)])
    cross = rotate(covariance[..., :3], row)
    spread = np.einsum("bi,bi->b", row, cross[:, :3]) + inputs.range_var[k]
    innovation = np.where(seen, inputs.range_m[k] - expected, 0.0)
    size = np.abs(innovation) / np.sqrt(spread)
    softer = inputs.range_var[k] * np.maximum(1.0, size / MAX_INNOVATION_SIGMAS) ** 2
    log_likelihood -= seen * (0.5 * np.log(spread) + np.log1p(0.5 * size**2))
    spread += softer - inputs.range_var[k]
    gain = np.where(seen, 1 / spread, 0.0)[:, None] * cross
    state += gain * innovation[:, None]
    covariance -= gain[:, :, None] * cross[:, None, :]


def smooth_rts(filtered: FilterResult) -> tuple[Array, Array]:
    """Smooth the filtered states (RTS); return states (K, B, 5) and covariances (K, B, 5, 5)."""
    state, covariance = filtered.state.copy(), filtered.covariance.copy()
    for k in range(len(state) - 2, -1, -1):
        ahead = np.linalg.inv(filtered.prior_covariance[k + 1])
        gain = filtered.covariance[k] @ filtered.step[k].swapaxes(1, 2) @ ahead
        state[k] += rotate(gain, state[k + 1] - filtered.prior[k + 1])
        change = covariance[k + 1] - filtered.prior_covariance[k + 1]
        covariance[k] += gain @ change @ gain.swapaxes(1, 2)
    return state, covariance
