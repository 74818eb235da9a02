"""Levenberg-Marquardt over a whole flight, for keyframe states and constants together."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.block_tridiagonal import (
    Normal,
    add_looks,
    log_determinant,
    normal,
    solve,
)
from dmrl.estimation.solver.keyframes import GLOBALS, Noise, Problem
from dmrl.estimation.solver.residuals import (
    METRIC,
    OWN_SCALE,
    PEER_SCALE,
    RANGE_ERROR,
    SIZE,
    Linear,
    linearise,
    step_variance,
)
from dmrl.estimation.solver.robust_loss import cost_of, weights_of

ITERATIONS = 25
"""Largest number of iterations. No record of how the value was chosen."""
TOLERANCE, ROUGH = 1e-5, 1e-4
"""Relative change of the cost that ends the iteration; the second where solutions are only
compared. No record of how the values were chosen."""
SAME_M = 0.05
"""Largest distance between two paths that count as the same solution, metres. No record of how the
value was chosen."""
WEAK: Array = np.array([1e-4, 1e-4, 1e-3, 1e-3, 1e-3, 1.0])
"""Information added to every keyframe, in inverse squares of its units. It is practically none and
keeps the equations positive definite."""


@dataclass(frozen=True, slots=True)
class Solution:
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


def solve_batch(
    problem: Problem,
    noise: Noise,
    state: Array,
    constants: Array | None = None,
    known: Sequence[Solution] = (),
    tolerance: float = TOLERANCE,
) -> Solution:
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
        state = np.column_stack([state, np.zeros((len(state), SIZE - 3))])
    linear = linearise(problem, noise, state, constants)
    best = cost_of(linear, noise, constants)
    equations = equations_of(problem, noise, linear, constants)
    damping = 0.0
    for _ in range(ITERATIONS):
        change, change_constants, *_ = solve(damped(equations, damping))
        tried = linearise(problem, noise, state + change, constants + change_constants)
        cost = cost_of(tried, noise, constants + change_constants)
        if not cost < best:
            if damping > 1e4:
                break
            damping = max(10 * damping, 1e-2)
            continue
        state, constants, linear = state + change, constants + change_constants, tried
        damping, gained, best = damping / 10, best - cost, cost
        if gained < tolerance * best or any(near(state, other.state) for other in known):
            break
        equations = equations_of(problem, noise, linear, constants)
    return Solution(state, constants, best)


def near(state: Array, other: Array) -> bool:
    """Return whether two paths are everywhere so close that they are the same solution."""
    return bool(np.hypot(*(state - other)[:, :2].T).max() <= SAME_M)


def evidence(problem: Problem, noise: Noise, solution: Solution) -> float:
    """Return the Laplace approximation of the log evidence of a noise model.

    It lacks a constant that depends on the flight alone, so noise models can be compared.
    """
    linear = linearise(problem, noise, solution.state, solution.constants)
    # The pull of range errors to zero is not a normalized density, so it is no evidence.
    noise = replace(noise, free_weight=0.0)
    cost = cost_of(linear, noise, solution.constants)
    equations = equations_of(problem, noise, linear, solution.constants)
    spread = np.log(step_variance(problem, noise)).sum() / 2
    gains = 1 / (1 + solution.constants[[OWN_SCALE, PEER_SCALE]])
    spread += len(METRIC) * len(problem.steps_s) * np.log((gains**2).mean()) / 2
    spread += len(problem.range_m) * np.log(noise.range_std_m)
    spread += np.log(noise.prior_std()).sum()
    return -cost - float(spread) - log_determinant(equations) / 2


def equations_of(problem: Problem, noise: Noise, linear: Linear, constants: Array) -> Normal:
    """Build normal equations with the weights of the losses and the prior of the constants."""
    weights = weights_of(linear, noise, constants)
    equations = normal(linear, problem.range_key, weights, WEAK)
    if problem.looks is not None and linear.seen is not None and weights.seen is not None:
        add_looks(equations, problem.looks, linear.seen, weights.seen)
    held = weights.free.copy()
    held[0] += weights.first
    equations.diagonal[:, RANGE_ERROR, RANGE_ERROR] += held
    equations.gradient[:, RANGE_ERROR] += held * linear.error_m
    information = weights.prior * noise.prior_std() ** -2
    equations.corner[...] += np.diag(information)
    equations.corner_gradient[...] += information * constants
    return equations


def damped(equations: Normal, damping: float) -> Normal:
    """Return the equations with Levenberg-Marquardt damping: a shorter, steeper step."""
    if damping == 0.0:
        return equations
    diagonal = equations.diagonal + damping * np.eye(len(WEAK)) * equations.diagonal
    return Normal(
        diagonal,
        equations.above,
        equations.border,
        equations.corner,
        equations.gradient,
        equations.corner_gradient,
    )
