import numpy as np

from dmrl.estimation.sensors import frozen, track, wild

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


def test_an_estimate_that_runs_away_at_the_end_is_cut_off() -> None:
    velocity, turn, height = noisy(), np.zeros((len(GRID_S), 1)), np.ones((len(GRID_S), 1))
    crash = GRID_S > 16
    velocity[crash] += np.minimum(9, 6 * (GRID_S[crash] - 16))[:, None]
    found = track((GRID_S, turn), (GRID_S, velocity), (GRID_S, height), GRID_S)
    assert found.gap[GRID_S > 16].all() and not found.gap[GRID_S < 14].any()
    assert not found.vx_mps[crash].any()


def test_fast_flight_and_single_outliers_do_not_run_away() -> None:
    speed = 2.5 + noisy()[:, 0]
    speed[::50] = 20.0
    assert not wild(speed, 3.0).any()
