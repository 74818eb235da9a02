"""Estimation of all pairs of a flight by the method of `dmrl label`."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from dmrl.estimation.model.gate import DEFAULT_GATE
from dmrl.flight import NOISE, Scenario, simulate
from dmrl.labelling.pair_estimation import PairSolver, estimate_all

from ..estimation.flights import build_pair


@pytest.mark.heavy
def test_pairs_of_a_robot_that_is_left_out_are_estimated_alone(
    capsys: pytest.CaptureFixture[str],
) -> None:
    flight = simulate(Scenario(3, 20.0, "random"), NOISE["calibrated"], 1)
    pairs = {names: build_pair(flight, *names) for names in combinations(flight.robots, 2)}
    solver = PairSolver("swarm", "", DEFAULT_GATE)
    together = estimate_all(pairs, solver, 1, lambda work, items, _: map(work, items))
    assert "pair by pair" not in capsys.readouterr().err
    # The third robot lands, so the first two are a pair, which is estimated alone.
    landed = {n: pair.crop(0.0, 10.0) if "cf3" in n else pair for n, pair in pairs.items()}
    found, alone = (
        estimate_all(landed, one, 1, lambda work, items, _: map(work, items))
        for one in (solver, replace(solver, method="batch"))
    )
    assert "cf1, cf2, cf3: estimated pair by pair" in capsys.readouterr().err
    assert set(together) == set(found) == {*pairs, *(names[::-1] for names in pairs)}
    for names, estimate in found.items():
        np.testing.assert_array_equal(estimate.state, alone[names].state)
    assert not np.array_equal(together["cf1", "cf2"].state, found["cf1", "cf2"].state)
