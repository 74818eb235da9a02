"""Information that a window takes over from the previous one, also with other unknowns."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.solver.block_tridiagonal import NormalEquations
from dmrl.estimation.solver.levenberg_marquardt import MapEstimate, Solver
from dmrl.estimation.solver.priors import Carried
from dmrl.estimation.solver.robust_loss import Cauchy, Gaussian, Loss
from dmrl.estimation.solver.unknowns import Unknown, turn

from .test_residuals import build_flight


def build_carried(solver: Solver) -> Carried:
    """Return random positive definite information about the unknowns of a solver."""
    layout = solver.layout
    size = layout.width + len(layout.constants)
    roots = np.random.default_rng(3).normal(size=(size, size))
    return Carried(layout, np.linspace(-1, 1, size), roots @ roots.T, roots[0])


def test_carried_information_is_least_at_its_optimum() -> None:
    carried = build_carried(Solver(build_flight()[0]))
    best = carried.mean - np.linalg.solve(carried.information, carried.vector)
    off = best.copy()
    off[-1] += 0.2
    costs = [carried.to_factor(value, Gaussian()).cost() for value in (best, off)]
    expected = carried.information[-1, -1] * 0.04 / 2
    assert costs == pytest.approx([0.0, expected], rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("loss", [Gaussian(), Cauchy(3.0)])
def test_carried_information_adds_the_gradient_of_its_cost(loss: Loss) -> None:
    carried = build_carried(Solver(build_flight()[0]))
    width, size = carried.layout.width, len(carried.mean)
    value, step = carried.mean + 0.1 * np.random.default_rng(4).normal(size=size), 1e-5
    equations = NormalEquations.zeros(2, width, size - width)
    carried.to_factor(value, loss).add_to(equations)
    ends = [
        [carried.to_factor(value + way * one, loss).cost() for one in step * np.eye(size)]
        for way in (1, -1)
    ]
    slope = np.subtract(*ends) / (2 * step)
    found = np.concatenate([equations.gradient[0], equations.globals_gradient])
    assert found == pytest.approx(slope, rel=1e-4, abs=1e-4)
    assert not equations.gradient[1].any()


def test_carried_heading_may_differ_by_whole_turns() -> None:
    carried = build_carried(Solver(build_flight()[0]))
    turned = carried.mean.copy()
    turned[[2, 5]] += 2 * np.pi * np.array([1, -4])
    costs = [carried.to_factor(value, Gaussian()).cost() for value in (carried.mean, turned)]
    assert costs[1] == pytest.approx(costs[0])


def test_carried_information_is_of_the_unknowns_that_both_layouts_have() -> None:
    """Unknowns that are dropped are marginalized; new unknowns have no information."""
    problem, _ = build_flight()
    carried = build_carried(Solver(problem))
    free = Unknown("scale_free", "1", 0.1, "robot", motion=turn)
    more = replace(problem, table=(*problem.table, free)).layout
    fewer = replace(problem, table=problem.table[:-1]).layout
    wide = carried.convert(more)
    new = [column for subject, column in more.subjects().items() if subject[0] == "scale_free"]
    assert not wide.information[new].any() and not wide.vector[new].any()
    small, mine = carried.convert(fewer), carried.layout.subjects()
    kept = [mine[subject] for subject in fewer.subjects()]
    assert len(kept) < len(mine)
    marginal = np.linalg.inv(carried.information)[np.ix_(kept, kept)]
    assert np.linalg.inv(small.information) == pytest.approx(marginal)
    best = [one.mean - np.linalg.solve(one.information, one.vector) for one in (carried, small)]
    assert best[1] == pytest.approx(best[0][kept])
    back = wide.convert(carried.layout)
    assert back.information == pytest.approx(carried.information)


def test_evidence_is_finite_after_an_earlier_window() -> None:
    """The carried information then replaces the broad prior on first values of random walks."""
    problem, values = build_flight()
    solver = Solver(problem)
    found = MapEstimate(values, 0.0)
    later = replace(solver, carried=build_carried(solver))
    assert np.isfinite([solver.log_evidence(found), later.log_evidence(found)]).all()
