"""Equations of a problem: the rows of all factors, assembled into one bordered system."""

from collections.abc import Collection

import numpy as np

from dmrl.estimation.solver.block_tridiagonal import NormalEquations
from dmrl.estimation.solver.layout import Layout, Subject
from dmrl.estimation.solver.priors import ANCHOR_INFORMATION, WEAK_INFORMATION, Chain, ConstantPrior
from dmrl.estimation.solver.problem import Problem
from dmrl.estimation.solver.residuals import (
    Factor,
    Values,
    bearing_factor,
    odometry_factor,
    range_factor,
)


def linearize(
    problem: Problem, layout: Layout, values: Values, *, known: Collection[Subject] = ()
) -> list[Factor]:
    """Linearize all factors of a flight at the values of its unknowns.

    Parameters
    ----------
    problem, layout
        The flight, and the columns of its unknowns.
    values
        Values of all unknowns.
    known
        Walks and jumps that began earlier: carried information knows their first values.
    """
    out: list[Factor] = [
        odometry_factor(problem, layout, robot, values) for robot in range(layout.robots)
    ]
    out += [range_factor(problem, layout, link, values) for link in problem.links]
    out += [bearing_factor(problem, layout, view, values) for view in problem.views]
    steps_s = problem.robots[0].steps_s
    for k, (subject, row) in enumerate(layout.states):
        kept, std = row.step_model(steps_s)
        grade = np.full(len(std), problem.noise.grade if row.graded else 1.0)
        if row.graded and row.motion:
            grade *= problem.robots[subject[1][0]].grade
        start = (row.std if row.evolution == "fading" else row.start_std) * grade[0]
        start = np.inf if subject in known and row.evolution != "fading" else start
        column = 3 * layout.robots + k
        value = values.state[:, column]
        out.append(Chain(row, column, value, kept, std * grade, start))
    losses = tuple(row.loss for _, row in layout.constants)
    out.append(ConstantPrior(values.constants, problem.noise.prior_std(layout), losses))
    return out


def build_equations(
    layout: Layout, factors: list[Factor], keyframes: int, *, anchored: bool = True
) -> NormalEquations:
    """Build the normal equations of linearized factors.

    Parameters
    ----------
    layout
        Columns of the unknowns.
    factors
        Linearized factors.
    keyframes
        Number of keyframes.
    anchored
        Whether the first robot's first pose defines the frame of the flight.
    """
    equations = NormalEquations.zeros(keyframes, layout.width, len(layout.constants))
    for factor in factors:
        factor.add_to(equations)
    equations.mirror()
    at = np.arange(layout.width)
    equations.diagonal[:, at, at] += WEAK_INFORMATION
    equations.diagonal[0, :3, :3] += anchored * ANCHOR_INFORMATION * np.eye(3)
    return equations


def total_cost(factors: list[Factor]) -> float:
    """Return half the sum of all losses."""
    return sum(factor.cost() for factor in factors)
