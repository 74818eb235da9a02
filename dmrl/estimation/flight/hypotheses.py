"""Initial guesses of a pair on the range circle, and mirrored copies of its solutions."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from dmrl.estimation.filters import keyframe_ekf
from dmrl.estimation.filters.camera_update import NO_UPDATES, CameraUpdates, repeat_updates
from dmrl.estimation.filters.keyframe_ekf import FilterInputs
from dmrl.estimation.model.odometry import QUARTER_TURN
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.levenberg_marquardt import is_same_solution

BEARING_COUNT, HEADING_COUNT = 12, 8
"""Number of bearings of the peer, and of headings for each bearing: 96 guesses. No record of how
the values were chosen."""
SCORING_S = 20.0
"""Time over which all guesses are filtered, seconds. No record of how the value was chosen."""
KEPT_GUESSES = 6
"""Number of guesses that are filtered to the end. No record of how the value was chosen."""
GUESS_STD: Array = np.array([0.35, 0.35, 0.45, 0.01, 0.01])
"""Initial standard deviations of x, y (m), psi (rad): roughly half the distance to the next guess.
Then those of both yaw rate biases, rad/s."""
DISTINCT_M, DISTINCT_RAD = 0.4, 0.5
"""Guesses closer than both are the same, metres and radians. No record of how the values were
chosen."""
MAX_PASS_M = 0.35
"""Largest distance of a pass that leaves the side of the peer open, metres. Two such passes enclose
a segment that may be mirrored. No record of how the value was chosen."""
MAX_MIRRORED_SEGMENTS = 4
"""Largest number of mirrored segments, shortest first. No record of how the value was chosen."""
MAX_FLIP_M, FLIP_WIDTH_M = 0.5, 0.4
"""Largest distance of a pass whose side is flipped, metres; and increase of the distance, metres,
at which the flip begins and ends. No record of how the values were chosen."""
MAX_FLIPS = 6
"""Largest number of flipped passes, nearest first. No record of how the value was chosen."""
COST_SCALE = 4.0
"""Cost difference at which a solution has 1 / e of the weight of the best one.

Costs differ by this much without reason, because the robust loss and the noise model are
approximations. No record of how the value was chosen."""


def range_circle_guesses(range_m: float, height_m: float) -> Array:
    """Return (96, 3) guesses x, y (m), psi (rad) of the peer around an observer.

    Parameters
    ----------
    range_m
        First range, metres.
    height_m
        Peer's height minus the observer's, metres.
    """
    radius = np.sqrt(max(range_m**2 - height_m**2, 0.05**2))
    bearing = np.repeat(np.arange(BEARING_COUNT) * 2 * np.pi / BEARING_COUNT, HEADING_COUNT)
    heading = np.tile(np.arange(HEADING_COUNT) * 2 * np.pi / HEADING_COUNT, BEARING_COUNT)
    # The headings of neighbouring bearings are half a step apart, which fills the space better.
    heading = (
        heading + np.repeat(np.arange(BEARING_COUNT) % 2, HEADING_COUNT) * np.pi / HEADING_COUNT
    )
    return np.column_stack([radius * np.cos(bearing), radius * np.sin(bearing), heading])


def select_guesses(
    inputs: FilterInputs, rate_hz: float, updates: CameraUpdates = NO_UPDATES
) -> Array:
    """Select the likely and distinct guesses of P pairs, (P, KEPT_GUESSES, 3), best first.

    Parameters
    ----------
    inputs
        Filter inputs of P pairs.
    rate_hz
        Keyframes per second.
    updates
        Camera updates of each pair.
    """
    keyframes = min(len(inputs.range_m), int(SCORING_S * rate_hz))
    first = [_pair_guesses(inputs, pair, keyframes) for pair in range(inputs.range_m.shape[1])]
    count = BEARING_COUNT * HEADING_COUNT
    given = inputs.repeat(count, keyframes), np.concatenate(first), GUESS_STD
    run = keyframe_ekf.run_filters(*given, repeat_updates(updates, count))
    end = run.state[-1, :, :3].reshape(-1, count, 3)
    score = run.log_likelihood.reshape(-1, count)
    begun = np.stack(first)
    return np.stack(
        [
            b[select_distinct_states(e, np.argsort(-s), KEPT_GUESSES)]
            for b, e, s in zip(begun, end, score, strict=True)
        ]
    )


def _pair_guesses(inputs: FilterInputs, pair: int, keyframes: int) -> Array:
    """Return the guesses of one pair, from its first ranges."""
    ranges = inputs.range_m[:keyframes, pair]
    seen = np.flatnonzero(np.isfinite(ranges))
    # The median of the first second: a single first range may be an outlier.
    start = float(np.median(ranges[seen[:10]])) if len(seen) else 1.0
    return range_circle_guesses(start, float(inputs.height_m[seen[0], pair]) if len(seen) else 0.0)


def select_distinct_states(states: Array, order: NDArray[np.intp], count: int) -> list[int]:
    """Return the indices of ``count`` distinct states, in order. The last one fills up the rest.

    Parameters
    ----------
    states
        (N, 3) x, y, psi.
    order
        (N,) their indices, best first.
    count
        Number of indices to return.
    """
    kept: list[int] = []
    for number in order.tolist():
        apart = [not is_same_state(states[number], states[other]) for other in kept]
        if all(apart):
            kept.append(number)
        if len(kept) == count:
            break
    return kept + kept[-1:] * (count - len(kept))


def is_same_state(one: Array, other: Array) -> bool:
    """Return whether two states are the same solution."""
    turn = np.angle(np.exp(1j * (one[2] - other[2])))
    return bool(np.hypot(*(one - other)[:2]) < DISTINCT_M and abs(turn) < DISTINCT_RAD)


def between_solution_covariance(cost: Array, states: Array) -> Array:
    """Return the (K, 3, 3) covariance that the choice between solutions adds to the best one.

    Parameters
    ----------
    cost
        (S,) cost of each, lowest first: half the sum of squares, or the negative log likelihood.
    states
        (S, K, 3) x, y (m), psi (rad).
    """
    kept: list[int] = []
    for number, state in enumerate(states):
        if not any(is_same_solution(state, states[other]) for other in kept):
            kept.append(number)
    share = np.exp((cost[0] - cost[kept]) / COST_SCALE)
    apart = states[kept] - states[0]
    apart[:, :, 2] = np.angle(np.exp(1j * apart[:, :, 2]))
    return np.asarray(np.einsum("s,ski,skj->kij", share / share.sum(), apart, apart))


def _find_passes(state: Array, rate_hz: float, within_m: float) -> tuple[Array, NDArray[np.intp]]:
    """Return (K,) distances of the peer, and the keyframes of local minima within a distance."""
    distance = np.hypot(*state[:, :2].T)
    least = minimum_filter1d(distance, 2 * round(rate_hz) + 1)
    return distance, np.flatnonzero((distance == least) & (distance < within_m))


def mirror_guesses(state: Array, rate_hz: float) -> list[Array]:
    """Mirror a solution between two close passes; return one copy for each such segment.

    Parameters
    ----------
    state
        (K, 6) x, y (m), psi (rad), wx, wy (m/s), b (m).
    rate_hz
        Keyframes per second.
    """
    second, (_, passes) = round(rate_hz), _find_passes(state, rate_hz, MAX_PASS_M)
    between = sorted(pairwise(passes.tolist()), key=lambda ends: ends[1] - ends[0])
    out = []
    for start, end in between[:MAX_MIRRORED_SEGMENTS]:
        way = state[min(end + second // 2, len(state) - 1), :2] - state[end - second // 2, :2]
        aside = QUARTER_TURN @ way / max(float(np.hypot(*way)), 1e-6)
        copy = state.copy()
        # p - 2 (n p) n mirrors at the line of motion: it keeps the ranges and changes the odometry.
        copy[start:end, :2] -= 2 * np.outer(copy[start:end, :2] @ aside, aside)
        out.append(copy)
    return out


def flip_pass(state: Array, rate_hz: float) -> list[Array]:
    """Flip the side of each close pass; return one copy of the solution for each pass.

    Parameters
    ----------
    state
        (K, 6) x, y (m), psi (rad), wx, wy (m/s), b (m).
    rate_hz
        Keyframes per second.
    """
    distance, passes = _find_passes(state, rate_hz, MAX_FLIP_M)
    out = []
    for at in passes[np.argsort(distance[passes])].tolist():
        farther = np.flatnonzero(distance > distance[at] + FLIP_WIDTH_M)
        start = int(farther[farther < at].max(initial=-1)) + 1
        end = int(farther[farther > at].min(initial=len(state)))
        way = state[min(at + 2, len(state) - 1), :2] - state[max(at - 2, 0), :2]
        aside = QUARTER_TURN @ way / max(float(np.hypot(*way)), 1e-6)
        # Fully mirrored at the closest point and gradually less away from it, without a jump.
        near = np.cos((distance[start:end] - distance[at]) / FLIP_WIDTH_M * np.pi / 2)
        copy = state.copy()
        copy[start:end, :2] -= np.outer(2 * near * (copy[start:end, :2] @ aside), aside)
        out.append(copy)
    return out
