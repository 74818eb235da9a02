"""Counters are unwrapped, and the jitter of arrival times is removed."""

import math
from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.formats.clocks import CounterUnwrapper, unwrap
from dmrl.formats.timestamps import SteadyRateFilter, _lower_hull, _number_arrivals, dejitter

MS = 1_000_000


@pytest.mark.parametrize("bits", [8, 24, 32])
def test_wrapping_counter_is_unwrapped(bits: int) -> None:
    true = np.cumsum(np.random.default_rng(0).integers(1, 2 ** (bits - 1) - 1, 50))
    assert (unwrap(true % 2**bits, bits) - true == unwrap(true % 2**bits, bits)[0] - true[0]).all()


def test_counter_values_out_of_order_are_kept() -> None:
    assert unwrap([255, 1, 0, 2], 8).tolist() == [255, 257, 256, 258]
    assert unwrap([], 8).tolist() == []


@pytest.mark.parametrize("drop", [0.0, 0.05])
@pytest.mark.parametrize("counted", [True, False])
def test_arrival_jitter_is_removed(drop: float, counted: bool) -> None:
    rng = np.random.default_rng(1)
    number = np.flatnonzero(rng.random(4000) >= drop)
    sent = 10**18 + number * 50_050_000  # the sender's clock is 0.1 % slow
    arrival = np.maximum.accumulate(sent + rng.exponential(2e6, len(number)).astype(np.int64))
    found = dejitter(arrival, number if counted else None)
    assert (found <= arrival).all()
    assert np.abs(found - sent).max() < 50_000
    assert np.abs(arrival - sent).max() > 5_000_000


def test_dejitter_keeps_arrivals_of_irregular_senders() -> None:
    arrival = np.cumsum(np.random.default_rng(2).exponential(5e7, 500)).astype(np.int64)
    assert (dejitter(arrival) == arrival).all()
    assert dejitter([5, 9]).tolist() == [5, 9]


def test_counters_unwrap_forward_or_to_the_nearest() -> None:
    frames = CounterUnwrapper(8, forward=True)
    assert [frames(value) for value in (250, 255, 0, 254, 253)] == [250, 255, 256, 510, 765]
    times = CounterUnwrapper(32)
    assert [times(value) for value in (4294967290, 5, 4294967295)] == [
        4294967290,
        4294967301,
        4294967295,
    ]


def test_counter_finds_nearest_wide_value_without_state_change() -> None:
    times = CounterUnwrapper(24)
    times(5)
    assert times.find_nearest((7 << 24) + 8) == 8
    assert times.find_nearest((1 << 24) - 2) == -2
    assert times(6) == 6


def test_steady_rate_filter_reduces_jitter_causally() -> None:
    rng = np.random.default_rng(3)
    sender, errors_ms, raw_ms, last = SteadyRateFilter(), [], [], 0
    for k in range(1000):
        true_ns = 50 * MS * k
        last = arrival = max(true_ns + round(rng.exponential(15) * MS), last)
        sent = sender(arrival)
        assert sent <= arrival
        errors_ms.append((sent - true_ns) / MS)
        raw_ms.append((arrival - true_ns) / MS)
    assert np.std(errors_ms[100:]) < 0.4 * np.std(raw_ms[100:])


def test_arrivals_after_a_pause_are_unchanged() -> None:
    sender = SteadyRateFilter()
    for k in range(20):
        sender(50 * MS * k)
    assert sender(5000 * MS) == 5000 * MS
    assert sender(5050 * MS) == 5050 * MS


def test_counter_difference_of_half_range_is_backward() -> None:
    assert unwrap([3, 131, 3], 8).tolist() == [3, -125, -253]
    assert unwrap([3, 130], 8).tolist() == [3, 130]
    ahead = CounterUnwrapper(8)
    assert [ahead(value) for value in (3, 130, 2, 129)] == [3, 130, 2, 129]
    assert ahead(1) == 1 and ahead(129) == -127


def test_gap_is_detected_at_0_7_periods_after_the_due_time() -> None:
    steady = [100 * k for k in range(10)]
    for last, number in ((1069, 10), (1072, 11), (1169, 11), (1172, 12), (2500, 25)):
        assert _number_arrivals(np.array([*steady, last])).tolist() == [*range(10), number]


def test_due_time_follows_early_arrivals_with_gain_0_3() -> None:
    # At a period of 100, arrivals are 20 early, then 6 late. They are due at 994 and at 1094.06.
    steady = [*(100 * k for k in range(10)), 980, 1100]
    for last, number in ((1263, 12), (1265, 13)):
        assert _number_arrivals(np.array([*steady, last]))[-1] == number


def test_lower_hull_is_convex_and_takes_the_lowest_of_equal_x() -> None:
    x = np.array([0.0, 1, 1, 2, 3, 3, 4])
    assert _lower_hull(x, np.array([5.0, 2, 1, 3, 0, 4, 4])) == [0, 2, 4, 6]
    assert _lower_hull(x[:3], np.array([0.0, 1, 2])) == [0, 1]
    assert _lower_hull(np.arange(3.0), np.array([0.0, 1, 2])) == [0, 2]  # collinear


@pytest.mark.parametrize("count", [None, [7, 8, 9, 11, 12, 13]])
def test_times_lie_on_the_line_under_all_arrivals(count: list[int] | None) -> None:
    sent = np.array([0, 100, 200, 400, 500, 600]) * MS
    arrival = sent + np.array([3, 0, 4, 0, 3, 1]) * MS
    assert dejitter(10**18 + arrival, count).tolist() == (10**18 + sent).tolist()


def test_steady_rate_filter_starts_at_the_eighth_arrival() -> None:
    sender = SteadyRateFilter()
    arrivals = [0, 60, 90, 160, 195, 260, 300]
    assert [sender(a * MS) for a in arrivals] == [a * MS for a in arrivals]
    # At a period of 352 / 7 ms it is due 50.3 ms after the seventh, plus 1/50 of the delay.
    pace = 352 / 7
    assert sender(352 * MS) == pytest.approx((300 + pace + 0.02 * (52 - pace)) * MS, abs=1)


def test_rate_is_estimated_from_the_last_64_arrivals() -> None:
    sender, now = SteadyRateFilter(), 0
    for step in [50] * 100 + [40] * 64:
        now += step * MS
        assert sender(now) == now  # an early arrival is taken as it is
    pace = (62 * 40 + 50) / 63
    assert sender(now + 50 * MS) == pytest.approx(now + (pace + 0.02 * (50 - pace)) * MS, abs=1)


@pytest.mark.parametrize(("late", "stands"), [(3.7, False), (4.6, True)])
def test_pause_is_longer_than_four_periods(late: float, stands: bool) -> None:
    sender = SteadyRateFilter()
    for k in range(64):
        sender(50 * MS * k)
    # The late arrival increases the period to (62 + 1 + late) / 63 of its value.
    after = round(50 * MS * (64 + late))
    assert (sender(after) == after) == stands
    again = [after + step * MS for step in (30, 90, 170, 200, 270, 310)]
    assert ([sender(moment) for moment in again] == again) == stands


def test_nothing_is_sent_after_it_arrived_on_a_clock_of_today() -> None:
    """On a clock of today, a float resolves only a quarter of a microsecond."""
    rng, sender = np.random.default_rng(4), SteadyRateFilter()
    steps = rng.integers(49 * MS, 51 * MS, 300)
    for arrival in (17 * 10**17 + np.cumsum(steps)).tolist():
        assert sender(arrival) <= arrival


def test_dejitter_needs_three_arrivals() -> None:
    assert dejitter([0, 10, 19]).tolist() == [0, 9, 19]
    assert dejitter([0, 10]).tolist() == [0, 10]
    assert dejitter([]).tolist() == []


def fit_line_below(x: list[int], y: list[int]) -> list[int]:
    """Return the values of the highest line below all points, found by trying all pairs."""
    best: tuple[Fraction, Fraction, Fraction] | None = None
    for (a, b), (c, d) in combinations(list(zip(x, y, strict=True)), 2):
        slope = Fraction(d - b, c - a)
        offset = b - slope * a
        if all(offset + slope * at <= due for at, due in zip(x, y, strict=True)):
            height = offset + slope * Fraction(sum(x), len(x))
            if best is None or height > best[0]:
                best = height, offset, slope
    assert best is not None
    return [math.floor(best[1] + best[2] * at) for at in x]


@given(st.lists(st.tuples(st.integers(1, 9), st.integers(0, 90)), min_size=3, max_size=12))
@pytest.mark.heavy
def test_times_follow_the_highest_line_below_all_arrivals(
    steps: list[tuple[int, int]],
) -> None:
    number = np.cumsum([step for step, _ in steps])
    arrival = 100 * number + np.array([late for _, late in steps])
    found = dejitter(10**15 + arrival, number) - 10**15
    line = fit_line_below(number.tolist(), arrival.tolist())
    # If two lines have the same mean, either is correct.
    assert (found <= arrival).all()
    assert found.tolist() == line or abs(found.sum() - sum(line)) <= len(line)
