"""Jumps of a clock, found from a distance that is logged on two clocks."""

import numpy as np
import pytest

from dmrl.estimation.signals.clock_estimation import Array
from dmrl.estimation.signals.clock_jumps import ClockJump, find_clock_jump


def compute_distance(time_s: Array) -> Array:
    """Return a distance whose pattern hardly repeats, metres."""
    parts = ((0.5, 0.5, 0.0), (0.4, 0.83, 1.0), (0.3, 1.27, 2.0), (0.4, 0.19, 3.0))
    return np.asarray(3 + sum(size * np.sin(rate * time_s + at) for size, rate, at in parts))


def measure_jump(correct: Array, seed: int = 0, noise_m: float = 0.08) -> ClockJump | None:
    """Return the jump of a clock whose uniform log times correspond to these (N,) true times."""
    rng = np.random.default_rng(seed)
    time_s = np.linspace(0.0, 100.0, len(correct))
    one, other = (
        compute_distance(at) + rng.normal(0, noise_m, len(at)) for at in (time_s, correct)
    )
    return find_clock_jump(time_s, one, time_s, other)


LOG_S = np.linspace(0.0, 100.0, 1000)


@pytest.mark.parametrize("shift_s", [-0.9, -0.4, 0.3, 0.5])
@pytest.mark.parametrize("at_s", [25.0, 50.0])
def test_a_jump_is_located_and_measured(shift_s: float, at_s: float) -> None:
    found = measure_jump(LOG_S + shift_s * (at_s < LOG_S))
    assert found is not None and found.gain > 15
    assert found.shift_s == pytest.approx(shift_s, abs=5 * found.sigma_s)
    assert found.from_s == pytest.approx(at_s, abs=2.0)


@pytest.mark.parametrize("seed", range(5))
def test_an_offset_is_no_jump(seed: int) -> None:
    found = measure_jump(LOG_S + 0.3, seed)
    assert found is not None and found.gain < 8


@pytest.mark.parametrize("drift", [-3e-3, 1e-3, 3e-3])
def test_a_drift_is_no_jump(drift: float) -> None:
    found = measure_jump(LOG_S * (1 + drift))
    assert found is not None and found.gain < 5


def test_outliers_are_no_jump() -> None:
    rng = np.random.default_rng(3)
    values = compute_distance(LOG_S) + rng.normal(0, 0.08, len(LOG_S))
    bursts = (np.abs((LOG_S % 20) - 10) < 1) & (LOG_S > 50)
    found = find_clock_jump(LOG_S, compute_distance(LOG_S), LOG_S, values + 1.5 * bursts)
    assert found is not None and found.gain < 8


@pytest.mark.heavy
def test_short_or_unlike_series_show_no_jump() -> None:
    short = LOG_S[:250]
    assert find_clock_jump(short, compute_distance(short), short, compute_distance(short)) is None
    assert find_clock_jump(short[:5], short[:5], short[:5], short[:5]) is None
    rng = np.random.default_rng(1)
    noise = rng.normal(0, 1, (2, len(LOG_S)))
    assert find_clock_jump(LOG_S, noise[0], LOG_S, noise[1]) is None


def test_gaps_of_either_series_do_not_affect_the_jump() -> None:
    jumping = LOG_S - 0.4 * (LOG_S > 60)
    here = (LOG_S < 30) | (LOG_S > 36)
    there = (LOG_S < 70) | (LOG_S > 75)
    noise = np.random.default_rng(5).normal(0, 0.05, (2, len(LOG_S)))
    one, other = compute_distance(LOG_S) + noise[0], compute_distance(jumping) + noise[1]
    found = find_clock_jump(LOG_S[here], one[here], LOG_S[there], other[there])
    assert found is not None and found.gain > 15
    assert found.shift_s == pytest.approx(-0.4, abs=5 * found.sigma_s)
    assert found.from_s == pytest.approx(60, abs=2.0)
