"""Estimate relative positions of many pairs with covariance and status: the entry point."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter, uniform_filter1d

from dmrl.estimation.filters import ekf
from dmrl.estimation.flight.pair_solver import (
    PairSolution,
    relative_modes,
    solve_pair,
    squared_distances,
)
from dmrl.estimation.flight.windows import carry_information, split_windows
from dmrl.estimation.model.bearings import ASSOCIATION_GATE
from dmrl.estimation.model.gate import GATE_M
from dmrl.estimation.model.odometry import rotate, rotation_matrix
from dmrl.estimation.model.pair import MAX_DROPOUT_S, Array, Mask, Pair
from dmrl.estimation.model.status import (
    AMBIGUOUS,
    OK,
    UNCONVERGED,
    Statuses,
    classify_positions,
)
from dmrl.estimation.search.hypotheses import follow_hypotheses
from dmrl.estimation.search.modes import coarsen, place_peer
from dmrl.estimation.signals.contradictions import drop_contradictions
from dmrl.estimation.solver.covariance import (
    calm_motion,
    compute_covariance,
    odometry_energy,
    relative_covariance,
)
from dmrl.estimation.solver.estimate import (
    PAIR_LAYOUT,
    Estimate,
    RejectionReason,
    seen_from_peer,
)
from dmrl.estimation.solver.keyframes import (
    NoiseModel,
    Problem,
    build_problem,
    odometry_dropout,
    range_dropout,
)
from dmrl.estimation.solver.levenberg_marquardt import Carried, Solver, relative_path
from dmrl.estimation.solver.residuals import Values, odometry_factor, range_factor

OUTPUT_HZ = 10.0
"""Rate of the estimates, Hz: positions between keyframes follow the odometry."""
SIGMA_INFLATION = 1.1
"""Factor on the sigmas of a solution: no sensor has exactly the noise of its model. Chosen on 42
simulated flights of 100 s: in every group at least 95 % of the positions are in the 95 % ellipse.
"""
GATE_SIGMA_FACTOR = 0.75
"""Factor on the written sigmas that the gate uses."""
CONTRADICTED_SIGMAS, CONTRADICTED_RANGE_SIGMAS = 15.0, 3.0
"""Odometry that differs from the solution by more has dropped out for the status, in sigmas; and so
has a second in which most ranges differ by more."""
RANGE_MEDIAN, RANGE_MARGIN_M = 21, 0.5
"""Number of ranges in the median that bounds a position; and margin of that bound, metres."""
MIN_MOTION_ENERGY = 1.0
"""Smallest energy of a motion that makes the bearing observable, relative to that of the odometry
noise over a second: 0.06 m/s with the default noise, 0.04 m/s with calibrated sensors."""
MIN_CAMERA_S = 3.0
"""Shortest time with consistent images that replaces motion, seconds."""
SMOOTHER_SIGMA_INFLATION = 1.5
"""Factor on the sigmas of the smoother, whose track is no minimum of the cost."""
MAJORITY_SHARE = 0.5
"""Share of a flight that determines the reason for its rejection."""


def estimate_pairs(
    pairs: Sequence[Pair],
    method: Literal["batch", "smoother"] = "batch",
    *,
    noise: NoiseModel | None = None,
    gate_m: float = GATE_M,
) -> list[tuple[Estimate, Estimate]]:
    """Estimate both directions of several pairs: peer by observer, and observer by peer.

    Parameters
    ----------
    pairs
        Any number of pairs.
    method
        The batch solve, or the filter and smoother that provide its first guesses.
    noise
        Noise model of the sensors. None: selected for each flight.
    gate_m
        Largest error of a good position, metres.
    """
    out = []
    for logged in pairs:
        pair = drop_contradictions(logged)
        if method == "smoother":
            pieces = [_smooth_piece(pair, noise)]
        else:
            pieces = list(_solve_pieces(pair, noise))
        out.append(_both_directions(pair, pieces, gate_m))
    return out


class Piece(NamedTuple):
    """Estimate of a window, without statuses.

    ``silent`` (K,) dropouts of odometry or contradictory odometry, ``sighted`` (2, K) consistent
    images of either robot nearby, ``energy`` (3,) mean squares of the own, peer and relative
    velocity without noise, relative to that noise.
    """

    estimate: Estimate
    silent: Mask
    sighted: Mask
    energy: Array


def _solve_pieces(pair: Pair, noise: NoiseModel | None) -> Iterator[Piece]:
    """Yield the estimates of the windows of a flight."""
    carried: Carried | None = None
    for window in split_windows(float(pair.time_s[0]), float(pair.time_s[-1])):
        part = pair.crop(window.start_s, window.end_s)
        solution = solve_pair(build_problem({(0, 1): part}), noise, carried)
        times = output_times(pair.time_s[0], window.from_s, window.until_s)
        yield _to_piece(solution, part, times)
        if not window.is_last:
            solver = Solver(solution.problem, solution.carried)
            carried = carry_information(solver, solution.values, window.next_s)


def _to_piece(solution: PairSolution, pair: Pair, time_s: Array) -> Piece:
    """Return the estimate of a solved window at some times."""
    problem, values, key_s = solution.problem, solution.values, solution.problem.keyframe_s
    spread = relative_covariance(values.state, solution.keyframes) * SIGMA_INFLATION**2
    spread = spread + solution.between_modes(relative_modes(solution))
    state = interpolate_states(problem, values.state, time_s)
    error = problem.layout.state_column("range_error", 0, 1)
    covariances = solution.keyframes, solution.constants
    heights, height_std = height_errors(problem, values, covariances, (0, 1))
    estimate = Estimate(
        time_s,
        relative_path(state),
        interpolate_at(time_s, key_s, spread),
        np.zeros(len(time_s), np.int8),
        values.constants,
        problem.noise,
        problem.layout,
        interpolate_at(time_s, key_s, heights),
        interpolate_at(time_s, key_s, height_std),
        None if error is None else np.interp(time_s, key_s, values.state[:, error]),
        constants_covariance=solution.constants,
        modes=len(solution.modes),
    )
    step = np.clip(np.searchsorted(key_s, time_s, "right") - 1, 0, len(key_s) - 2)
    silent = odometry_dropout(pair, time_s) | find_contradicted_steps(problem, values)[step]
    return Piece(estimate, silent, _sighted(solution, time_s), motion_energy(problem, values))


def find_contradicted_steps(problem: Problem, values: Values) -> Mask:
    """Return (S,) the steps at which odometry or most ranges contradict the solution.

    The half second around them counts too.

    Parameters
    ----------
    problem, values
        Flight and its solution.
    """
    layout, wrong = problem.layout, np.zeros(len(problem.keyframe_s) - 1, bool)
    for robot in range(len(problem.robots)):
        rows = odometry_factor(problem, layout, robot, values)
        wrong |= (rows.square > CONTRADICTED_SIGMAS**2).any(axis=1)
    for k, (_, row) in enumerate(layout.states):
        if row.motion and row.evolution == "fading":
            error = np.abs(values.state[:, 3 * layout.robots + k]) / (row.std * problem.noise.grade)
            wrong |= np.maximum(error[1:], error[:-1]) > CONTRADICTED_SIGMAS
    around = round(MAX_DROPOUT_S / float(np.median(np.diff(problem.keyframe_s))))
    for link in problem.links:
        found = range_factor(problem, layout, link, values)
        far = (found.weight * (found.square > CONTRADICTED_RANGE_SIGMAS**2)).sum(axis=1)
        near = found.weight.sum(axis=1) - far
        excess = uniform_filter1d(far - near, 2 * around + 1, mode="constant")
        wrong |= np.maximum(excess[1:], excess[:-1]) > 0
    return np.asarray(maximum_filter1d(wrong, 2 * around + 1))


def _smooth_piece(pair: Pair, noise: NoiseModel | None) -> Piece:
    """Return the estimate of the likeliest track of the filter and smoother."""
    problem = build_problem({(0, 1): pair})
    problem = replace(problem, noise=noise or problem.noise)
    coarse = coarsen(problem)
    best = follow_hypotheses(problem)[0]
    values = place_peer(coarse, best.pose, best.gyro_bias_radps)
    keyframes, _ = compute_covariance(Solver(coarse), values)
    spread = relative_covariance(values.state, keyframes) * SMOOTHER_SIGMA_INFLATION**2
    time_s = output_times(pair.time_s[0], pair.time_s[0], pair.time_s[-1])
    states = relative_path(interpolate_states(coarse, values.state, time_s))
    none, zeros = np.zeros(len(time_s), np.int8), np.zeros(len(PAIR_LAYOUT.constants))
    covariance = interpolate_at(time_s, problem.keyframe_s, spread)
    estimate = Estimate(time_s, states, covariance, none, zeros, problem.noise)
    unseen = np.zeros((2, len(time_s)), bool)
    energy = motion_energy(problem, values)
    return Piece(estimate, odometry_dropout(pair, time_s), unseen, energy)


def output_times(zero_s: float, from_s: float, until_s: float) -> Array:
    """Return the times of estimates in an interval, on a grid that begins at ``zero_s``."""
    first = int(np.ceil((from_s - zero_s) * OUTPUT_HZ - 1e-6))
    last = int(np.floor((until_s - zero_s) * OUTPUT_HZ + 1e-6))
    return np.asarray(zero_s + np.arange(first, last + 1) / OUTPUT_HZ)


def interpolate_states(problem: Problem, state: Array, time_s: Array) -> Array:
    """Return (T, 3 N) poses of all robots at any times, by odometry from both keyframes around."""
    key_s = problem.keyframe_s
    low = np.clip(np.searchsorted(key_s, time_s, "right") - 1, 0, len(key_s) - 2)
    share = ((time_s - key_s[low]) / np.diff(key_s)[low])[:, None]
    out = np.zeros((len(time_s), 3 * len(problem.robots)))
    for robot, steps in enumerate(problem.robots):
        mine = slice(3 * robot, 3 * robot + 3)
        for key, part in ((low, 1 - share), (low + 1, share)):
            pose, moved = state[key, mine], steps.path.relative_motion(key_s[key], time_s)
            xy = pose[:, :2] + rotate(rotation_matrix(pose[:, 2]), moved.shift_m)
            out[:, mine] += part * np.column_stack([xy, pose[:, 2] + moved.turn_rad])
    return out


def interpolate_at(time_s: Array, key_s: Array, values: Array) -> Array:
    """Interpolate (K, ...) values at times."""
    flat = values.reshape(len(key_s), -1)
    columns = [np.interp(time_s, key_s, column) for column in flat.T]
    return np.column_stack(columns).reshape(-1, *values.shape[1:])


def height_errors(
    problem: Problem, values: Values, covariances: tuple[Array, Array], both: tuple[int, int]
) -> tuple[Array, Array]:
    """Return (K,) errors of the height difference of two robots, and their standard deviations.

    Parameters
    ----------
    problem, values
        Flight and its solution.
    covariances
        (K, n, n) and (G, G) of keyframes and constants.
    both
        Observer and peer.
    """
    error, variance = np.zeros(len(values.state)), np.zeros(len(values.state))
    for row, c, constant, side in problem.layout.measured(both, "height"):
        value = values.constants[c] if constant else values.state[:, c]
        error = error - side * row.height * value
        variance = variance + row.height**2 * covariances[constant][..., c, c]
    return error, np.sqrt(variance)


def _sighted(solution: PairSolution, time_s: Array) -> Mask:
    """Return (2, T) whether an image of either robot near a time is consistent."""
    out = np.zeros((2, len(time_s)), bool)
    for view in solution.problem.views:
        squared = squared_distances(solution.problem, view, solution.values)
        at_s = np.concatenate([[-np.inf], view.time_s[squared < ASSOCIATION_GATE], [np.inf]])
        after = np.searchsorted(at_s, time_s)
        near = np.minimum(at_s[after] - time_s, time_s - at_s[after - 1])
        out[view.robots[0]] |= near <= MAX_DROPOUT_S
    return out


def motion_energy(problem: Problem, values: Values, one: int = 0, other: int = 1) -> Array:
    """Return (3,) energies of the own, peer and relative motion, relative to the odometry noise."""
    state = calm_motion(problem, values.state)
    here, there = (state[:, 3 * k : 3 * k + 2] for k in (one, other))
    relative = np.diff(there - here, axis=0) / np.diff(problem.keyframe_s)[:, None]
    energy = (relative**2).sum(axis=1).mean() / problem.velocity_psd
    return np.array([odometry_energy(problem, one), odometry_energy(problem, other), energy])


def _both_directions(
    pair: Pair, pieces: Sequence[Piece], gate_m: float
) -> tuple[Estimate, Estimate]:
    """Return the estimates of both robots, with their statuses."""
    joined = join_pieces(pieces)
    estimate, far = clip_to_ranges(pair, joined.estimate)
    # Consistent images replace missing ranges.
    quiet = range_dropout(pair, estimate.time_s) & ~joined.sighted.any(axis=0)
    floor = joined.silent | quiet | far
    own, peer, relative = joined.energy
    enough = [bool(at.sum() >= MIN_CAMERA_S * OUTPUT_HZ) for at in joined.sighted]
    return (
        with_status(estimate, floor, (own, relative), gate_m, sighted=enough[0]),
        with_status(seen_from_peer(estimate), floor, (peer, relative), gate_m, sighted=enough[1]),
    )


def join_pieces(pieces: Sequence[Piece]) -> Piece:
    """Join the windows of a flight."""
    made = join_estimates([piece.estimate for piece in pieces])
    first = _first_samples([piece.estimate for piece in pieces])
    silent = np.concatenate([p.silent[k:] for p, k in zip(pieces, first, strict=True)])
    sighted = np.concatenate([p.sighted[:, k:] for p, k in zip(pieces, first, strict=True)], axis=1)
    return Piece(made, silent, sighted, np.mean([p.energy for p in pieces], axis=0))


def _first_samples(estimates: Sequence[Estimate]) -> list[int]:
    """Return the first sample of each window that is not in the window before."""
    return [0, *[int(a.time_s[-1] >= b.time_s[0] - 1e-6) for a, b in pairwise(estimates)]]


def join_estimates(estimates: Sequence[Estimate]) -> Estimate:
    """Join the estimates of the windows of a flight. The constants are those of the last one."""
    first = _first_samples(estimates)

    def join(name: str) -> Any:
        values = [getattr(one, name) for one in estimates]
        if any(value is None for value in values):
            return None
        return np.concatenate([v[k:] for v, k in zip(values, first, strict=True)])

    names = ("time_s", "state", "covariance", "status", "height_m", "height_std_m", "range_error_m")
    modes = max(one.modes for one in estimates)
    return replace(estimates[-1], **{name: join(name) for name in names}, modes=modes)


def with_status(
    estimate: Estimate,
    silent: Mask,
    energy: tuple[float, float],
    gate_m: float,
    *,
    sighted: bool = False,
) -> Estimate:
    """Return an estimate with its statuses and, if no position is OK, the reason.

    Parameters
    ----------
    estimate
        Estimate of a pair.
    silent
        (K,) whether a sensor of either robot, or their ranges, dropped out.
    energy
        Energies of the observer's and of the relative motion, relative to the odometry noise.
    gate_m
        Largest error of a good position, metres.
    sighted
        Whether the observer's camera shows the bearing, whatever the motion.
    """
    status = classify_positions(estimate.state, estimate.covariance * GATE_SIGMA_FACTOR**2, gate_m)
    status = np.maximum(status, silent * np.int8(UNCONVERGED))
    if min(energy) < MIN_MOTION_ENERGY and not sighted:
        status[:] = AMBIGUOUS
    refused = _find_rejection_reason(status, energy, bool(silent.mean() > MAJORITY_SHARE))
    return replace(estimate, status=status, rejection_reason=refused)


def _find_rejection_reason(
    status: Statuses, energy: tuple[float, float], silent: bool
) -> RejectionReason | None:
    """Return the reason why no position is OK; None if any is."""
    if (status == OK).any():
        return None
    if silent:
        return "silent"
    if (status == AMBIGUOUS).mean() <= MAJORITY_SHARE:
        return "imprecise"
    own, relative = energy
    if own < MIN_MOTION_ENERGY:
        return "still"
    return "alike" if relative < MIN_MOTION_ENERGY else "open"


def clip_to_ranges(pair: Pair, estimate: Estimate) -> tuple[Estimate, Mask]:
    """Clip an estimate to the distance that the ranges allow, and return where it exceeded it."""
    if not len(pair.range_m):
        return estimate, np.zeros(len(estimate.time_s), bool)
    smooth_m = median_filter(pair.range_m, RANGE_MEDIAN, mode="nearest")
    near = np.searchsorted(pair.range_time_s, estimate.time_s)
    reach = RANGE_MEDIAN // 2
    around = np.clip(near[:, None] + [-reach, 0, reach], 0, len(smooth_m) - 1)
    reach_m = smooth_m[around].max(axis=1) + RANGE_MARGIN_M
    distance = np.hypot(*estimate.state[:, :2].T)
    far = distance > reach_m
    state = estimate.state.copy()
    state[far, :2] *= (reach_m[far] / distance[far])[:, None]
    return replace(estimate, state=state), far


def estimate_ekf(pairs: list[Pair], preset: str, *, gate_m: float = GATE_M) -> list[Estimate]:
    """Estimate pairs with the published filter, at every step of their time grids.

    Parameters
    ----------
    pairs
        Any number of pairs.
    preset
        One of ``ekf.PRESETS``.
    gate_m
        As in `estimate_pairs`.
    """
    out = []
    for pair in pairs:
        steps = ekf.build_steps(pair, ekf.PRESETS[preset])
        state, spread = ekf.filter_many(steps, ekf.PRESETS[preset])
        none, constants = np.zeros(len(state), np.int8), np.zeros(len(PAIR_LAYOUT.constants))
        made = Estimate(pair.time_s, state[:, 0], spread[:, 0], none, constants, NoiseModel())
        status = classify_positions(made.state, made.covariance, gate_m)
        out.append(replace(made, status=status))
    return out
