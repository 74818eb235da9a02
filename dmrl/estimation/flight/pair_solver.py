"""Solve one window of a pair: modes, noise model, full solve and covariance."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

from dmrl.estimation.evidence.model_trials import Member
from dmrl.estimation.evidence.posterior import Mixture, weigh_models
from dmrl.estimation.model.bearings import ASSOCIATION_GATE
from dmrl.estimation.model.pair import Array
from dmrl.estimation.search.hypotheses import Track
from dmrl.estimation.search.modes import (
    SAME_TRACK_M,
    coarsen,
    convert_values,
    dead_reckon,
    find_flexible_modes,
    find_modes,
    find_tracks,
    mode_weights,
    select_modes,
)
from dmrl.estimation.solver.camera_noise import calibrate_views
from dmrl.estimation.solver.covariance import Covariances, compute_covariance
from dmrl.estimation.solver.levenberg_marquardt import (
    ROUGH_TOLERANCE,
    MapEstimate,
    Solver,
    is_same_solution,
)
from dmrl.estimation.solver.noise_selection import range_noise_ratio, select_noise
from dmrl.estimation.solver.priors import Carried
from dmrl.estimation.solver.problem import CameraView, NoiseModel, Problem
from dmrl.estimation.solver.residuals import Values, bearing_factor

MIN_RANGE_NOISE_RATIO = 1.1
"""Smallest ratio of the range noise to its model that leads to another solve."""
MIN_CONSISTENT_SHARE, MIN_CONSISTENT_IMAGES = 0.25, 10
"""Smallest share, and smallest number, of consistent images of a camera that is used. Images of
other objects also agree with a wrong solution by chance: one in twenty did."""


@dataclass(frozen=True, slots=True)
class WindowSolution:
    """Solution of a window of a flight.

    Parameters
    ----------
    mixture
        Solutions under likely models, best first, with their weights.
    covariances
        Covariances of each.
    """

    mixture: Mixture
    covariances: list[Covariances]

    @property
    def solver(self) -> Solver:
        """Flight under the best model."""
        return self.mixture.members[0].solver

    @property
    def problem(self) -> Problem:
        """Flight under the best model."""
        return self.solver.problem

    @property
    def values(self) -> Values:
        """Values of the best solution."""
        return self.mixture.members[0].values


def solve_pair(
    problem: Problem,
    noise: NoiseModel | None = None,
    carried: Carried | None = None,
    *,
    plain: bool = False,
) -> WindowSolution:
    """Solve a flight of two robots.

    Parameters
    ----------
    problem
        The flight.
    noise
        Noise model of the sensors. None: selected.
    carried
        Information from earlier windows.
    plain
        Without error models beyond the plain one.
    """
    tracks = find_tracks(problem)
    problem, starts = _select_noise(problem, tracks, noise)
    solver = Solver(problem, carried)
    if solver.carried is not None:
        starts.append(dead_reckon(problem, solver.carried.convert(problem.layout).mean))
    solver, found = _solve_modes(solver, starts, widen=noise is None)
    if plain or noise is not None:
        members = [Member(solver, mode, -mode.cost) for mode in found]
        mixture = Mixture(members, mode_weights(found))
    else:
        mixture = weigh_models(solver, found, cache(lambda: _find_others(problem, tracks, found)))
    covariances = [compute_covariance(one.solver, one.values) for one in mixture.members]
    return WindowSolution(mixture, covariances)


def _find_others(
    problem: Problem, tracks: Sequence[Track], found: Sequence[MapEstimate]
) -> list[Values]:
    """Return the solutions with yaw rate biases that change that are no solution without."""
    return [
        values
        for values in find_flexible_modes(problem, tracks)
        if not any(is_same_solution(values, mode.values, SAME_TRACK_M) for mode in found)
    ]


def _select_noise(
    problem: Problem, tracks: Sequence[Track], noise: NoiseModel | None
) -> tuple[Problem, list[Values]]:
    """Return a flight with its noise and consistent images, and its modes as first guesses."""
    modes = find_modes(problem, tracks)
    starts = [convert_values(m.values, coarsen(problem).layout, problem.layout) for m in modes]
    kept = replace(problem, views=consistent_views(problem, starts[0]))
    starts = [convert_values(values, problem.layout, kept.layout) for values in starts]
    if noise is None:
        kept, first = select_noise(kept, starts[0])
        starts[0] = first.values
    else:
        kept = replace(kept, noise=noise)
    return kept, [_with_step_offsets(kept, values) for values in starts]


def _solve_modes(
    solver: Solver, starts: Sequence[Values], *, widen: bool
) -> tuple[Solver, list[MapEstimate]]:
    """Return the distinct solutions from some first guesses, best first, and their solver.

    Parameters
    ----------
    solver
        The flight.
    starts
        First guesses, the best first.
    widen
        Whether ranges that average out slowly get more noise.
    """
    found = [solver.solve(starts[0])]
    for values in starts[1:]:
        found.append(solver.solve(values, found, ROUGH_TOLERANCE))
    found = select_modes(found)
    ratio = range_noise_ratio(solver.problem, found[0].values) if widen else 1.0
    if ratio > MIN_RANGE_NOISE_RATIO:
        noise = solver.problem.noise
        wider = replace(noise, range_std_m=noise.range_std_m * ratio)
        solver = replace(solver, problem=replace(solver.problem, noise=wider))
        found = select_modes([solver.solve(mode.values) for mode in found])
    if widen and solver.problem.views:
        solver, best = calibrate_views(solver, found[0])
        found = select_modes([best, *(solver.solve(mode.values) for mode in found[1:])])
    return solver, found


def _with_step_offsets(problem: Problem, values: Values) -> Values:
    """Return values with the detected step offsets of the ranges, which averaged ranges lack."""
    state = values.state.copy()
    for link in problem.links:
        column = problem.layout.state_column("range_error", *link.robots)
        if column is not None:
            state[link.keyframe, column] += link.offset_guess_m
    return Values(state, values.constants)


def squared_distances(problem: Problem, view: CameraView, values: Values) -> Array:
    """Return (I,) squared distance of each image's nearest candidate from a solution."""
    rows = bearing_factor(problem, problem.layout, view, values)
    return rows.square[rows.weight > 0]


def consistent_views(problem: Problem, values: Values) -> tuple[CameraView, ...]:
    """Return the images of the cameras that are consistent with a solution."""
    out = []
    for view in problem.views:
        agree = squared_distances(problem, view, values) < ASSOCIATION_GATE
        least = max(MIN_CONSISTENT_IMAGES, MIN_CONSISTENT_SHARE * len(agree))
        if agree.sum() >= least:
            out.append(view)
    return tuple(out)
