"""Clocks from single range exchanges: offset, drift and their stds."""

import numpy as np
import pytest

from dmrl.estimation.signals import ranging_clocks
from dmrl.estimation.signals.clock_estimation import Clock
from dmrl.estimation.signals.ranging_clocks import (
    MAX_RANGE_DIFFERENCE_M,
    MAX_TIME_DIFFERENCE_S,
    MIN_JITTER_S,
    _fit_line,
    _match_exchanges,
    estimate_from_exchanges,
)


@pytest.mark.heavy
def test_robust_line_fit_has_consistent_stds() -> None:
    x = np.linspace(-100, 100, 2001)
    off = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        y = 0.05 + 3e-4 * x + rng.normal(0, 0.02, len(x))
        y[rng.random(len(x)) < 0.03] += 0.2
        slope, middle, (slope_std, middle_std) = _fit_line(x, y)
        off.append(((slope - 3e-4) / slope_std, (middle - 0.05) / middle_std))
    # Theory: sigma / sqrt(n) for the middle, and that over the standard deviation of x.
    assert middle_std == pytest.approx(0.02 / np.sqrt(len(x)), rel=0.4)
    assert middle_std / slope_std == pytest.approx(x.std(), rel=0.05)
    assert np.sqrt(np.mean(np.square(off), axis=0)[0]) == pytest.approx(1.0, abs=0.4)
    assert MIN_JITTER_S < 0.02


def test_exchanges_are_matched_by_range_and_time() -> None:
    time_s = np.arange(0, 10, 0.1)
    value = 1 + 0.01 * np.arange(100)
    late = time_s + 0.05
    late[[3, 40]] += [2 * MAX_TIME_DIFFERENCE_S, 0.2]  # too late, and unlike the other delays
    seen = value.copy()
    seen[[7, 8]] += [1.5 * MAX_RANGE_DIFFERENCE_M, 0.5 * MAX_RANGE_DIFFERENCE_M]
    found, apart_s = _match_exchanges(late, seen, time_s, value)
    assert set(range(100)) - set(found.tolist()) == {3, 7, 40}
    assert apart_s == pytest.approx(np.full(97, 0.05))


def test_clock_from_exchanges_has_stds_of_offset_and_drift() -> None:
    rng = np.random.default_rng(5)
    time_s = np.arange(0, 200, 0.05)
    range_m = np.round(3 + np.sin(time_s / 3) + np.sin(time_s / 1.7 + 1), 3)
    range_m += np.round(rng.normal(0, 0.1, len(time_s)), 3)
    late = time_s + rng.uniform(0, 0.01, len(time_s))
    clock = estimate_from_exchanges(late, range_m, time_s + 0.04 + 2e-5 * time_s, range_m)
    assert clock is not None
    assert clock.sigma_s / clock.sigma_drift == pytest.approx(time_s.std(), rel=0.05)
    assert clock.sigma_s == pytest.approx(0.01 / 12**0.5 / len(time_s) ** 0.5, rel=0.2)
    assert clock.drift == pytest.approx(-2e-5, abs=4 * clock.sigma_drift)
    middle = clock.at_s + clock.offset_s
    assert middle + 0.04 + 2e-5 * middle - 0.005 == pytest.approx(clock.at_s, abs=1e-3)


def test_matched_exchanges_refine_a_coarse_clock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The coarse estimate is 50 ms and 100 ppm off; the true clock has no error."""
    time_s = np.arange(0, 100, 0.05)
    range_m = 3 + np.sin(time_s / 3) + 0.01 * np.arange(len(time_s)) % 0.5
    monkeypatch.setattr(ranging_clocks, "estimate_clock", lambda *_: Clock(0.05, -1e-4, at_s=40.0))
    clock = estimate_from_exchanges(time_s, range_m, time_s, range_m)
    assert clock is not None
    assert clock.correct_times(time_s) == pytest.approx(time_s, abs=1e-6)
