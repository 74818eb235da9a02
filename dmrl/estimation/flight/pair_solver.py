"""Solve one window of a pair: modes, noise model, full solve and covariance."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dmrl.estimation.model.bearings import ASSOCIATION_GATE
from dmrl.estimation.model.pair import Array
from dmrl.estimation.search.modes import (
    coarsen,
    convert_values,
    dead_reckon,
    find_modes,
    mode_weights,
    select_modes,
)
from dmrl.estimation.solver.covariance import compute_covariance
from dmrl.estimation.solver.levenberg_marquardt import (
    ROUGH_TOLERANCE,
    Carried,
    MapEstimate,
    Solver,
    relative_path,
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
    problem
        Flight with the selected model.
    modes
        Distinct solutions, best first.
    weight
        (M,) their weights.
    keyframes, constants
        (K, n, n) and (G, G) covariances of the best one.
    carried
        Information from earlier windows that it contains.
    """

    problem: Problem
    modes: list[MapEstimate]
    weight: Array
    keyframes: Array
    constants: Array
    carried: Carried | None = None

    @property
    def values(self) -> Values:
        """Values of the best mode."""
        return self.modes[0].values

    def between_modes(self, states: Sequence[Array]) -> Array:
        """Return (K, 3, 3) the covariance that the choice between modes adds to the best one.

        Parameters
        ----------
        states
            (K, 3) x, y, psi of every mode.
        """
        apart = np.stack(states) - states[0]
        apart[..., 2] = np.angle(np.exp(1j * apart[..., 2]))
        return np.asarray(np.einsum("s,ski,skj->kij", self.weight, apart, apart))


def solve_pair(
    problem: Problem, noise: NoiseModel | None = None, carried: Carried | None = None
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
    """
    modes = find_modes(problem)
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
    keyframes, constants = compute_covariance(solver, found[0].values)
    return PairSolution(problem, found, mode_weights(found), keyframes, constants, solver.carried)


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


def relative_modes(solution: PairSolution) -> list[Array]:
    """Return (K, 3) relative paths of all modes, best first."""
    return [relative_path(mode.values.state) for mode in solution.modes]
