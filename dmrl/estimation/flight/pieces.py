"""Solve the windows of a pair: estimates without statuses, and what they rest on."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d, uniform_filter1d
from scipy.special import chdtrc, erfc

from dmrl.estimation.evidence.causes import find_causes
from dmrl.estimation.evidence.delays import Delay, find_delay
from dmrl.estimation.evidence.error_models import Candidate
from dmrl.estimation.evidence.goodness_of_fit import check_fit
from dmrl.estimation.flight.pair_output import (
    _first_samples,
    height_errors,
    interpolate_at,
    join_estimates,
    list_sighted,
    mix_clocks,
    mix_members,
    motion_energy,
    output_times,
)
from dmrl.estimation.flight.pair_solver import WindowSolution, solve_pair
from dmrl.estimation.flight.windows import carry_information, split_windows
from dmrl.estimation.model.pair import MAX_DROPOUT_S, Array, Mask, Pair
from dmrl.estimation.solver.estimate import Estimate
from dmrl.estimation.solver.keyframes import build_problem, odometry_dropout
from dmrl.estimation.solver.priors import Carried
from dmrl.estimation.solver.problem import NoiseModel, Problem
from dmrl.estimation.solver.residuals import Values, odometry_factor, range_factor
from dmrl.estimation.solver.robust_loss import Gaussian
from dmrl.estimation.solver.unknowns import TABLE
from dmrl.guards.memory import return_freed_memory

CONTRADICTED_SIGMAS, CONTRADICTED_RANGE_SIGMAS = 15.0, 3.0
"""Odometry that differs from the solution by more has dropped out for the status, in sigmas; and so
has a second in which most ranges differ by more."""
SHARED_NAMES = {row.name for row in TABLE}
"""Names of the unknowns of the plain model, which both directions of a pair report."""


class Piece(NamedTuple):
    """Estimate of a window, without statuses.

    ``silent`` (K,) dropouts of odometry or contradictory odometry, ``sighted`` (2, K) consistent
    images of either robot nearby, ``energy`` (3,) mean squares of the own, peer and relative
    velocity without noise, relative to that noise; ``chance`` the probability of larger constants
    by their priors, ``delay`` of a signal that is probably late.
    """

    estimate: Estimate
    silent: Mask
    sighted: Mask
    energy: Array
    chance: float = 1.0
    delay: Delay | None = None


def solve_pieces(
    pair: Pair, noise: NoiseModel | None, late: Sequence[Candidate] = (), *, plain: bool
) -> Iterator[Piece]:
    """Yield the estimates of the windows of a flight.

    Parameters
    ----------
    pair
        Sensor data of both robots.
    noise
        Noise model of the sensors. None: selected for each window.
    late
        Models of signals that were moved, whose delays are unknown further on.
    plain
        Without error models beyond the plain one.
    """
    carried: Carried | None = None
    for window in split_windows(float(pair.time_s[0]), float(pair.time_s[-1])):
        return_freed_memory()  # of the signals of the whole flight, and of the window before
        part = pair.crop(window.start_s, window.end_s)
        problem = build_problem({(0, 1): part})
        for model in late:
            problem = model.apply(problem)
        solution = solve_pair(problem, noise, carried, plain=plain)
        times = output_times(pair.time_s[0], window.from_s, window.until_s)
        piece = _to_piece(solution, part, times, late)
        yield piece if plain or noise else _with_fit(piece, solution)
        if not window.is_last:
            carried = carry_information(solution.solver, solution.values, window.next_s)


def _to_piece(
    solution: WindowSolution, pair: Pair, time_s: Array, late: Sequence[Candidate]
) -> Piece:
    """Return the estimate of a solved window at some times."""
    problem, values, key_s = solution.problem, solution.values, solution.problem.keyframe_s
    state, spread = mix_members(solution, time_s)
    error = problem.layout.state_column("range_error", 0, 1)
    covariances = solution.covariances[0]
    heights, height_std = height_errors(problem, values, covariances, (0, 1))
    # Unknowns of error models may belong to one robot alone.
    shared = [
        k for k, ((name, _), _) in enumerate(problem.layout.constants) if name in SHARED_NAMES
    ]
    layout = replace(problem.layout, constants=tuple(problem.layout.constants[k] for k in shared))
    estimate = Estimate(
        time_s,
        state,
        spread,
        np.zeros(len(time_s), np.int8),
        values.constants[shared],
        problem.noise,
        layout,
        interpolate_at(time_s, key_s, heights),
        interpolate_at(time_s, key_s, height_std),
        None if error is None else np.interp(time_s, key_s, values.state[:, error]),
        *mix_clocks(solution, time_s),
        constants_covariance=covariances.constants[np.ix_(shared, shared)],
        modes=len(solution.mixture.members),
        causes=find_causes(solution.mixture, (float(time_s[0]), float(time_s[-1]))),
    )
    step = np.clip(np.searchsorted(key_s, time_s, "right") - 1, 0, len(key_s) - 2)
    silent = odometry_dropout(pair, time_s) | problem.list_noisy_steps()[step]
    silent |= find_contradicted_steps(problem, values)[step]
    sighted, energy = list_sighted(solution, time_s), motion_energy(problem, values)
    chance = compute_prior_chance(problem, values)
    delay = find_delay(solution.mixture, covariances.constants, late)
    return Piece(estimate, silent, sighted, energy, chance, delay)


def compute_prior_chance(problem: Problem, values: Values) -> float:
    """Return the probability of larger constants and first values, by their priors.

    It is that of all of them (chi-square), or of the largest (Bonferroni), whichever is less.
    """
    layout = problem.layout
    bounded = [isinstance(row.loss, Gaussian) for _, row in layout.constants]
    constants = (values.constants / problem.noise.prior_std(layout))[bounded]
    first = [
        values.state[0, 3 * layout.robots + k] / row.start_std
        for k, (_, row) in enumerate(layout.states)
        if row.evolution in ("walk", "jump")
    ]
    sigmas = np.append(constants, first)
    largest = len(sigmas) * erfc(np.abs(sigmas).max(initial=0.0) / np.sqrt(2.0))
    return float(min(chdtrc(max(len(sigmas), 1), (sigmas**2).sum()), largest))


def _with_fit(piece: Piece, solution: WindowSolution) -> Piece:
    """Return the estimate of a window with its goodness of fit."""
    estimate = piece.estimate
    ends = float(estimate.time_s[0]), float(estimate.time_s[-1])
    innovations, misfits = check_fit(solution.solver, solution.values, ends)
    causes = (*estimate.causes, *misfits)
    return piece._replace(estimate=replace(estimate, causes=causes, innovations=innovations))


def find_contradicted_steps(
    problem: Problem, values: Values, both: tuple[int, int] = (0, 1)
) -> Mask:
    """Return (S,) the steps at which odometry or most ranges of a pair contradict the solution.

    The half second around them counts too.

    Parameters
    ----------
    problem, values
        Flight and its solution.
    both
        Observer and peer.
    """
    layout, wrong = problem.layout, np.zeros(len(problem.keyframe_s) - 1, bool)
    for robot in both:
        rows = odometry_factor(problem, layout, robot, values)
        wrong |= (rows.square > CONTRADICTED_SIGMAS**2).any(axis=1)
    for k, ((_, own), row) in enumerate(layout.states):
        if row.motion and row.evolution == "fading" and own[0] in both:
            error = np.abs(values.state[:, 3 * layout.robots + k]) / (row.std * problem.noise.grade)
            sigmas = np.maximum(error[1:], error[:-1]) / problem.robots[own[0]].grade
            wrong |= sigmas > CONTRADICTED_SIGMAS
    around = round(MAX_DROPOUT_S / float(np.median(np.diff(problem.keyframe_s))))
    for link in (one for one in problem.links if set(one.robots) == set(both)):
        found = range_factor(problem, layout, link, values)
        far = (found.weight * (found.square > CONTRADICTED_RANGE_SIGMAS**2)).sum(axis=1)
        near = found.weight.sum(axis=1) - far
        excess = uniform_filter1d(far - near, 2 * around + 1, mode="constant")
        wrong |= np.maximum(excess[1:], excess[:-1]) > 0
    return np.asarray(maximum_filter1d(wrong, 2 * around + 1))


def join_pieces(pieces: Sequence[Piece]) -> Piece:
    """Join the windows of a flight.

    Parameters
    ----------
    pieces
        Windows in their order.
    """
    made = join_estimates([piece.estimate for piece in pieces])
    first = _first_samples([piece.estimate for piece in pieces])
    silent = np.concatenate([p.silent[k:] for p, k in zip(pieces, first, strict=True)])
    sighted = np.concatenate([p.sighted[:, k:] for p, k in zip(pieces, first, strict=True)], axis=1)
    return Piece(made, silent, sighted, np.mean([p.energy for p in pieces], axis=0))
