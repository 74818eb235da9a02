"""Output of a pair's estimate: at the output times, joined, and with a status."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.ndimage import median_filter

from dmrl.estimation.evidence.causes import join_causes, join_innovations
from dmrl.estimation.flight.pair_solver import WindowSolution, squared_distances
from dmrl.estimation.model.bearings import ASSOCIATION_GATE
from dmrl.estimation.model.gate import Gate
from dmrl.estimation.model.odometry import rotate, rotation_matrix
from dmrl.estimation.model.pair import MAX_DROPOUT_S, Array, Mask, Pair
from dmrl.estimation.model.status import AMBIGUOUS, OK, UNCONVERGED, Statuses, classify_positions
from dmrl.estimation.signals.contradictions import count_median
from dmrl.estimation.solver.covariance import (
    MIN_MOTION_ENERGY,
    Covariances,
    calm_motion,
    odometry_energy,
)
from dmrl.estimation.solver.estimate import REASONS, Cause, Estimate
from dmrl.estimation.solver.keyframes import sum_ways
from dmrl.estimation.solver.levenberg_marquardt import relative_path
from dmrl.estimation.solver.problem import Problem
from dmrl.estimation.solver.residuals import Values

OUTPUT_HZ = 10.0
"""Rate of the estimates, Hz: positions between keyframes follow the odometry."""


SIGMA_FACTOR_S, SIGMA_FACTOR = (20.0, 60.0), (0.8, 1.0)
"""Lengths of a flight, seconds, and the factors on its sigmas, interpolated between them. Chosen on
66 simulated flights without a fault: the judge's sound set, seeds 8000 to 8205."""


RANGE_MARGIN_M = 0.5
"""Margin of the distance that the ranges allow, metres."""


MISFIT_MARGIN_S = 30.0
"""Time around a stretch that does not fit that is refused too, seconds: the error bends the
solution as far as the smoother remembers, 25 s. Chosen on 6 flights with unlisted faults, seed
62001."""
CAMERA_SIGNALS = ("bearing", "height")
"""Signals of an image: where they do not fit, images do not end the error."""


MAJORITY_SHARE = 0.5
"""Share of a flight that determines the reason for its rejection."""
MIN_KEPT_SHARE = 0.1
"""Smallest share of a flight that is kept. Ten of 100 s are one stretch of correlated errors, which
is wrong as a whole or not at all: no share of bad positions can be promised. Ten of 240 faulty
flights of the judge kept less, with 425 of 1,752 positions bad."""


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


def mix_members(
    solution: WindowSolution, time_s: Array, both: tuple[int, int] = (0, 1)
) -> tuple[Array, Array]:
    """Return (T, 3) means and (T, 3, 3) covariances of the peer's pose over all likely solutions.

    Parameters
    ----------
    solution
        Solutions under likely models.
    time_s
        (T,) times, seconds.
    both
        Observer and peer.
    """
    states, spreads = [], []
    for member, covariances in zip(solution.mixture.members, solution.covariances, strict=True):
        problem, state = member.solver.problem, member.values.state
        states.append(relative_path(interpolate_states(problem, state, time_s), *both))
        spread = covariances.relative(state, *both)
        spreads.append(interpolate_at(time_s, problem.keyframe_s, spread))
    weight, apart = solution.mixture.weight, np.stack(states) - states[0]
    apart[..., 2] = np.angle(np.exp(1j * apart[..., 2]))
    mean = np.tensordot(weight, apart, 1)
    apart -= mean
    between = np.einsum("m,mki,mkj->kij", weight, apart, apart)
    covariance = np.tensordot(weight, np.stack(spreads), 1) + between
    key_s = solution.problem.keyframe_s
    factor = float(np.interp(key_s[-1] - key_s[0], SIGMA_FACTOR_S, SIGMA_FACTOR))
    return states[0] + mean, np.asarray(covariance * factor**2)


def interpolate_at(time_s: Array, key_s: Array, values: Array) -> Array:
    """Interpolate (K, ...) values at times."""
    flat = values.reshape(len(key_s), -1)
    columns = [np.interp(time_s, key_s, column) for column in flat.T]
    return np.column_stack(columns).reshape(-1, *values.shape[1:])


def height_errors(
    problem: Problem, values: Values, covariances: Covariances, both: tuple[int, int]
) -> tuple[Array, Array]:
    """Return (K,) errors of the height difference of two robots, and their standard deviations.

    Parameters
    ----------
    problem, values
        Flight and its solution.
    covariances
        Covariances of the solution.
    both
        Observer and peer.
    """
    error, variance = np.zeros(len(values.state)), np.zeros(len(values.state))
    for row, c, constant, side in problem.layout.measured(both, "height"):
        value = values.constants[c] if constant else values.state[:, c]
        error = error - side * row.height * value
        spread = covariances.constants if constant else covariances.keyframes
        variance = variance + row.height**2 * spread[..., c, c]
    return error, np.sqrt(variance)


def mix_clocks(solution: WindowSolution, time_s: Array) -> tuple[Array, Array]:
    """Return (T,) mean offsets of the second robot's clock over all solutions, and variances.

    Parameters
    ----------
    solution
        Solutions under likely models.
    time_s
        (T,) times, seconds.
    """
    offsets, variances = [], []
    for member, covariances in zip(solution.mixture.members, solution.covariances, strict=True):
        problem, values = member.solver.problem, member.values
        offset, variance = np.zeros((2, len(values.state)))
        for row, c, constant in problem.layout.of(1):
            if row.owner == "clock":
                offset += values.constants[c] if constant else values.state[:, c]
                spread = covariances.constants if constant else covariances.keyframes
                variance += spread[..., c, c]
        offsets.append(np.interp(time_s, problem.keyframe_s, offset))
        variances.append(np.interp(time_s, problem.keyframe_s, variance))
    weight = solution.mixture.weight
    mean = weight @ np.stack(offsets)
    return mean, weight @ (np.stack(variances) + (np.stack(offsets) - mean) ** 2)


def to_peer_clock(estimate: Estimate) -> Estimate:
    """Return an estimate at the times of a clock of which the offset is uncertain.

    The offset is that of the robot which observes in ``estimate``.
    """
    if estimate.clock_s is None or estimate.clock_variance is None:
        return estimate
    velocity = np.gradient(estimate.state[:, :2], estimate.time_s, axis=0)
    covariance = estimate.covariance.copy()
    outer = velocity[:, :, None] * velocity[:, None, :]
    covariance[:, :2, :2] += estimate.clock_variance[:, None, None] * outer
    # A clock that jumps back shows some times twice.
    time_s = np.maximum.accumulate(estimate.time_s + estimate.clock_s)
    return replace(estimate, time_s=time_s, covariance=covariance)


def list_sighted(solution: WindowSolution, time_s: Array) -> Mask:
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

    names = ("time_s", "state", "covariance", "status", "height_m", "height_std_m", "range_error_m",
             "clock_s", "clock_variance")  # fmt: skip
    modes = max(one.modes for one in estimates)
    causes = join_causes([cause for one in estimates for cause in one.causes])
    innovations = join_innovations([one.innovations for one in estimates])
    return replace(
        estimates[-1],
        **{name: join(name) for name in names},
        modes=modes,
        causes=causes,
        innovations=innovations,
    )


def with_status(
    estimate: Estimate,
    silent: Mask,
    energy: tuple[float, float],
    gate: Gate,
    *,
    sighted: bool = False,
    placed: Mask | None = None,
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
    gate
        Gate of the positions.
    sighted
        Whether the observer's camera shows the bearing, whatever the motion.
    placed
        As in `list_refused`.
    """
    status = classify_positions(estimate.state, estimate.covariance, gate)
    status = np.maximum(status, silent * np.int8(UNCONVERGED))
    if min(energy) < MIN_MOTION_ENERGY and not sighted:
        status[:] = AMBIGUOUS
    causes = estimate.causes
    refused = list_refused(estimate, placed)
    status = np.maximum(status, refused * np.int8(UNCONVERGED))
    if (status == OK).mean() < MIN_KEPT_SHARE:
        status = np.maximum(status, np.int8(UNCONVERGED))
    if not (status == OK).any() and refused.mean() <= MAJORITY_SHARE:
        span = float(estimate.time_s[0]), float(estimate.time_s[-1])
        name, robot = _find_reason(status, energy, bool(silent.mean() > MAJORITY_SHARE))
        causes = (*causes, Cause(name, 1.0, *span, robot))
    return replace(estimate, status=status, causes=causes)


def list_refused(estimate: Estimate, placed: Mask | None = None) -> Mask:
    """Return (K,) whether a cause refuses the positions.

    Parameters
    ----------
    estimate
        Estimate of a pair.
    placed
        (K,) whether a consistent image of either robot is near: the error of another sensor bends
        the solution no farther. None: nowhere.
    """
    time_s, out = estimate.time_s, np.zeros(len(estimate.time_s), bool)
    for cause in estimate.causes:
        if not cause.refuses:
            continue
        from_s, to_s = cause.from_s - MISFIT_MARGIN_S, cause.to_s + MISFIT_MARGIN_S
        if placed is not None and not cause.name.startswith(CAMERA_SIGNALS):
            from_s = max([from_s, *time_s[placed & (time_s < cause.from_s)][-1:]])
            to_s = min([to_s, *time_s[placed & (time_s > cause.to_s)][:1]])
        out |= (time_s >= from_s) & (time_s <= to_s)
    return out


def _find_reason(
    status: Statuses, energy: tuple[float, float], silent: bool
) -> tuple[str, int | None]:
    """Return the reason why no position is OK, and the robot that it concerns."""
    if silent:
        return REASONS["silent"], None
    if (status == AMBIGUOUS).mean() <= MAJORITY_SHARE:
        return REASONS["imprecise"], None
    own, relative = energy
    if own < MIN_MOTION_ENERGY:
        return REASONS["still"], 0
    return REASONS["alike" if relative < MIN_MOTION_ENERGY else "open"], None


def clip_to_ranges(pair: Pair, estimate: Estimate) -> tuple[Estimate, Mask]:
    """Clip an estimate to the distance that the ranges allow, and return where it exceeded it."""
    if not len(pair.range_m):
        return estimate, np.zeros(len(estimate.time_s), bool)
    count, time_s = count_median(pair), estimate.time_s
    smooth_m = median_filter(pair.range_m, count, mode="nearest")
    near = np.searchsorted(pair.range_time_s, time_s)
    around = np.clip(near[:, None] + [-(count // 2), 0, count // 2], 0, len(smooth_m) - 1)
    # Between ranges, the distance grows at most as fast as both robots fly.
    range_s, way_m = pair.range_time_s, sum_ways(pair)
    beside = np.clip(np.stack([near - 1, near]), 0, len(range_s) - 1)
    moved_m = np.interp(range_s[beside], pair.time_s, way_m) - np.interp(time_s, pair.time_s, way_m)
    grown_m = (smooth_m[beside] + np.abs(moved_m)).min(axis=0)
    reach_m = np.maximum(smooth_m[around].max(axis=1), grown_m) + RANGE_MARGIN_M
    distance = np.hypot(*estimate.state[:, :2].T)
    far = distance > reach_m
    state = estimate.state.copy()
    state[far, :2] *= (reach_m[far] / distance[far])[:, None]
    return replace(estimate, state=state), far
