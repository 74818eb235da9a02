"""Find the stretches of a flight in which the velocity of one robot is noisier than elsewhere."""

import numpy as np

from dmrl.estimation.model.pair import Array, Mask
from dmrl.estimation.solver.levenberg_marquardt import Solver
from dmrl.estimation.solver.priors import Chain
from dmrl.estimation.solver.problem import Steps
from dmrl.estimation.solver.residuals import Rows, Values

WINDOW_S = 2.0
"""Length of a window, seconds."""
FREEDOM = 4.0
"""Degrees of freedom of the velocity errors of a window: two axes, each with about two independent
values that the ranges determine."""
RATIOS = (4.0, 16.0, 64.0)
"""Ratios of the variance in a stretch to that elsewhere that are compared."""

MIN_LOG_RATIO = 2.0
"""Smallest ratio of the squared changes of the logged velocity in a stretch to those elsewhere:
half of the smallest ratio of variances that is compared."""


def find_noisy_steps(
    solver: Solver, values: Values, robot: int, least_gain: float = 0.0
) -> Mask | None:
    """Return (S,) the steps in noisy stretches; None where one level of noise fits as well.

    The windows are states of a hidden Markov chain with two levels. Its likeliest path is found by
    the Viterbi algorithm. A change of the level costs the logarithm of the number of windows.

    Parameters
    ----------
    solver, values
        Flight under its models, and the solution.
    robot
        The robot.
    least_gain
        Gain in log likelihood over one level that counts.
    """
    step_s = solver.problem.robots[robot].steps_s
    window = ((np.cumsum(step_s) - step_s / 2) / WINDOW_S).astype(int)
    square = sum_velocity_squares(solver, values, robot)
    level = np.bincount(window, square) / np.maximum(np.bincount(window), 1)
    if len(level) < 3:
        return None
    quiet = level / max(float(np.median(level)), 1e-12)
    paths = [_decode_levels(quiet, ratio) for ratio in RATIOS]
    gain, noisy = max(paths, key=lambda one: one[0])
    steps, found = solver.problem.robots[robot], np.asarray(noisy[window])
    return found if gain > least_gain and _shows_noise(steps, found) else None


def _shows_noise(steps: Steps, noisy: Mask) -> bool:
    """Return whether the log itself is noisier in a stretch than elsewhere.

    An error that lasts, such as the log of another flight, contradicts the ranges as noise does,
    but it changes no faster than the motion.
    """
    velocity = steps.motion.shift_m / steps.steps_s[:, None]
    square, inside = (np.diff(velocity, 2, axis=0) ** 2).sum(axis=1), noisy[1:-1]
    if inside.all() or not inside.any():
        return False
    return bool(np.median(square[inside]) > MIN_LOG_RATIO * np.median(square[~inside]))


def sum_velocity_squares(solver: Solver, values: Values, robot: int) -> Array:
    """Return (S,) squares of the velocity errors of a robot, relative to their noise."""
    factors = solver.linearize(values)
    odometry = [factor for factor in factors if isinstance(factor, Rows) and factor.steps][robot]
    square = odometry.square[:, :2].sum(axis=1)
    chains = [factor for factor in factors if isinstance(factor, Chain)]
    for (subject, row), chain in zip(solver.layout.states, chains, strict=True):
        if row.motion and row.evolution == "fading" and subject[1] == (robot,):
            square += chain.residual[1:] ** 2
    return np.asarray(square)


def _decode_levels(level: Array, ratio: float) -> tuple[float, Mask]:
    """Return the gain in log likelihood of the likeliest path, and its noisy windows.

    Parameters
    ----------
    level
        (W,) mean squares of the windows, relative to the quiet level.
    ratio
        Noisy level.
    """
    gain = FREEDOM / 2 * (level * (1 - 1 / ratio) - np.log(ratio))
    change = np.log(len(level))
    score = np.array([0.0, gain[0] - change])
    came_from = np.zeros((len(level), 2), int)
    for k in range(1, len(level)):
        moved = score[:, None] - change * (1 - np.eye(2))
        came_from[k] = moved.argmax(axis=0)
        score = moved.max(axis=0) + np.array([0.0, gain[k]])
    path = np.zeros(len(level), int)
    path[-1] = score.argmax()
    for k in range(len(level) - 1, 0, -1):
        path[k - 1] = came_from[k, path[k]]
    return float(score.max()), path.astype(bool)
