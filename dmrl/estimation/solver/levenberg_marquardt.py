"""Levenberg-Marquardt over a whole flight, for keyframe states and constants together."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.block_tridiagonal import (
    NormalEquations,
    add_camera,
    assemble,
    log_det,
    solve_step,
)
from dmrl.estimation.solver.keyframes import GLOBALS, KeyframeProblem, NoiseModel
from dmrl.estimation.solver.residuals import (
    OWN_SCALE,
    PEER_SCALE,
    RANGE_ERROR,
    SCALED_RESIDUALS,
    STATE_SIZE,
    Linearization,
    linearize,
    step_variance,
)
from dmrl.estimation.solver.robust_loss import irls_weights, total_cost

MAX_ITERATIONS = 25
"""Largest number of iterations. No record of how the value was chosen."""
TOLERANCE, ROUGH_TOLERANCE = 1e-5, 1e-4
"""Relative change of the cost that ends the iteration; the second where solutions are only
compared. No record of how the values were chosen."""
SAME_SOLUTION_M = 0.05
"""Largest distance between two paths that count as the same solution, metres. No record of how the
value was chosen."""
WEAK_INFORMATION: Array = np.array([1e-4, 1e-4, 1e-3, 1e-3, 1e-3, 1.0])
"""Information added to every keyframe, in inverse squares of its units. It is practically none and
keeps the equations positive definite."""


@dataclass(frozen=True, slots=True)
class MapEstimate:
    """Maximum a posteriori estimate of a flight.

    Parameters
    ----------
    state
        (K, 6) x, y (m), psi (rad), wx, wy (m/s), b (m) at the keyframes.
    constants
        (G,) in the order of ``GLOBALS``.
    cost
        Half the sum of the losses.
    """

    state: Array
    constants: Array
    cost: float


def solve(
    problem: KeyframeProblem,
    noise: NoiseModel,
    state: Array,
    constants: Array | None = None,
    previous: Sequence[MapEstimate] = (),
    tolerance: float = TOLERANCE,
) -> MapEstimate:
    """Find the most likely flight near a first guess.

    Parameters
    ----------
    problem, noise
        Keyframes of the flight, and the noise model.
    state
        (K, 3) or (K, 6) first guess.
    constants
        (G,) first guess. None: zeros.
    previous
        Solutions found before. The iteration ends when it reaches one of them.
    tolerance
        Relative change of the cost that ends the iteration.
    """
    constants = np.zeros(len(GLOBALS)) if constants is None else constants
    if state.shape[1] == 3:
        state = np.column_stack([state, np.zeros((len(state), STATE_SIZE - 3))])
    linear = linearize(problem, noise, state, constants)
    best = total_cost(linear, noise, constants)
    equations = build_equations(problem, noise, linear, constants)
    damping = 0.0
    for _ in range(MAX_ITERATIONS):
        change, change_constants, *_ = solve_step(add_damping(equations, damping))
        tried = linearize(problem, noise, state + change, constants + change_constants)
        cost = total_cost(tried, noise, constants + change_constants)
        if not cost < best:
            if damping > 1e4:
                break
            damping = max(10 * damping, 1e-2)
            continue
        state, constants, linear = state + change, constants + change_constants, tried
        damping, gained, best = damping / 10, best - cost, cost
        if gained < tolerance * best or any(
            is_same_solution(state, other.state) for other in previous
        ):
            break
        equations = build_equations(problem, noise, linear, constants)
    return MapEstimate(state, constants, best)


def is_same_solution(state: Array, other: Array) -> bool:
    """Return whether two paths are everywhere so close that they are the same solution."""
    return bool(np.hypot(*(state - other)[:, :2].T).max() <= SAME_SOLUTION_M)


def laplace_log_evidence(
    problem: KeyframeProblem, noise: NoiseModel, solution: MapEstimate
) -> float:
    """Return the Laplace approximation of the log evidence of a noise model.

    It lacks a constant that depends on the flight alone, so noise models can be compared.
    """
    linear = linearize(problem, noise, solution.state, solution.constants)
    # The pull of range errors to zero is not a normalized density, so it is no evidence.
    noise = replace(noise, range_error_weight=0.0)
    cost = total_cost(linear, noise, solution.constants)
    equations = build_equations(problem, noise, linear, solution.constants)
    spread = np.log(step_variance(problem, noise)).sum() / 2
    gains = 1 / (1 + solution.constants[[OWN_SCALE, PEER_SCALE]])
    spread += len(SCALED_RESIDUALS) * len(problem.steps_s) * np.log((gains**2).mean()) / 2
    spread += len(problem.range_m) * np.log(noise.range_std_m)
    spread += np.log(noise.prior_std()).sum()
    return -cost - float(spread) - log_det(equations) / 2


def build_equations(
    problem: KeyframeProblem, noise: NoiseModel, linear: Linearization, constants: Array
) -> NormalEquations:
    """Build normal equations with the weights of the losses and the prior of the constants."""
    weights = irls_weights(linear, noise, constants)
    equations = assemble(linear, problem.range_keyframe, weights, WEAK_INFORMATION)
    if problem.camera is not None and linear.camera is not None and weights.camera is not None:
        add_camera(equations, problem.camera, linear.camera, weights.camera)
    held = weights.free.copy()
    held[0] += weights.first
    equations.diagonal[:, RANGE_ERROR, RANGE_ERROR] += held
    equations.gradient[:, RANGE_ERROR] += held * linear.error_m
    information = weights.prior * noise.prior_std() ** -2
    equations.globals_block[...] += np.diag(information)
    equations.globals_gradient[...] += information * constants
    return equations


def add_damping(equations: NormalEquations, damping: float) -> NormalEquations:
    """Return the equations with Marquardt damping of the keyframe states, not of the constants."""
    if damping == 0.0:
        return equations
    diagonal = equations.diagonal + damping * np.eye(len(WEAK_INFORMATION)) * equations.diagonal
    return NormalEquations(
        diagonal,
        equations.off_diagonal,
        equations.coupling,
        equations.globals_block,
        equations.gradient,
        equations.globals_gradient,
    )
