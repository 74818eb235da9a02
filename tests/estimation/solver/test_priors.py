"""Priors of chains and constants: their costs and information."""

import numpy as np
import pytest

from dmrl.estimation.solver.block_tridiagonal import NormalEquations
from dmrl.estimation.solver.equations import linearize
from dmrl.estimation.solver.priors import Chain, ConstantPrior
from dmrl.estimation.solver.robust_loss import Cauchy, Gaussian
from dmrl.estimation.solver.unknowns import Unknown

from .test_residuals import build_flight


def test_information_of_a_chain_is_jtj_of_its_residuals() -> None:
    row = Unknown("a", "m", 0.1, "pair", evolution="walk")
    kept, std, value = np.array([0.5, 0.9]), np.array([0.1, 0.2]), np.array([0.3, 0.2, 0.6])
    equations = NormalEquations.zeros(3, 1, 0)
    Chain(row, 0, value, kept, std, 0.4).add_to(equations)
    slopes = np.array([[1 / 0.4, 0, 0], [-0.5 / 0.1, 1 / 0.1, 0], [0, -0.9 / 0.2, 1 / 0.2]])
    square = slopes.T @ slopes
    assert equations.diagonal[:, 0, 0] == pytest.approx(np.diag(square))
    assert equations.off_diagonal[:, 0, 0] == pytest.approx(np.diag(square, 1))
    assert equations.gradient[:, 0] == pytest.approx(square @ value)


def test_chain_factor_is_a_random_walk_with_start_prior() -> None:
    row = Unknown("a", "m", 0.1, "pair", Cauchy(1.0), "jump", pull_std=0.05, pull_weight=0.04)
    value, kept, std = np.array([0.3, 0.2, 0.6]), np.array([0.5, 0.9]), np.array([0.1, 0.2])
    chain = Chain(row, 0, value, kept, std, 0.4)
    assert chain.residual == pytest.approx([0.75, (0.2 - 0.15) / 0.1, (0.6 - 0.18) / 0.2])
    loss = np.log1p(chain.residual**2).sum() + 0.04 * np.log1p((value / 0.05) ** 2).sum()
    assert chain.cost() == pytest.approx(loss / 2)
    problem, values = build_flight()
    begun, carried = (
        [f for f in linearize(problem, problem.layout, values, known=k) if isinstance(f, Chain)]
        for k in ((), dict(problem.layout.states))
    )
    for one, other in zip(begun, carried, strict=True):
        if one.row.evolution == "jump":
            assert (one.start_std, other.start_std) == (one.row.start_std, np.inf)
        else:
            assert one.start_std == other.start_std == one.row.std


def test_priors_hold_constants_with_their_losses() -> None:
    prior = ConstantPrior(np.array([0.2, 0.3]), np.array([0.1, 0.1]), (Cauchy(2.0), Gaussian()))
    assert prior.cost() == pytest.approx((4 * np.log(2.0) + 9) / 2)
    assert prior.information() == pytest.approx([50.0, 100.0])
    assert prior.curvature() == pytest.approx([0.0, 100.0])
