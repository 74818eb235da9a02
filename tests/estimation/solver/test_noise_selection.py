"""The noise of ranges is selected from their residuals."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.solver.noise_selection import range_noise_ratio
from dmrl.estimation.solver.problem import Problem
from dmrl.estimation.solver.residuals import Values

from .test_residuals import build_flight

STD_M = 0.12


def build_with_errors(size_m: float, lasting: int) -> tuple[Problem, Values]:
    """Return a flight with random range errors, each constant over a number of ranges."""
    problem, true = build_flight()
    (link,) = problem.links
    draws = np.random.default_rng(1).normal(0.0, size_m, len(link.range_m) // lasting + 1)
    error = np.repeat(draws, lasting)[: len(link.range_m)]
    noise = replace(problem.noise, range_std_m=STD_M)
    links = (replace(link, range_m=link.range_m + error),)
    return replace(problem, links=links, noise=noise), true


@pytest.mark.parametrize(("factor", "ratio"), [(0.5, 1.0), (1.0, 1.0), (3.4, 3.4)])
def test_ratio_of_white_noise_is_that_of_single_ranges(factor: float, ratio: float) -> None:
    found = range_noise_ratio(*build_with_errors(factor * STD_M, 1))
    assert found == pytest.approx(ratio, rel=0.3)
