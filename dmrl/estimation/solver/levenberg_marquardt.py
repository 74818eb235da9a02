"""Levenberg-Marquardt over a whole flight, for keyframe states and constants together."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dmrl.estimation.model.odometry import rotate, rotation_matrix
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.block_tridiagonal import NormalEquations, eliminate_states, solve_step
from dmrl.estimation.solver.equations import build_equations, linearize, total_cost
from dmrl.estimation.solver.layout import Layout
from dmrl.estimation.solver.priors import Carried, Chain, ConstantPrior
from dmrl.estimation.solver.problem import Problem
from dmrl.estimation.solver.residuals import Factor, Values, motion_gain, odometry_variance

MAX_ITERATIONS = 25
"""Largest number of iterations."""
MIN_DAMPING, MAX_DAMPING, SMALL_DAMPING = 1e-4, 1e4, 1e-5
"""Damping after a first step that fails; damping beyond which no smaller step is tried; and the
largest one with which a small gain is convergence. A damped step may be small far from it."""
TOLERANCE, ROUGH_TOLERANCE = 1e-5, 1e-4
"""Relative change of the cost that ends the iteration; the second where solutions are only
compared."""
SAME_SOLUTION_M = 0.05
"""Largest distance between two relative paths that are the same solution, metres: half the standard
deviation of a range."""


@dataclass(frozen=True, slots=True)
class MapEstimate:
    """Maximum a posteriori estimate of a flight.

    Parameters
    ----------
    values
        Values of all unknowns.
    cost
        Half the sum of the losses.
    """

    values: Values
    cost: float


@dataclass(frozen=True, slots=True)
class Solver:
    """Problem with its layout and the information from before it.

    Parameters
    ----------
    problem
        Flight to solve.
    carried
        Information from an earlier window. None: the flight begins here.
    """

    problem: Problem
    carried: Carried | None = None

    @property
    def layout(self) -> Layout:
        """Columns of the unknowns."""
        return self.problem.layout

    def linearize(self, values: Values, layout: Layout | None = None) -> list[Factor]:
        """Linearize all factors at the values of the unknowns."""
        layout, carried = layout or self.layout, self.carried
        if carried is None:
            return linearize(self.problem, layout, values)
        out = linearize(self.problem, layout, values, known=dict(carried.layout.states))
        here = np.concatenate([values.state[0], values.constants])
        out.append(carried.convert(layout).to_factor(here, self.problem.noise.motion_loss))
        return out

    def equations(self, values: Values) -> tuple[NormalEquations, list[Factor]]:
        """Build the normal equations at the values of the unknowns."""
        layout, factors = self.layout, self.linearize(values)
        return build_equations(layout, factors, len(values.state)), factors

    def solve(
        self,
        start: Values,
        previous: Sequence[MapEstimate] = (),
        tolerance: float = TOLERANCE,
        same_m: float = SAME_SOLUTION_M,
    ) -> MapEstimate:
        """Find the most likely flight near a first guess.

        Parameters
        ----------
        start
            First guess.
        previous
            Solutions found before. The iteration ends when it reaches one of them.
        tolerance
            Relative change of the cost that ends the iteration.
        same_m
            Largest distance between two paths that are the same solution, metres.
        """
        return self._iterate(start, previous, tolerance, same_m)[0]

    def solve_with_evidence(self, start: Values, tolerance: float) -> tuple[MapEstimate, float]:
        """Return the most likely flight near a first guess, and its log evidence."""
        found, factors = self._iterate(start, (), tolerance, SAME_SOLUTION_M)
        return found, self.laplace_evidence(found, factors)

    def _iterate(
        self, start: Values, previous: Sequence[MapEstimate], tolerance: float, same_m: float
    ) -> tuple[MapEstimate, list[Factor]]:
        """Return a solution as `solve`, and the factors there."""
        layout, values = self.layout, start
        factors = self.linearize(values, layout)
        best, damping = total_cost(factors), 0.0
        equations = build_equations(layout, factors, len(values.state))
        for _ in range(MAX_ITERATIONS):
            try:
                step = solve_step(equations.damped(damping))
                tried = apply_step(values, step.state, step.constants, layout.robots)
                del step  # its factor is as large as the equations
                ahead = self.linearize(tried, layout)
                cost = total_cost(ahead)
            except np.linalg.LinAlgError:
                cost = np.inf
            if not cost < best:
                if damping > MAX_DAMPING:
                    break
                damping = max(10 * damping, MIN_DAMPING)
                continue
            converged = best - cost < tolerance * best and damping <= SMALL_DAMPING
            best, values, factors, damping = cost, tried, ahead, damping / 10
            if converged or any(
                is_same_solution(values, other.values, same_m) for other in previous
            ):
                break
            del equations  # before new ones of the same size are built
            equations = build_equations(layout, factors, len(values.state))  # noqa: F841 - used
        return MapEstimate(values, best), factors

    def log_evidence(self, found: MapEstimate) -> float:
        """Return the Laplace approximation of the log evidence at a solution.

        It lacks a constant that depends on the measurements alone, so models (rows of the table
        and grades of noise) with the same measurements can be compared.
        """
        return self.laplace_evidence(found, self.linearize(found.values))

    def laplace_evidence(
        self, found: MapEstimate, factors: list[Factor], log_det: float | None = None
    ) -> float:
        """Return the evidence as `log_evidence`, from factors that are linearized already.

        Parameters
        ----------
        found
            The solution.
        factors
            Factors there.
        log_det
            Log determinant of their normal equations. None: computed.
        """
        if log_det is None:
            equations = build_equations(self.layout, factors, len(found.values.state))
            log_det = eliminate_states(equations).whole_log_det()
        noise, normalizer = self.problem.noise, 0.0
        for robot in range(len(self.problem.robots)):
            normalizer += float(np.log(odometry_variance(self.problem, robot)).sum()) / 2
            # The noise is that of the true motion: a scale is no evidence by itself.
            gains = motion_gain(self.layout, robot, found.values.constants)
            normalizer -= len(self.problem.keyframe_s) * float(np.log(gains).sum())
        normalizer += sum(len(link.range_m) for link in self.problem.links) * float(
            np.log(noise.range_std_m)
        )
        pull = 0.0
        for factor in factors:
            if isinstance(factor, Chain):
                normalizer += factor.log_std
                # The pull to zero is not a normalized density, so it is no evidence.
                pull += factor.pull()
            elif isinstance(factor, ConstantPrior):
                normalizer += float(np.log(factor.std).sum())
        return pull - found.cost - normalizer - log_det / 2


def apply_step(values: Values, state: Array, constants: Array, robots: int) -> Values:
    """Return the values after a step of the solver.

    A turn of a robot turns its path, and a turn of the first robot what it sees. To first order
    that is the sum. But biases of all gyroscopes turn a long flight by a radian, which no
    measurement resists, and along straight lines such a step would stretch the paths.

    Parameters
    ----------
    values
        Values before the step.
    state, constants
        (K, n) and (G,) steps.
    robots
        Number of robots.
    """
    x, y = slice(0, 3 * robots, 3), slice(1, 3 * robots, 3)
    place, moved = (table[:, x] + 1j * table[:, y] for table in (values.state, state))
    turn, turns = state[:, 2:3], state[:-1, 2]
    way, away = np.diff(place[:, 0]), place[:, 1:] - place[:, :1]
    way = np.exp(1j * turns) * (way + np.diff(moved[:, 0]) - 1j * turns * way)
    away = np.exp(1j * turn) * (away + moved[:, 1:] - moved[:, :1] - 1j * turn * away)
    path = np.cumsum(np.concatenate([place[:1, 0] + moved[:1, 0], way]))[:, None]
    place, out = np.hstack([path, path + away]), values.state + state
    out[:, x], out[:, y] = place.real, place.imag
    return Values(out, values.constants + constants)


def relative_path(state: Array, one: int = 0, other: int = 1) -> Array:
    """Return (K, 3) x, y (m) and heading of one robot in another's horizontal frame."""
    here, there = state[:, 3 * one : 3 * one + 3], state[:, 3 * other : 3 * other + 3]
    xy = rotate(rotation_matrix(-here[:, 2]), there[:, :2] - here[:, :2])
    return np.column_stack([xy, there[:, 2] - here[:, 2]])


def is_same_solution(values: Values, other: Values, within_m: float = SAME_SOLUTION_M) -> bool:
    """Return whether the positions of the second robot are everywhere nearly the same."""
    # Most solutions differ at one in ten keyframes already.
    for every in (10, 1):
        apart = relative_path(values.state[::every]) - relative_path(other.state[::every])
        if np.hypot(*apart[:, :2].T).max() > within_m:
            return False
    return True
