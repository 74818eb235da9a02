"""Cut a long flight into overlapping windows with a carried prior: flat memory, linear time.

A window takes from the one before it the information about its first keyframe and the constants:
the equations of the earlier keyframes, eliminated. The positions of the overlap come from both
sides of its middle, so every position has measurements after it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from dmrl.estimation.model.odometry import rotation_matrix
from dmrl.estimation.solver.block_tridiagonal import eliminate_before
from dmrl.estimation.solver.equations import build_equations
from dmrl.estimation.solver.keyframes import select_measurements
from dmrl.estimation.solver.levenberg_marquardt import Solver
from dmrl.estimation.solver.priors import Carried, ConstantPrior
from dmrl.estimation.solver.problem import Problem
from dmrl.estimation.solver.residuals import Rows, Values

WINDOW_S, OVERLAP_S = 200.0, 50.0
"""Length of a window and of its overlap, seconds. Half of the overlap is the time in which a
smoother forgets. A flight that is shorter than two windows is solved at once."""
CARRIED_SHARE = 0.5
"""Share of the carried information that counts: constants drift, and an earlier error must not
bind a later window."""


@dataclass(frozen=True, slots=True)
class Window:
    """Measurements from ``start_s`` to ``end_s``; positions from ``from_s`` to ``until_s``."""

    start_s: float
    end_s: float
    from_s: float
    until_s: float
    is_last: bool

    @property
    def next_s(self) -> float:
        """Start of the next window, seconds."""
        return self.start_s + WINDOW_S - OVERLAP_S


def split_windows(start_s: float, end_s: float) -> Iterator[Window]:
    """Yield the windows of a flight."""
    from_s = start_s
    while end_s - start_s > 2 * WINDOW_S - OVERLAP_S:
        until_s = start_s + WINDOW_S - OVERLAP_S / 2
        yield Window(start_s, start_s + WINDOW_S, from_s, until_s, False)
        start_s, from_s = start_s + WINDOW_S - OVERLAP_S, until_s
    yield Window(start_s, end_s, from_s, end_s, True)


def carry_information(solver: Solver, values: Values, time_s: float) -> Carried:
    """Return the information of a window about a later keyframe and the constants.

    Parameters
    ----------
    solver, values
        The window and its solution.
    time_s
        Time of the first keyframe of the next window, seconds.
    """
    at = int(np.argmin(np.abs(solver.problem.keyframe_s - time_s)))
    cut = replace(solver, problem=_until(solver.problem, at))
    early = Values(values.state[: at + 1], values.constants)
    # The priors of the constants and the measurements at its first keyframe belong to the next
    # window.
    factors = [
        _without_last(factor) if isinstance(factor, Rows) and not factor.steps else factor
        for factor in cut.linearize(early)
        if not isinstance(factor, ConstantPrior)
    ]
    equations = build_equations(cut.layout, factors, at + 1, anchored=False)
    information, vector = eliminate_before(equations, at)
    # The frame of the next window begins at the first robot.
    here, robots = values.state[at], cut.layout.robots
    back = rotation_matrix(-here[2])
    turn = block_diag(*[block_diag(back, 1.0)] * robots, np.eye(len(information) - 3 * robots))
    mean = np.concatenate([here, values.constants])
    for robot in range(robots):
        mean[3 * robot : 3 * robot + 2] = back @ (mean[3 * robot : 3 * robot + 2] - here[:2])
        mean[3 * robot + 2] -= here[2]
    information = turn @ (information + information.T) @ turn.T / 2
    return Carried(cut.layout, mean, CARRIED_SHARE * information, CARRIED_SHARE * turn @ vector)


def _without_last(rows: Rows) -> Rows:
    """Return rows without the measurements of the last keyframe."""
    weight = rows.weight.copy()
    weight[-1] = 0.0
    return replace(rows, weight=weight)


def _until(problem: Problem, last: int) -> Problem:
    """Return a flight up to a keyframe."""
    robots = tuple(
        replace(
            steps,
            steps_s=steps.steps_s[:last],
            motion=steps.motion.first(last),
            clock_derivative=steps.clock_derivative[:last],
            dropout_s=steps.dropout_s[:last],
            turn_dropout_s=steps.turn_dropout_s[:last],
            height_m=steps.height_m[: last + 1],
        )
        for steps in problem.robots
    )
    links = tuple(select_measurements(link, link.keyframe <= last) for link in problem.links)
    views = tuple(select_measurements(view, view.keyframe <= last) for view in problem.views)
    return replace(
        problem, keyframe_s=problem.keyframe_s[: last + 1], robots=robots, links=links, views=views
    )
