"""The equations of a swarm are those of its cost, by finite differences."""

import numpy as np
import pytest

from dmrl.estimation.motion import Increments
from dmrl.estimation.problem import Noise
from dmrl.estimation.swarm_solve import (
    OWN,
    ROBOT,
    SHARED,
    Flight,
    Link,
    _cost,
    _equations,
    _rows,
    _weights,
)

NOISE = Noise()
ROBOTS, KEYS, RANGES = 3, 5, 12
PAIRS = ((0, 1), (0, 2), (1, 2))


@pytest.fixture(scope="module")
def flight() -> Flight:
    """Measurements that belong to no motion: no residual is small by chance."""
    rng = np.random.default_rng(0)
    steps = KEYS - 1
    return Flight(
        names=["cf1", "cf2", "cf3"],
        key_s=np.cumsum(rng.uniform(0.1, 0.4, KEYS)),
        moves=[
            Increments(*(rng.normal(size=s) for s in (steps, (steps, 2), (steps, 2, 2))))
            for _ in range(ROBOTS)
        ],
        paths=[(np.zeros(KEYS), np.zeros((KEYS, 2)))] * ROBOTS,
        gap_s=rng.uniform(0, 0.1, (ROBOTS, steps)),
        links=[
            Link(
                pair,
                np.sort(rng.integers(0, KEYS, RANGES)),
                rng.uniform(1, 3, RANGES),
                *rng.normal(size=(2, RANGES, 2)),
                rng.normal(size=RANGES),
            )
            for pair in PAIRS
        ],
    )


def test_the_gradient_is_the_slope_of_the_cost(flight: Flight) -> None:
    rng = np.random.default_rng(1)
    state = rng.normal(size=(KEYS, ROBOTS, OWN))
    constants = 0.1 * rng.normal(size=ROBOTS * ROBOT + len(PAIRS) * SHARED)

    def cost(at: np.ndarray, with_constants: np.ndarray) -> float:
        return _cost(flight, NOISE, _rows(flight, NOISE, at, with_constants), with_constants)

    rows = _rows(flight, NOISE, state, constants)
    found = _equations(flight, NOISE, rows, constants, _weights(NOISE, rows))
    step = 1e-5
    slopes = np.empty(state.size)
    for k in range(state.size):
        change = step * (np.arange(state.size) == k).reshape(state.shape)
        slopes[k] = (cost(state + change, constants) - cost(state - change, constants)) / (2 * step)
    scale = np.abs(slopes).max()
    assert found.gradient.ravel() == pytest.approx(slopes, rel=1e-4, abs=1e-7 * scale)
    for k in range(len(constants)):
        change = step * (np.arange(len(constants)) == k)
        slope = (cost(state, constants + change) - cost(state, constants - change)) / (2 * step)
        assert found.corner_gradient[k] == pytest.approx(slope, rel=1e-4, abs=1e-7 * scale)
