"""Select the noise grade of a flight by evidence."""

from dataclasses import replace

import numpy as np

from dmrl.estimation.model.pair import NORMAL_MEDIAN, Array
from dmrl.estimation.solver.keyframes import average_ranges
from dmrl.estimation.solver.levenberg_marquardt import MapEstimate, Solver
from dmrl.estimation.solver.problem import NoiseModel, Problem
from dmrl.estimation.solver.residuals import Values, range_factor

GRADES = (0.4, 0.55, 0.75, 1.0, 1.4, 2.0, 2.8)
"""Grades of the velocity noise that are compared, in steps of a third. The first is a tenth better
than calibrated sensors, the last worse than any that is kept."""
GRADE_STD = 0.4
"""Prior standard deviation of the log grade. Calibrated and harsh sensors are one from the default.
"""
GRADE_BIAS = 1.2
"""Ratio of the true grade to the likeliest one, on 30 simulated flights of three noise presets: the
solution takes a part of the noise for motion."""
GRADE_TOLERANCE = 5e-4
"""Relative change of the cost that ends a solve: half of what counts below, at a cost of 4,000."""
EVIDENCE_SCALE = 4.0
"""Difference of the log evidence that counts as one. Evidence contains the approximations of the
losses, as the costs of modes do."""
MIN_CONSTANTS_GRADE = 0.8
"""Smallest grade of the priors of constants. A flight shows a constant scale once at most, and real
flow with little noise was measured 7 % off."""
RANGE_AVERAGING_S, MIN_AVERAGED_RANGES, HALF_WEIGHT_SIGMAS = 1.0, 4, 2.0
"""Averaging of range residuals: time, seconds; fewest ranges; residual with half weight, in sigmas,
so that outliers on one side do not look like correlated noise."""


def select_noise(problem: Problem, start: Values) -> tuple[Problem, MapEstimate]:
    """Return the flight with the selected noise, and its solution with averaged ranges.

    Parameters
    ----------
    problem
        The flight.
    start
        Solution under a similar model, in the layout of the problem.
    """
    links = tuple(average_ranges(link, problem.keyframe_s) for link in problem.links)
    grade, solution = _search_grade(replace(problem, links=links), start)
    return replace(problem, noise=_graded(problem, grade)), solution


def _search_grade(problem: Problem, start: Values) -> tuple[float, MapEstimate]:
    """Return the mean grade and the best solution."""
    found: dict[int, tuple[float, MapEstimate]] = {}

    def evaluate(number: int, values: Values) -> float:
        solver = Solver(replace(problem, noise=_graded(problem, GRADES[number])))
        solution, evidence = solver.solve_with_evidence(values, GRADE_TOLERANCE)
        found[number] = evidence, solution
        return evidence

    first = GRADES.index(1.0)
    best = evaluate(first, start)
    for way in (-1, 1):
        number = first + way
        values = found[first][1].values
        while 0 <= number < len(GRADES):
            likelihood = evaluate(number, values)
            best, values = max(best, likelihood), found[number][1].values
            if likelihood < best - 2 * EVIDENCE_SCALE:
                break
            number += way
    numbers = sorted(found)
    log_grade = np.log([GRADES[n] for n in numbers])
    weight = (
        np.array([found[n][0] for n in numbers]) / EVIDENCE_SCALE - (log_grade / GRADE_STD) ** 2 / 2
    )
    weight = np.exp(weight - weight.max())
    grade = GRADE_BIAS * float(np.sqrt((weight * np.exp(2 * log_grade)).sum() / weight.sum()))
    return grade, max(found.values(), key=lambda one: one[0])[1]


def _soften(residual: Array) -> Array:
    """Return residuals with little weight on outliers."""
    return np.asarray(residual / (1 + (residual / HALF_WEIGHT_SIGMAS) ** 2))


def _graded(problem: Problem, grade: float) -> NoiseModel:
    """Return the noise of a flight at another grade."""
    constants = max(grade, MIN_CONSTANTS_GRADE)
    return replace(problem.noise, grade=grade, constants_grade=constants)


def range_noise_ratio(problem: Problem, values: Values) -> float:
    """Return the ratio of the range noise to its model, at least 1.

    It is that of single ranges, by their median absolute residual, or that over a second, whichever
    is more. The loss takes ranges with three times the noise without more cost, but counts too much
    information. The mean of n independent errors has 1/n of their variance. Reflections that last
    for a second give it more, and the ranges carry correspondingly less information.
    """
    layout, ratios = problem.layout, [1.0]
    for link in problem.links:
        rows = range_factor(problem, layout, link, values)
        residual = rows.rows[..., 0, -1][rows.weight > 0]
        if len(residual):
            ratios.append(float(np.median(np.abs(residual))) / NORMAL_MEDIAN)
        second = ((link.time_s - problem.keyframe_s[0]) / RANGE_AVERAGING_S).astype(int)
        second = np.maximum(second, 0)
        count = np.bincount(second)
        many = count >= MIN_AVERAGED_RANGES
        total = np.bincount(second, _soften(residual))[many]
        if len(total):
            grid = np.linspace(-8, 8, 1601)
            nominal = np.average(_soften(grid) ** 2, weights=np.exp(-(grid**2) / 2))
            ratios.append(float(np.sqrt((total**2 / count[many]).mean() / nominal)))
    return max(ratios)
