"""Measurements of a pair of robots, resampled to common times."""

import numpy as np
import pytest

from dmrl.estimation.model.pair import (
    Pair,
    SensorTrack,
    longest_gap_s,
    resample,
    usable_ranges,
)

GRID = np.arange(200) / 100
STILL = SensorTrack(*np.zeros((4, 200)), np.zeros(200, bool))


def test_impossible_ranges_are_not_usable() -> None:
    time_s = np.arange(7.0)
    range_m = np.array([1.0, 0.0, -1.0, 65535.0, np.nan, np.inf, 2.0])
    assert usable_ranges(time_s, range_m).tolist() == [True, *[False] * 5, True]


def test_a_range_from_before_the_last_one_is_not_usable() -> None:
    assert usable_ranges(np.array([0.0, 2.0, 1.0, 2.0]), np.ones(4)).tolist() == [
        True,
        True,
        False,
        True,
    ]


def test_inconsistent_pairs_are_refused() -> None:
    Pair(GRID, STILL, STILL, np.array([0.5]), np.array([1.0]))
    with pytest.raises(ValueError, match="time order"):
        Pair(GRID, STILL, STILL, np.array([0.5]), np.array([-1.0]))
    with pytest.raises(ValueError, match="outside the time grid"):
        Pair(GRID, STILL, STILL, np.array([9.0]), np.array([1.0]))
    with pytest.raises(ValueError, match="as many range times"):
        Pair(GRID, STILL, STILL, np.array([0.5]), np.array([1.0, 2.0]))
    with pytest.raises(ValueError, match="not uniform and increasing"):
        Pair(GRID[::-1], STILL, STILL, np.array([0.5]), np.array([1.0]))
    for at in (0.105, 0.11):  # a longer step, and a step of zero
        with pytest.raises(ValueError, match="not uniform and increasing"):
            uneven = np.where(np.arange(200) == 10, at, GRID)
            Pair(uneven, STILL, STILL, np.array([0.5]), np.array([1.0]))
    broken = SensorTrack(np.full(200, np.nan), *np.zeros((3, 200)), np.zeros(200, bool))
    short = SensorTrack(*np.zeros((4, 199)), np.zeros(199, bool))
    for odd in (broken, short):
        with pytest.raises(ValueError, match="peer: signals are not 200 finite numbers"):
            Pair(GRID, STILL, odd, np.array([0.5]), np.array([1.0]))


def test_a_pair_seen_from_the_peer_has_the_same_ranges() -> None:
    fast = SensorTrack(np.ones(200), *np.zeros((3, 200)), np.zeros(200, bool))
    pair = Pair(GRID, STILL, fast, np.array([0.5]), np.array([1.0])).swap_robots()
    assert pair.own is fast
    assert pair.peer is STILL
    assert pair.dt_s == pytest.approx(0.01)


def test_resampling_drops_non_finite_and_backward_samples() -> None:
    time_s = np.array([0.0, 0.1, 0.2, 0.15, 0.3])
    values = np.array([[0.0], [1.0], [np.nan], [99.0], [3.0]])
    # The sample at 0.15 follows that at 0.2, so it is dropped, although 0.2 has no value.
    signal, gap = resample(time_s, values, np.array([0.0, 0.2, 0.3]))
    assert signal[:, 0].tolist() == pytest.approx([0.0, 2.0, 3.0])
    assert not gap.any()


def test_resampling_keeps_the_first_of_equal_times() -> None:
    values = np.array([[0.0], [1.0], [99.0], [2.0]])
    signal, _ = resample(np.array([0.0, 0.1, 0.1, 0.2]), values, np.array([0.1, 0.15, 0.2]))
    assert signal[:, 0].tolist() == pytest.approx([1.0, 1.5, 2.0])


def test_resampling_marks_silence_of_half_a_second() -> None:
    time_s = np.array([0.0, 0.4, 1.0, 1.1])
    _, gap = resample(time_s, np.zeros((4, 1)), np.array([0.2, 0.4, 0.7, 1.0, 1.05]))
    assert gap.tolist() == [False, False, True, False, False]


def test_resampling_nothing_is_an_error() -> None:
    with pytest.raises(ValueError, match="no sample is finite"):
        resample(np.array([0.0]), np.array([[np.nan]]), GRID)


@pytest.mark.parametrize(("rate_hz", "longest_s"), [(100, 0.5), (3, 0.5), (1, 1.5), (0.1, 2.0)])
def test_a_slow_log_may_miss_no_sample(rate_hz: float, longest_s: float) -> None:
    assert longest_gap_s(np.arange(20) / rate_hz) == pytest.approx(longest_s)
    assert longest_gap_s(np.zeros(1)) == 0.5
