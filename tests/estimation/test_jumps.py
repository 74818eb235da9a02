import numpy as np
import pytest

from dmrl.estimation.jumps import levelled_height, levels

TIME_S = np.arange(0, 60, 0.01)


def climbing(noise_m: float) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0, noise_m, len(TIME_S))
    return np.asarray(1 + 0.3 * np.sin(TIME_S) + noise)


@pytest.mark.parametrize("noise_m", [0.0, 0.02, 0.03])
def test_heights_over_a_box_are_heights_above_the_floor(noise_m: float) -> None:
    floor = climbing(noise_m)
    over = ((TIME_S > 10) & (TIME_S < 12)) | ((TIME_S > 30) & (TIME_S < 31.5))
    found = levelled_height(TIME_S, floor - 0.35 * over)
    off = np.abs(found - floor)
    assert np.quantile(off, 0.99) < 0.06
    assert (off > 0.1).mean() < 0.001


def test_heights_that_do_not_jump_stay_as_they_are() -> None:
    for noise_m in (0.0, 0.02, 0.05):
        height = climbing(noise_m)
        assert (levelled_height(TIME_S, height) == height).all()


def test_a_signal_that_begins_and_one_that_ends_too_large() -> None:
    values = np.zeros(400)
    values[:50], values[380:] = 1.0, 2.0
    found = levels(values, 0.1, 0.45, 3)
    assert np.allclose(found[:50], 1.0)
    assert np.allclose(found[50:380], 0.0)
    assert np.allclose(found[380:], 2.0)


def test_what_never_comes_back_is_no_level() -> None:
    values = np.zeros(800)
    values[300:] = 1.0
    assert not levels(values, 0.1, 0.45, 3).any()
