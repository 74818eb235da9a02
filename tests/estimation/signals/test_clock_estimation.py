"""Offset and drift between clocks, estimated from ranges that two robots measured."""

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from dmrl.estimation.signals.clock_estimation import (
    GRID_STEP_S,
    MIN_OVERLAP_S,
    TREND_WINDOW_S,
    Clock,
    Series,
    _running_mean,
    _smooth_gaussian,
    connect_clocks,
    estimate_clock,
)
from dmrl.estimation.signals.ranging_clocks import estimate_from_exchanges

Array = np.ndarray
OFFSET_S, DRIFT = 0.080, 20e-6


def compute_distance(time_s: Array, seed: int) -> Array:
    """Return a varying distance of two robots, metres."""
    rng = np.random.default_rng(seed)
    waves = [
        rng.uniform(0.1, 0.4) * np.sin(rng.uniform(0.1, 2.0) * time_s + rng.uniform(0, 6))
        for _ in range(8)
    ]
    return 3.0 + np.sum(waves, axis=0)


def to_wrong_clock(time_s: Array) -> Array:
    """Return the times of a clock that is 20 ppm fast, and 80 ms ahead at 150 s."""
    return time_s + OFFSET_S + DRIFT * (time_s - 150)


def simulate_exchanges(seed: int) -> tuple[Array, Array, Array, Array]:
    """Simulate range exchanges for 5 min at 25 Hz, logged with up to 10 ms delay and 10 % loss."""
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.03, 0.05, 7500))
    time = time[time < 300]
    measured = np.round(compute_distance(time, seed) + rng.normal(0, 0.1, len(time)), 3)
    measured[rng.random(len(time)) < 0.03] += 1.5  # no line of sight
    here, there = rng.random((2, len(time))) > 0.1
    return (
        (time + rng.uniform(0, 0.01, len(time)))[here],
        measured[here],
        to_wrong_clock(time + rng.uniform(0, 0.01, len(time)))[there],
        measured[there],
    )


def compute_worst_error_s(clock: Clock | None) -> float:
    """Return the largest error of the corrected clock within five minutes, seconds."""
    assert clock is not None
    time = np.linspace(0, 300, 61)
    return float(np.abs(clock.correct_times(to_wrong_clock(time)) - time).max())


@pytest.mark.parametrize("seed", range(5))
def test_clock_is_recovered_within_5_ms_over_5_minutes(seed: int) -> None:
    clock = estimate_from_exchanges(*simulate_exchanges(seed))
    assert compute_worst_error_s(clock) < 0.005
    assert clock is not None and clock.sigma_s < 0.001


@pytest.mark.parametrize("apart_s", [-40.0, 3600.0])
def test_clocks_may_be_far_apart(apart_s: float) -> None:
    here, range_m, there, peer_m = simulate_exchanges(0)
    clock = estimate_from_exchanges(here, range_m, there + apart_s, peer_m)
    assert clock is not None
    assert clock.offset_s == pytest.approx(-OFFSET_S - apart_s, abs=0.005)


@pytest.mark.heavy
def test_clock_sigma_is_consistent_for_independent_ranges() -> None:
    errors = []
    for seed in range(8):
        rng = np.random.default_rng(100 + seed)
        here, there = (np.sort(rng.uniform(0, 300, 9000)) for _ in range(2))
        clock = estimate_from_exchanges(
            here,
            compute_distance(here, seed) + rng.normal(0, 0.1, 9000),
            to_wrong_clock(there),
            compute_distance(there, seed) + rng.normal(0, 0.1, 9000) + 0.2,
        )
        assert clock is not None
        errors.append((clock.offset_s + OFFSET_S) / clock.sigma_s)
    assert 0.3 < np.sqrt(np.mean(np.square(errors))) < 2.5


def test_clock_alignment_is_independent_of_signal_scale() -> None:
    """For example, image motion in pixels is aligned with a gyroscope."""
    time, rng = np.arange(0, 300, 0.01), np.random.default_rng(3)
    seen = np.arange(0, 300, 0.05)
    turn = compute_distance(time, 5) - 3
    pixels = 9.2 * (compute_distance(seen, 5) - 3) + rng.normal(0, 0.3, len(seen))
    assert compute_worst_error_s(estimate_clock(time, turn, to_wrong_clock(seen), pixels)) < 0.005


@pytest.mark.parametrize("count", [0, 5, 100])
def test_clock_needs_enough_exchanges(count: int) -> None:
    here, range_m, there, peer_m = simulate_exchanges(0)
    assert estimate_from_exchanges(here, range_m, there[:count], peer_m[:count]) is None


def test_uncorrelated_ranges_give_no_clock() -> None:
    here, range_m, there, _ = simulate_exchanges(0)
    noise = np.random.default_rng(0).normal(size=len(there))
    assert estimate_from_exchanges(here, range_m, there, noise) is None


def test_clocks_compose_and_invert() -> None:
    one, two = Clock(0.5, 1e-5, 100.0, 0.003), Clock(-2.0, -3e-5, 40.0, 0.004)
    time = np.linspace(0, 300, 7)
    chained = two.compose_after(one)
    np.testing.assert_allclose(
        chained.correct_times(time), two.correct_times(one.correct_times(time))
    )
    np.testing.assert_allclose(one.invert().correct_times(one.correct_times(time)), time, atol=1e-9)
    assert chained.sigma_s == pytest.approx(0.005)


def test_most_certain_clock_links_are_used() -> None:
    pairs = {
        ("a", "b"): Clock(1.0, sigma_s=0.001),
        ("c", "b"): Clock(5.0, sigma_s=0.001),
        ("a", "c"): Clock(99.0, sigma_s=0.1),
        ("d", "e"): Clock(7.0),
    }
    found = connect_clocks(pairs, "a")
    assert found.keys() == {"a", "b", "c"}
    assert found["c"].offset_s == pytest.approx(1.0 - 5.0)


CLOCKS = st.builds(Clock, st.floats(-100, 100), st.floats(-1e-3, 1e-3), st.floats(-1000, 1000))
TIMES_S = np.linspace(-500, 500, 5)


@given(CLOCKS, CLOCKS)
def test_random_clocks_compose_and_invert(one: Clock, two: Clock) -> None:
    both = two.compose_after(one).correct_times(TIMES_S)
    np.testing.assert_allclose(both, two.correct_times(one.correct_times(TIMES_S)), atol=1e-8)
    np.testing.assert_allclose(
        one.invert().correct_times(one.correct_times(TIMES_S)), TIMES_S, atol=1e-8
    )


@settings(max_examples=12, phases=[Phase.generate])
@given(st.floats(-50, 50), st.floats(-20e-6, 20e-6), st.floats(0.1, 5), st.integers(0, 99))
@pytest.mark.heavy
def test_random_offset_and_drift_are_recovered(
    offset_s: float, drift: float, scale: float, seed: int
) -> None:
    seen_s, also_s = np.arange(0, 60, 0.05), np.arange(0.02, 60, 0.07)
    stamps = also_s + offset_s + drift * (also_s - 30)
    values = scale * compute_distance(also_s, seed) + 1.0
    clock = estimate_clock(seen_s, compute_distance(seen_s, seed), stamps, values)
    assert clock is not None
    assert np.abs(clock.correct_times(stamps) - also_s).max() < 0.01


@pytest.mark.parametrize("cut_s", [12.0, -12.0])
def test_clocks_need_not_begin_together(cut_s: float) -> None:
    """Either clock may start 12 s before the other."""
    seen_s, also_s = np.arange(0, 90, 0.05), np.arange(0.02, 90, 0.07)
    seen_s, also_s = seen_s[seen_s > cut_s], also_s[also_s > -cut_s]
    stamps = also_s + 3.3
    clock = estimate_clock(seen_s, compute_distance(seen_s, 4), stamps, compute_distance(also_s, 4))
    assert clock is not None
    assert np.abs(clock.correct_times(stamps) - also_s).max() < 0.01
    assert also_s[0] - 1 < clock.at_s - 3.3 < also_s[-1] + 1


def test_offset_and_drift_have_separate_stds() -> None:
    for one in (simulate_exchanges(0), simulate_exchanges(1)):
        clock = estimate_from_exchanges(*one)
        assert clock is not None
        # In a line fit, the ratio of both stds is the standard deviation of the times.
        assert clock.sigma_s / clock.sigma_drift == pytest.approx(300 / 12**0.5, rel=0.1)
        assert clock.sigma_s == pytest.approx(0.01 / 6**0.5 / len(one[2]) ** 0.5, rel=1.0)
        assert abs(clock.drift + DRIFT) < 5 * clock.sigma_drift


def test_composed_clock_adds_variances() -> None:
    one = Clock(1.0, 1e-5, 5.0, 0.003, 4e-6, 0.9, "ranges")
    two = Clock(2.0, 2e-5, 7.0, 0.004, 3e-6, 0.8, "turns")
    both = two.compose_after(one)
    assert (both.sigma_s, both.sigma_drift) == pytest.approx((0.005, 5e-6))
    assert (both.correlation, both.by, both.at_s) == (0.8, "ranges, turns", 5.0)
    assert both.compose_after(both).by == "ranges, turns"
    back = one.invert()
    assert (back.sigma_s, back.sigma_drift, back.correlation, back.by) == (
        0.003,
        4e-6,
        0.9,
        "ranges",
    )
    assert back.at_s == 6.0


def test_resampled_series_rejects_outliers_and_marks_gaps() -> None:
    time_s = np.concatenate([np.arange(0, 30, 0.1), np.arange(32, 60, 0.1)])
    values = np.sin(time_s / 3)
    spoilt = values.copy()
    spoilt[7:-7:9] += 5.0
    clean, heard = (Series.from_samples(time_s, v) for v in (values, spoilt))
    assert clean is not None and heard is not None
    assert np.abs(heard.values - clean.values).max() < 0.05
    inner = slice(30, -30)  # the ends are affected by padding
    assert clean.values[inner] == pytest.approx(np.sin(clean.time_s[inner] / 3), abs=0.08)
    assert clean.time_s[0] == 0.0 and np.diff(clean.time_s) == pytest.approx(GRID_STEP_S)
    unknown = clean.time_s[~clean.known]
    assert unknown[[0, -1]] == pytest.approx([29.9, 32.0], abs=2 * GRID_STEP_S)
    assert len(unknown) == pytest.approx(2.1 / GRID_STEP_S, abs=3)


@pytest.mark.parametrize(("gap_s", "unknown"), [(0.95, False), (1.05, True)])
def test_a_second_without_samples_is_not_known(gap_s: float, unknown: bool) -> None:
    time_s = np.concatenate([np.arange(0, 30, 0.1), 29.9 + gap_s + np.arange(0, 30, 0.1)])
    found = Series.from_samples(time_s, np.sin(time_s / 3))
    assert found is not None
    assert (~found.known).any() == unknown


def test_given_clocks_have_zero_sigma() -> None:
    both = Clock(0.5).compose_after(Clock(0.25))
    assert (both.offset_s, both.sigma_s, both.sigma_drift) == (0.75, 0.0, 0.0)


@pytest.mark.parametrize(
    ("lasts_s", "enough"), [(MIN_OVERLAP_S - 0.5, False), (MIN_OVERLAP_S + 0.5, True)]
)
def test_clock_series_needs_twenty_seconds(lasts_s: float, enough: bool) -> None:
    time_s = np.arange(0, lasts_s, 0.1)
    assert (Series.from_samples(time_s, np.sin(time_s)) is not None) == enough


@given(st.lists(st.floats(-5, 5), min_size=1, max_size=30))
def test_trend_is_a_running_mean_with_repeated_ends(values: list[float]) -> None:
    """The series here are shorter than the window, which is then reduced to their length."""
    array = np.array(values)
    width = min(int(TREND_WINDOW_S / GRID_STEP_S), len(array)) | 1
    padded = [array[0]] * (width // 2) + values + [array[-1]] * (width // 2)
    wanted = [np.mean(padded[k : k + width]) for k in range(len(values))]
    assert _running_mean(array) == pytest.approx(np.array(wanted), abs=1e-9)


def test_gaussian_smoothing_keeps_constants_and_spreads_an_impulse() -> None:
    assert _smooth_gaussian(np.full(50, 3.0), 0.3) == pytest.approx(np.full(50, 3.0))
    point = np.zeros(401)
    point[200] = 1.0
    bell = _smooth_gaussian(point, 0.3)
    away_s = (np.arange(401) - 200) * GRID_STEP_S
    assert bell.sum() == pytest.approx(1.0)
    assert (bell * away_s).sum() == pytest.approx(0.0, abs=1e-12)
    assert (bell * away_s**2).sum() ** 0.5 == pytest.approx(0.3, rel=0.01)
    assert np.abs(away_s[bell > 0]).max() == pytest.approx(4 * 0.3, abs=1.01 * GRID_STEP_S)
