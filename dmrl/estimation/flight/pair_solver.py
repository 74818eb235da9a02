"""Solve one window of a pair: modes, noise model, full solve and covariance."""

from dataclasses import dataclass, replace

from dmrl.estimation.evidence.posterior import Member, Mixture, weigh_models
from dmrl.estimation.model.bearings import ASSOCIATION_GATE
from dmrl.estimation.model.pair import Array
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
from dmrl.estimation.solver.covariance import compute_covariance
from dmrl.estimation.solver.levenberg_marquardt import (
    ROUGH_TOLERANCE,
    Carried,
    Solver,
    is_same_solution,
)
from dmrl.estimation.solver.noise_selection import range_noise_ratio, select_model
from dmrl.estimation.solver.problem import CameraView, NoiseModel, Problem
from dmrl.estimation.solver.residuals import Values, bearing_factor

MIN_RANGE_NOISE_RATIO = 1.1
"""Smallest ratio of the range noise to its model that leads to another solve."""
MIN_CONSISTENT_SHARE, MIN_CONSISTENT_IMAGES = 0.25, 10
"""Smallest share, and smallest number, of consistent images of a camera that is used. Images of
other objects also agree with a wrong solution by chance: one in twenty did."""


@dataclass(frozen=True, slots=True)
class PairSolution:
    """Solution of a window of a pair.

    Parameters
    ----------
    mixture
        Solutions under likely models, best first, with their weights.
    covariances
        (K, n, n) of the keyframes and (G, G) of the constants of each.
    """

    mixture: Mixture
    covariances: list[tuple[Array, Array]]

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
) -> PairSolution:
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
    modes = find_modes(problem, tracks)
    full = [convert_values(m.values, coarsen(problem).layout, problem.layout) for m in modes]
    kept = replace(problem, views=consistent_views(problem, full[0]))
    full = [convert_values(values, problem.layout, kept.layout) for values in full]
    problem = kept
    if noise is None:
        problem, first = select_model(problem, full[0])
        full[0] = first.values
    else:
        problem = replace(problem, noise=noise)
    solver = Solver(problem, carried if carried and carried.fits(problem.layout) else None)
    full = [_with_step_offsets(problem, values) for values in full]
    if solver.carried is not None:
        full.append(dead_reckon(problem, solver.carried.mean))
    found = [solver.solve(full[0])]
    for values in full[1:]:
        found.append(solver.solve(values, found, ROUGH_TOLERANCE))
    found = select_modes(found)
    if (
        noise is None
        and (ratio := range_noise_ratio(problem, found[0].values)) > MIN_RANGE_NOISE_RATIO
    ):
        wider = replace(problem.noise, range_std_m=problem.noise.range_std_m * ratio)
        problem = replace(problem, noise=wider)
        solver = replace(solver, problem=problem)
        found = select_modes([solver.solve(mode.values) for mode in found])
    if plain or noise is not None:
        members = [Member(solver, mode, -mode.cost) for mode in found]
        mixture = Mixture(members, mode_weights(found))
    else:
        others = find_flexible_modes(problem, tracks)
        distinct = [
            values
            for values in others
            if not any(is_same_solution(values, mode.values, SAME_TRACK_M) for mode in found)
        ]
        mixture = weigh_models(solver, found, distinct)
    covariances = [compute_covariance(one.solver, one.values) for one in mixture.members]
    return PairSolution(mixture, covariances)


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
