import numpy as np

from dmrl.estimation.sensors import frozen, track

GRID_S = np.arange(0, 20, 0.01)


def noisy() -> np.ndarray:
    return np.random.default_rng(0).normal(0, 0.1, (len(GRID_S), 2))


def test_flow_that_reads_zero_is_silence() -> None:
    velocity = noisy()
    stuck = (GRID_S > 5) & (GRID_S < 9)
    velocity[stuck] = 0.0
    height = np.ones((len(GRID_S), 1))
    found = track((GRID_S, height), (GRID_S, velocity), (GRID_S, height), GRID_S)
    assert (found.gap == stuck).mean() > 0.99


def test_a_log_that_repeats_its_samples_or_stands_still_is_not_frozen() -> None:
    slow = np.repeat(noisy()[::20], 20, axis=0)
    assert not frozen(GRID_S, slow, GRID_S).any()
    assert not frozen(GRID_S, np.zeros((len(GRID_S), 2)), GRID_S).any()
