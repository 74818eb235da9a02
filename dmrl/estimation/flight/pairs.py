"""Estimate relative positions of many pairs with covariance and status: the entry point."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d, uniform_filter1d
from scipy.special import chdtrc, erfc

from dmrl.estimation.evidence.causes import find_causes, find_dropouts
from dmrl.estimation.evidence.delays import Delay, find_delay, join_delays, move_signal
from dmrl.estimation.evidence.error_models import Candidate
from dmrl.estimation.evidence.goodness_of_fit import check_fit
from dmrl.estimation.evidence.mistakes import (
    find_clock_mistake,
    find_mistake,
    has_camera,
    ranges_are_far,
)
from dmrl.estimation.flight.pair_output import (
    MAJORITY_SHARE,
    OUTPUT_HZ,
    _first_samples,
    clip_to_ranges,
    height_errors,
    interpolate_at,
    join_estimates,
    list_refused,
    list_sighted,
    mix_members,
    motion_energy,
    output_times,
    with_status,
)
from dmrl.estimation.flight.pair_solver import (
    PairSolution,
    solve_pair,
)
from dmrl.estimation.flight.windows import carry_information, split_windows
from dmrl.estimation.model.gate import DEFAULT_GATE, Gate
from dmrl.estimation.model.pair import MAX_DROPOUT_S, Array, Mask, Pair
from dmrl.estimation.model.status import UNCONVERGED, classify_positions
from dmrl.estimation.signals.contradictions import drop_contradictions, drop_held_ranges
from dmrl.estimation.solver.estimate import (
    PAIR_LAYOUT,
    Cause,
    Estimate,
    seen_from_peer,
)
from dmrl.estimation.solver.keyframes import build_problem, odometry_dropout, range_dropout
from dmrl.estimation.solver.priors import Carried
from dmrl.estimation.solver.problem import NoiseModel, Problem
from dmrl.estimation.solver.residuals import Values, odometry_factor, range_factor
from dmrl.estimation.solver.robust_loss import Gaussian
from dmrl.estimation.solver.unknowns import TABLE
from dmrl.guards.memory import return_freed_memory

CONTRADICTED_SIGMAS, CONTRADICTED_RANGE_SIGMAS = 15.0, 3.0
"""Odometry that differs from the solution by more has dropped out for the status, in sigmas; and so
has a second in which most ranges differ by more."""
MISFIT_GRADE = 1.8
"""Grade of the noise from which a log may be written wrongly: harsh sensors have 1.4."""
MIN_PRIOR_CHANCE = 1e-3
"""Smallest probability, by their priors, of the constants of a flight that is explained: four
sigmas for one of fifteen. Sound simulated flights have 0.7 to 1. A range scale of 2.28 "explains"
ranges in feet."""
SHARED_NAMES = {row.name for row in TABLE}
"""Names of the unknowns of the plain model, which both directions of a pair report."""
MAX_MOVES = 3
"""Most times that a late signal is moved and the flight is solved again."""
MIN_CAMERA_S = 3.0
"""Shortest time with consistent images that replaces motion, seconds."""


def estimate_pairs(
    pairs: Sequence[Pair],
    *,
    noise: NoiseModel | None = None,
    gate: Gate = DEFAULT_GATE,
    plain: bool = False,
) -> list[tuple[Estimate, Estimate]]:
    """Estimate both directions of several pairs: peer by observer, and observer by peer.

    Parameters
    ----------
    pairs
        Any number of pairs.
    noise
        Noise model of the sensors. None: selected for each flight.
    gate
        Gate of the positions.
    plain
        Without error models beyond the plain one, as `dmrl calibrate` pools flights.
    """
    return [_estimate_pair(pair, noise, gate, plain=plain) for pair in pairs]


def _estimate_pair(
    logged: Pair, noise: NoiseModel | None, gate: Gate, *, plain: bool
) -> tuple[Estimate, Estimate]:
    """Estimate both directions of a pair, with a discrete mistake of its logs corrected."""
    logged, blind, shift_s = drop_held_ranges(logged), None, 0.0
    mistakes: list[Cause] = []
    if not plain and noise is None and (clock := find_clock_mistake(logged)) is not None:
        logged, shift_s = clock.correct(logged, 1), clock.shift_s
        mistakes.append(_to_cause(clock.name, logged, 1))
    pair = drop_contradictions(logged)
    possible = not ranges_are_far(pair)
    pieces = list(_solve_pieces(pair, noise, plain=plain)) if possible else []
    searched = not plain and noise is None and not _explains(pieces)
    if searched and (found := find_mistake(logged)) is not None:
        mistake, robot = found
        logged, shift_s = mistake.correct(logged, robot), shift_s + mistake.shift_s
        pair, pieces = drop_contradictions(logged), []
        mistakes.append(_to_cause(mistake.name, logged, robot))
        blind = robot if mistake.heading_is_open and not has_camera(logged, robot) else None
    pieces = pieces or list(_solve_pieces(pair, noise, plain=plain))
    logged, pair, pieces, late = _move_late(logged, pair, pieces)
    mistakes += [_to_cause(one.model.name, pair, one.robot) for one in late]
    gaps = (*mistakes, *find_dropouts(logged, pair))
    own, peer = (
        replace(one, status=np.maximum(one.status, np.int8(UNCONVERGED * (side == blind))))
        for side, one in enumerate(_both_directions(pair, pieces, gate))
    )
    return (
        replace(own, causes=_add_causes(gaps, own.causes)),
        replace(
            peer,
            # The second robot's positions and images have the times of its own clock.
            time_s=peer.time_s - shift_s,
            causes=_add_causes([cause.seen_from_peer() for cause in gaps], peer.causes),
        ),
    )


def _add_causes(found: Sequence[Cause], causes: Sequence[Cause]) -> tuple[Cause, ...]:
    """Return causes after others, without what these name already."""
    named = {(one.name, one.robot) for one in found}
    return (*found, *(one for one in causes if (one.name, one.robot) not in named))


def _move_late(
    logged: Pair, pair: Pair, pieces: list["Piece"]
) -> tuple[Pair, Pair, list["Piece"], list[Candidate]]:
    """Solve a flight again while it shows late signals, with these moved.

    Parameters
    ----------
    logged, pair
        The pair as logged, and as it was solved.
    pieces
        Its windows.

    Returns
    -------
    logged, pair, pieces
        The same without long delays.
    models
        Error models of the delays.
    """
    models: dict[Candidate, None] = {}
    for _ in range(MAX_MOVES):
        if (delay := join_delays([piece.delay for piece in pieces])) is None:
            break
        logged = move_signal(logged, delay)
        models[delay.model] = None
        pair = drop_contradictions(logged)
        pieces = list(_solve_pieces(pair, None, plain=False))
    return logged, pair, pieces, list(models)


def _to_cause(name: str, pair: Pair, robot: int | None) -> Cause:
    """Return a cause of a whole flight."""
    return Cause(name, 1.0, float(pair.time_s[0]), float(pair.time_s[-1]), robot)


def _explains(pieces: Sequence["Piece"]) -> bool:
    """Return whether some error model explains most of a flight."""
    if not pieces or max(piece.estimate.noise.grade for piece in pieces) >= MISFIT_GRADE:
        return False
    if min(piece.chance for piece in pieces) < MIN_PRIOR_CHANCE:
        return False
    # Noise fits everything badly: a log that is written wrongly is a better explanation.
    if any(piece.noisy.any() for piece in pieces):
        return False
    refused = np.concatenate(
        [one.silent | list_refused(one.estimate, np.logical_or(*one.sighted)) for one in pieces]
    )
    return bool(refused.mean() <= MAJORITY_SHARE)


class Piece(NamedTuple):
    """Estimate of a window, without statuses.

    ``silent`` (K,) dropouts of odometry or contradictory odometry, ``sighted`` (2, K) consistent
    images of either robot nearby, ``energy`` (3,) mean squares of the own, peer and relative
    velocity without noise, relative to that noise; ``noisy`` (K,) odometry that is noisier than
    elsewhere, ``chance`` the probability of larger constants by their priors.
    """

    estimate: Estimate
    silent: Mask
    sighted: Mask
    energy: Array
    noisy: Mask
    chance: float = 1.0
    delay: Delay | None = None


def _solve_pieces(pair: Pair, noise: NoiseModel | None, *, plain: bool) -> Iterator[Piece]:
    """Yield the estimates of the windows of a flight."""
    carried: Carried | None = None
    for window in split_windows(float(pair.time_s[0]), float(pair.time_s[-1])):
        return_freed_memory()  # of the signals of the whole flight, and of the window before
        part = pair.crop(window.start_s, window.end_s)
        solution = solve_pair(build_problem({(0, 1): part}), noise, carried, plain=plain)
        times = output_times(pair.time_s[0], window.from_s, window.until_s)
        piece = _to_piece(solution, part, times)
        yield piece if plain or noise else _with_fit(piece, solution)
        if not window.is_last:
            carried = carry_information(solution.solver, solution.values, window.next_s)


def _to_piece(solution: PairSolution, pair: Pair, time_s: Array) -> Piece:
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
        constants_covariance=covariances[1][np.ix_(shared, shared)],
        modes=len(solution.mixture.members),
        causes=find_causes(solution.mixture, (float(time_s[0]), float(time_s[-1]))),
    )
    step = np.clip(np.searchsorted(key_s, time_s, "right") - 1, 0, len(key_s) - 2)
    noisy = problem.list_noisy_steps()[step]
    silent = odometry_dropout(pair, time_s) | noisy
    silent |= find_contradicted_steps(problem, values)[step]
    sighted, energy = list_sighted(solution, time_s), motion_energy(problem, values)
    chance = _compute_prior_chance(problem, values)
    delay = find_delay(solution.mixture, covariances[1])
    return Piece(estimate, silent, sighted, energy, noisy, chance, delay)


def _compute_prior_chance(problem: Problem, values: Values) -> float:
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


def _with_fit(piece: Piece, solution: PairSolution) -> Piece:
    """Return the estimate of a window with its goodness of fit."""
    estimate = piece.estimate
    ends = float(estimate.time_s[0]), float(estimate.time_s[-1])
    innovations, misfits = check_fit(solution.solver, solution.values, ends)
    causes = (*estimate.causes, *misfits)
    return piece._replace(estimate=replace(estimate, causes=causes, innovations=innovations))


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
    for k, ((_, own), row) in enumerate(layout.states):
        if row.motion and row.evolution == "fading":
            error = np.abs(values.state[:, 3 * layout.robots + k]) / (row.std * problem.noise.grade)
            sigmas = np.maximum(error[1:], error[:-1]) / problem.robots[own[0]].grade
            wrong |= sigmas > CONTRADICTED_SIGMAS
    around = round(MAX_DROPOUT_S / float(np.median(np.diff(problem.keyframe_s))))
    for link in problem.links:
        found = range_factor(problem, layout, link, values)
        far = (found.weight * (found.square > CONTRADICTED_RANGE_SIGMAS**2)).sum(axis=1)
        near = found.weight.sum(axis=1) - far
        excess = uniform_filter1d(far - near, 2 * around + 1, mode="constant")
        wrong |= np.maximum(excess[1:], excess[:-1]) > 0
    return np.asarray(maximum_filter1d(wrong, 2 * around + 1))


def _both_directions(pair: Pair, pieces: Sequence[Piece], gate: Gate) -> tuple[Estimate, Estimate]:
    """Return the estimates of both robots, with their statuses."""
    joined = join_pieces(pieces)
    estimate, far = clip_to_ranges(pair, joined.estimate)
    # Consistent images replace missing ranges; without any range the covariance decides.
    placed = np.logical_or(*joined.sighted)
    quiet = range_dropout(pair, estimate.time_s) & ~placed
    quiet &= len(pair.range_m) > 0
    floor = joined.silent | quiet | far
    own, peer, relative = joined.energy
    enough = [bool(at.sum() >= MIN_CAMERA_S * OUTPUT_HZ) for at in joined.sighted]
    sides = (estimate, own), (seen_from_peer(estimate), peer)
    one, other = (
        with_status(side, floor, (energy, relative), gate, sighted=known, placed=placed)
        for (side, energy), known in zip(sides, enough, strict=True)
    )
    return one, other


def join_pieces(pieces: Sequence[Piece]) -> Piece:
    """Join the windows of a flight."""
    made = join_estimates([piece.estimate for piece in pieces])
    first = _first_samples([piece.estimate for piece in pieces])
    silent = np.concatenate([p.silent[k:] for p, k in zip(pieces, first, strict=True)])
    sighted = np.concatenate([p.sighted[:, k:] for p, k in zip(pieces, first, strict=True)], axis=1)
    noisy = np.concatenate([p.noisy[k:] for p, k in zip(pieces, first, strict=True)])
    return Piece(made, silent, sighted, np.mean([p.energy for p in pieces], axis=0), noisy)


def estimate_ekf(pairs: list[Pair], preset: str, *, gate: Gate = DEFAULT_GATE) -> list[Estimate]:
    """Estimate pairs with the published filter, at every step of their time grids.

    Parameters
    ----------
    pairs
        Any number of pairs.
    preset
        One of ``ekf.PRESETS``.
    gate
        As in `estimate_pairs`.
    """
    from dmrl.estimation.filters import ekf  # noqa: PLC0415 - filterpy takes 0.8 cpu-s to import

    out = []
    for pair in pairs:
        steps = ekf.build_steps(pair, ekf.PRESETS[preset])
        state, spread = ekf.filter_pair(steps, ekf.PRESETS[preset])
        none, constants = np.zeros(len(state), np.int8), np.zeros(len(PAIR_LAYOUT.constants))
        made = Estimate(pair.time_s, state, spread, none, constants, NoiseModel())
        status = classify_positions(made.state, made.covariance, gate)
        out.append(replace(made, status=status))
    return out
