"""Goodness of fit of a solution: which sensor no error model explains, and when.

A smoother bends its solution to the measurements, so residuals are small even where the model is
wrong. The tests are therefore score tests: how much would the cost fall if a sensor had another
error, constant over each two seconds? The covariance of the scores is the part of their information
that the unknowns leave open. It contains the leverage of every measurement and the correlation of
the windows. With a true model the statistic is chi-square. A solve ends a little before the
optimum, so the scores are those after one more Gauss-Newton step, as in Neyman's C(alpha) test.

A score is a sum of slopes of the loss, so outliers that the loss takes do not fail the test.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs
from scipy.sparse import csc_array
from scipy.special import chdtrc

from dmrl.estimation.model.pair import Array
from dmrl.estimation.signals.jump_detection import find_runs
from dmrl.estimation.solver.block_tridiagonal import NormalEquations, solve_step
from dmrl.estimation.solver.estimate import MISFIT, Cause, Innovation
from dmrl.estimation.solver.levenberg_marquardt import Solver
from dmrl.estimation.solver.problem import Problem
from dmrl.estimation.solver.residuals import Rows, Values

FALSE_ALARM = 0.02
"""Probability that a sound flight fails a test, over all signals and windows (Bonferroni)."""
WINDOW_S = 2.0
"""Length of a window, seconds: shorter errors are outliers, which the losses take."""
SPANS = (1, 2, 5)
"""Numbers of windows that are tested together: 2, 4 and 10 s. Weak errors need long spans."""
MIN_OPEN_SHARE = 1e-7
"""Smallest share of a score's information that the unknowns leave open. Below it, rounding decides.
"""
BLOCK = 32
"""Number of scores whose covariance is computed at once. Scores of the longest span are in the same
block or in neighbouring ones."""


@dataclass(frozen=True, slots=True)
class SignalScores:
    """Scores of one signal over windows: slopes of the cost by D errors that the model lacks.

    Parameters
    ----------
    signal
        range, flow, yaw rate, bearing or height.
    robot
        Robot with the sensor. None: the pair's.
    time_s
        (W,) middles of the windows, seconds.
    score
        (W, D) slopes, over the roots of their information.
    covariance
        (W, D, W, D) of these if the model is true.
    """

    signal: str
    robot: int | None
    time_s: Array
    score: Array
    covariance: Array

    def chi_squares(self, span: int) -> tuple[Array, NDArray[np.intp]]:
        """Return the statistics of every span of windows, and their degrees of freedom."""
        at = np.arange(len(self.score) - span + 1)[:, None] + np.arange(span)
        score = self.score[at].reshape(len(at), -1, 1)
        block = self.covariance.swapaxes(1, 2)[at[:, :, None], at[:, None, :]]
        block = block.swapaxes(2, 3).reshape(len(at), score.shape[1], -1)
        energy, axes = np.linalg.eigh(block)
        known = energy > MIN_OPEN_SHARE
        square = (axes.swapaxes(1, 2) @ score)[..., 0] ** 2 / np.where(known, energy, np.inf)
        return np.asarray(square.sum(axis=1)), known.sum(axis=1)

    def to_innovation(self) -> Innovation:
        """Return the size of every window's scores."""
        square, freedom = self.chi_squares(1)
        size = np.sqrt(square / np.where(freedom, freedom, np.nan))
        return Innovation(self.signal, self.time_s, size, self.robot)


def check_fit(
    solver: Solver, values: Values, span_s: tuple[float, float]
) -> tuple[tuple[Innovation, ...], tuple[Cause, ...]]:
    """Return what every signal shows beyond the model, and the stretches that do not fit.

    Parameters
    ----------
    solver, values
        Flight under its model, and the solution.
    span_s
        First and last second that count.
    """
    scores = compute_scores(solver, values)
    limit = FALSE_ALARM / (len(SPANS) * sum(len(one.time_s) for one in scores))
    failed = [(cause, chance) for one in scores for cause, chance in _test_signal(one, limit)]
    found = []
    for one in scores:
        innovation = one.to_innovation()
        at = (innovation.time_s >= span_s[0]) & (innovation.time_s < span_s[1])
        found.append(replace(innovation, time_s=innovation.time_s[at], size=innovation.size[at]))
    return tuple(found), tuple(_select_leading(failed, span_s))


def compute_scores(solver: Solver, values: Values) -> list[SignalScores]:
    """Compute the scores of all signals over windows.

    Parameters
    ----------
    solver, values
        Flight under its model, and the solution.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the equations are singular.
    """
    equations, factors = solver.equations(values)
    key_s, size = solver.problem.keyframe_s, len(equations.globals_block)
    step = solve_step(equations)
    response = step.response().reshape(-1, size)
    window = ((key_s[:-1] - key_s[0]) / WINDOW_S).astype(int)
    window = np.append(window, window[-1])
    middle_s = key_s[0] + (np.arange(window[-1] + 1) + 0.5) * WINDOW_S
    rows = [factor for factor in factors if isinstance(factor, Rows)]
    out = []
    for factor, signals in zip(rows, _list_signals(solver.problem), strict=True):
        scores = _sum_scores(factor, window, equations)
        by_state, by_constant = scores.by_state, scores.by_constant.reshape(size, -1)
        score = by_state.T @ step.state.ravel() + by_constant.T @ step.constants
        score = scores.score + score.reshape(scores.score.shape)
        rest = by_constant - (by_state.T @ response).T
        explained = rest.T @ step.covariance @ rest
        explained += _correlate(step.eliminated.factor, by_state)
        scale = 1 / np.sqrt(np.maximum(scores.information, 1e-9))
        open_part = np.diag(scores.information.ravel()) - explained
        open_part *= scale.ravel() * scale.ravel()[:, None]
        covariance = open_part.reshape(*scale.shape, *scale.shape)
        out += [
            SignalScores(name, robot, middle_s, (score * scale)[:, at], part[..., at])
            for name, robot, at in signals
            for part in (covariance[:, at],)
        ]
    return out


def _correlate(factor: Array, columns: csc_array) -> Array:
    """Return (M, M) products of M columns in time order through the inverse of U^T U.

    Parameters
    ----------
    factor
        Upper bands of U.
    columns
        (N, M) sparse columns. Products of those that are more than `BLOCK` apart are 0.
    """
    half, size = columns.toarray(order="F"), columns.shape[1]
    out = np.zeros((size, size))
    for first in range(0, size, BLOCK):
        at, near = slice(first, first + BLOCK), slice(max(first - BLOCK, 0), first + BLOCK)
        # U^-T by a column is 0 before the column begins.
        start = int(columns[:, at].indices.min(initial=len(half) - 1))
        half[start:, at], _ = dtbtrs(factor[:, start:], half[start:, at], trans="T")
        out[near, at] = half[start:, near].T @ half[start:, at]
        out[at, near] = out[near, at].T
    return out


Index = NDArray[np.intp]
Signal = tuple[str, int | None, list[int]]
"""Name, robot and components of a signal among the residuals of a factor."""


def _list_signals(problem: Problem) -> Iterator[list[Signal]]:
    """Yield the signals of every factor with rows, in the order of `equations.linearize`."""
    for robot in range(len(problem.robots)):
        yield [("flow", robot, [0, 1]), ("yaw rate", robot, [2])]
    for _ in problem.links:
        yield [("range", None, [0])]
    for view in problem.views:
        yield [("bearing", view.robots[0], [0, 2]), ("height", view.robots[0], [1])]


class _Scores(NamedTuple):
    """Slopes of the cost by errors that are constant over a window.

    ``score`` and ``information`` (W, D) of each window and component; ``by_state`` (K n, W D)
    and ``by_constant`` (G, W, D) products of the errors with the unknowns.
    """

    score: Array
    information: Array
    by_state: csc_array
    by_constant: Array


def _sum_scores(factor: Rows, window: Index, equations: NormalEquations) -> _Scores:
    """Sum the slopes of a factor's measurements over windows.

    Parameters
    ----------
    factor
        Linearized measurements.
    window
        (K,) window of each keyframe.
    equations
        Equations of the flight, for its shape.
    """
    # A lost image has no derivatives: its residual is a constant cost.
    shown = (factor.rows[..., :-1] != 0).any(axis=(-2, -1))
    weight = (shown * factor.weight * factor.loss.weight(factor.square))[..., None]
    # Odometry has a measurement for each component, the others one with all of them.
    several = 2 if factor.steps else 1
    rows = (factor.rows * weight[..., None]).sum(axis=several)
    held = np.broadcast_to(weight, factor.rows.shape[:-1]).sum(axis=several)
    at, key = window[: len(rows)], np.arange(len(rows))
    size, shape = len(factor.columns), (window[-1] + 1, rows.shape[1])
    score, information = np.zeros(shape), np.zeros(shape)
    np.add.at(score, at, rows[..., -1])
    np.add.at(information, at, held)
    keyframes, width = equations.gradient.shape
    state = (key[:, None] + np.arange(1 + factor.steps)).repeat(size, 1) * width
    state += np.tile(factor.columns, 1 + factor.steps)
    values = rows[..., : state.shape[1]].transpose(0, 2, 1)
    error = np.arange(score.size).reshape(shape)[at][:, None]
    places = np.broadcast_arrays(state[..., None], error)
    by_state = csc_array(
        (values.ravel(), [place.ravel() for place in places]),
        shape=(keyframes * width, score.size),
    )
    by_constant = np.zeros((len(equations.globals_block), *shape))
    for number, column in enumerate(factor.border, size * (1 + factor.steps)):
        np.add.at(by_constant[column], at, rows[..., number])
    return _Scores(score, information, by_state, by_constant)


def _test_signal(one: SignalScores, limit: float) -> Iterator[tuple[Cause, float]]:
    """Yield the stretches whose scores are less likely than a limit, and their probabilities."""
    least = np.ones(len(one.time_s))
    for span in (span for span in SPANS if span <= len(least)):
        square, freedom = one.chi_squares(span)
        chance = np.where(freedom, chdtrc(freedom, square), 1.0)
        for first in range(span):
            part = slice(first, first + len(chance))
            least[part] = np.minimum(least[part], chance)
    half = WINDOW_S / 2
    for first, last in find_runs(least < limit):
        ends = float(one.time_s[first]) - half, float(one.time_s[last - 1]) + half
        smallest = float(least[first:last].min())
        probability = 1.0 - smallest * FALSE_ALARM / limit
        yield Cause(f"{one.signal} {MISFIT}", probability, *ends, one.robot), smallest


def _select_leading(
    failed: Sequence[tuple[Cause, float]], span_s: tuple[float, float]
) -> Iterator[Cause]:
    """Yield the least likely signal of each stretch, with the whole stretch.

    An error of one sensor bends the solution, so the others fail their tests as well.
    """
    ordered = sorted(failed, key=lambda one: one[0].from_s)
    while ordered:
        group = [ordered.pop(0)]
        end_s = group[0][0].to_s
        while ordered and ordered[0][0].from_s <= end_s:
            group.append(ordered.pop(0))
            end_s = max(end_s, group[-1][0].to_s)
        lead = min(group, key=lambda one: one[1])[0]
        from_s, to_s = max(group[0][0].from_s, span_s[0]), min(end_s, span_s[1])
        if from_s < to_s:
            yield replace(lead, from_s=from_s, to_s=to_s)
