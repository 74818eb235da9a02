"""Clocks of files: counters, resets, unset clocks and simulated time."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from dmrl.errors import SourceError
from dmrl.formats.clocks import find_new_values, settle_times
from dmrl.formats.ros.message_clock import MessageClock
from dmrl.terminal.left_out import count_left_out

S = 1_000_000_000
WRAPS = {
    "u32 ns": (1, 32),
    "u16 ms": (1_000_000, 16),
    "u24 ms": (1_000_000, 24),
    "u24 us": (1_000, 24),
    "u32 us": (1_000, 32),
    "u32 ms": (1_000_000, 32),
    "u31 ms": (1_000_000, 31),
}


def name_row(k: int) -> str:
    """Return file and line of row k, below a header."""
    return f"a.csv:{k + 2}"


def make_times(duration_s: float, rate_hz: float, start_s: float = 0.0) -> np.ndarray:
    """Return evenly spaced times in nanoseconds, rounded to milliseconds."""
    return np.rint((start_s + np.arange(0, duration_s, 1 / rate_hz)) * 1e3).astype(np.int64) * 10**6


@given(
    counter=st.sampled_from(sorted(WRAPS)),
    rate_hz=st.sampled_from([5, 10, 50, 100, 250]),
    before_s=st.floats(0.5, 1.5),
    after_s=st.floats(0.5, 1.5),
    seed=st.integers(0, 99),
)
@pytest.mark.heavy
def test_wrapping_counter_is_unwrapped(
    counter: str, rate_hz: int, before_s: float, after_s: float, seed: int
) -> None:
    tick_ns, bits = WRAPS[counter]
    period_ns = tick_ns << bits
    rng = np.random.default_rng(seed)
    true = make_times(before_s + after_s, rate_hz, 1000) + rng.integers(0, 10**6, 1)
    true = true - true[0] + period_ns - int(before_s * S)
    true = true // tick_ns * tick_ns
    found = settle_times(true % period_ns, name_row)
    np.testing.assert_array_equal(found.time_ns - found.time_ns[0], true - true[0])
    assert found.rows.tolist() == list(range(len(true)))


@pytest.mark.parametrize(
    ("period_ns", "rate_hz"),
    [(256_000_000, 20), (256_000_000, 42), (256_000_000, 200), (65_536_000, 50), (65_536_000, 400)],
)
def test_short_counter_that_wraps_every_few_rows_is_unwrapped(period_ns: int, rate_hz: int) -> None:
    true = np.rint(np.arange(200) / rate_hz * 1e3).astype(np.int64) * 10**6
    found = settle_times(true % period_ns, name_row)
    np.testing.assert_array_equal(found.time_ns, true)
    assert found.rows.tolist() == list(range(200))


def test_rows_of_a_short_file_that_are_out_of_order_are_sorted() -> None:
    true = make_times(0.5, 100)
    told = true.copy()
    told[[10, 11, 20, 21]] = told[[11, 10, 21, 20]]
    np.testing.assert_array_equal(settle_times(told, name_row).time_ns, true)


@example(first_s=2.0, second_s=2.0, start_s=1.0, rate_hz=5)
@example(first_s=2.0, second_s=2.0, start_s=0.0, rate_hz=5)
@given(
    first_s=st.floats(2.0, 63.0),
    second_s=st.floats(2.0, 500.0),
    start_s=st.floats(0.0, 50.0),
    rate_hz=st.sampled_from([5, 20, 100]),
)
@pytest.mark.heavy
def test_a_clock_that_starts_again_is_refused_with_its_line(
    first_s: float, second_s: float, start_s: float, rate_hz: int
) -> None:
    first, second = make_times(first_s, rate_hz, start_s), make_times(second_s, rate_hz)
    periods_s = [tick_ns * 2**bits / S for tick_ns, bits in WRAPS.values()]
    assume(first[-1] >= 2 * S)
    assume(not any(0 <= p - first[-1] / S <= 2.1 / rate_hz for p in periods_s))  # looks like a wrap
    with pytest.raises(SourceError, match=rf"a\.csv:{len(first) + 2}: time goes back from"):
        settle_times(np.concatenate([first, second]), name_row)


@given(
    zeros=st.integers(1, 30),
    start_s=st.sampled_from([1.0e3, 1.7e9]),
    where=st.sampled_from(["before", "within"]),
)
def test_times_of_an_unset_clock_are_left_out(zeros: int, start_s: float, where: str) -> None:
    true = make_times(10, 50, start_s)
    at = 0 if where == "before" else 100
    told = np.insert(true, at, np.zeros(zeros, np.int64))
    with count_left_out() as left_out:
        found = settle_times(told, name_row)
    np.testing.assert_array_equal(found.time_ns, true)
    np.testing.assert_array_equal(told[found.rows], true)
    assert sum(left_out.counts.values()) == zeros
    assert set(left_out.first.values()) == {name_row(at)}


def test_time_0_is_valid_on_a_clock_that_starts_near_0() -> None:
    true = make_times(2, 20)
    np.testing.assert_array_equal(settle_times(true, name_row).time_ns, true)


def test_rows_before_the_clock_was_set_are_left_out() -> None:
    booted, true = make_times(1, 50, 3), make_times(10, 50, 1.7e9)
    with count_left_out() as left_out:
        found = settle_times(np.concatenate([booted, true]), name_row)
    np.testing.assert_array_equal(found.time_ns, true)
    assert left_out.counts == {"rows with times from before the clock was set": 50}


@pytest.mark.parametrize("jump_s", [-30.0, 5.0, 1e6])
@pytest.mark.parametrize("rows", [1, 2, 3])
def test_times_that_jump_and_return_are_left_out(jump_s: float, rows: int) -> None:
    told = make_times(60, 50, 40)
    told[1000 : 1000 + rows] += int(jump_s * S)
    with count_left_out() as left_out:
        found = settle_times(told, name_row)
    assert left_out.counts == {"rows whose time jumps and returns": rows}
    assert left_out.first["rows whose time jumps and returns"] == name_row(1000)
    assert found.rows.tolist() == [k for k in range(3000) if not 1000 <= k < 1000 + rows]


def test_a_gap_is_no_jump() -> None:
    told = np.concatenate([make_times(5, 50), make_times(0.02, 50, 20), make_times(5, 50, 40)])
    np.testing.assert_array_equal(settle_times(told, name_row).time_ns, told)


@pytest.mark.parametrize("order", ["swapped", "shuffled", "reversed"])
def test_rows_that_are_out_of_order_are_sorted(
    order: str, capsys: pytest.CaptureFixture[str]
) -> None:
    true = make_times(30, 20)
    told = true.copy()
    if order == "swapped":
        told[[10, 11]] = told[[11, 10]]
    elif order == "shuffled":
        told = np.random.default_rng(0).permutation(told)
    else:
        told = told[::-1]
    found = settle_times(told, name_row)
    np.testing.assert_array_equal(found.time_ns, true)
    np.testing.assert_array_equal(told[found.rows], true)
    assert "not in time order from here on; sorted" in capsys.readouterr().err


def test_equal_times_are_refused() -> None:
    with pytest.raises(SourceError, match=r"a\.csv:2: all 200 times are 1\.7e\+09 s"):
        settle_times(np.full(200, 1_700_000_000 * S), name_row)
    assert len(settle_times([5, 5], name_row).rows) == 2
    assert len(settle_times([], name_row).rows) == 0


@given(
    held=st.integers(2, 12),
    digits=st.sampled_from([2, 3, 6]),
    noise_m=st.floats(0.05, 0.2),
    seed=st.integers(0, 99),
)
def test_repeated_values_are_not_new_measurements(
    held: int, digits: int, noise_m: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    measured = np.round(2 + np.sin(np.arange(60) / 5) + rng.normal(0, noise_m, 60), digits)
    measured = measured[np.concatenate([[True], np.diff(measured) != 0])]
    found = find_new_values(np.repeat(measured, held))
    assert np.flatnonzero(found).tolist() == list(range(0, held * len(measured), held))


@given(digits=st.sampled_from([1, 2, 3]), noise_m=st.floats(0.0, 0.1), seed=st.integers(0, 99))
def test_values_that_repeat_by_chance_are_kept(digits: int, noise_m: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = np.round(2 + np.sin(np.arange(400) / 60) + rng.normal(0, noise_m, 400), digits)
    assert find_new_values(values).all()


def test_missing_values_between_equal_ones_make_them_new() -> None:
    values = np.array([1.0, np.nan, 1.0, np.nan, 1.5, np.nan] * 20)
    assert find_new_values(values).all() and find_new_values(values, polled=True).all()
    assert find_new_values(np.array([]), polled=True).tolist() == []


WALL = 1_700_000_000 * S


def find_times(messages: list[tuple[str, int | None, int]]) -> list[int | None]:
    """Return the times of messages, given as topic, stamp and time of receipt, nanoseconds."""
    clock = MessageClock.from_stamps("a bag", iter(messages))
    return [clock.find_time_ns(*message) for message in messages]


def test_simulated_time_from_zero() -> None:
    told = [("odom", k * S // 10, WALL + k * S // 5) for k in range(20)]
    assert find_times(told) == [k * S // 10 for k in range(20)]
    told.insert(1, ("no_header", None, WALL))
    assert find_times(told)[1] == 0


def test_stamps_of_zero_of_a_real_robot_are_replaced() -> None:
    stamped = [("odom", WALL - S + k, WALL + k) for k in range(5)]
    unset = [("range", 0, WALL + k) for k in range(5)]
    assert find_times([*unset, *stamped]) == [WALL + k for k in range(5)] + [s[1] for s in stamped]
    late = [("odom", 1000 * S + k, 1001 * S + k) for k in range(3)]
    assert find_times([*late, ("range", 0, 1002 * S)])[-1] == 1002 * S


def stamp_again(k: int) -> int:
    """Return stamp k of a simulation that is reset after 10 s."""
    return k * S // 10 if k < 100 else (k - 100) * S // 10


def stamp_wrong_back(k: int) -> int:
    """Return stamp k of a series in which one is too small."""
    return S if k == 50 else WALL + k * S // 10


def stamp_wrong_ahead(k: int) -> int:
    """Return stamp k of a series in which one is too large."""
    return 2 * WALL if k == 50 else WALL + k * S // 10


def test_a_simulation_that_was_reset_is_refused() -> None:
    with pytest.raises(SourceError, match=r"a bag: the stamps of odom go back from 9\.9 s"):
        find_times([("odom", stamp_again(k), WALL + k * S // 10) for k in range(200)])


@pytest.mark.parametrize(("stamp", "kept"), [(stamp_wrong_back, 119), (stamp_wrong_ahead, 120)])
def test_bag_with_one_wrong_stamp_is_read(stamp: Callable[[int], int], kept: int) -> None:
    times = find_times([("odom", stamp(k), WALL + k * S // 10) for k in range(120)])
    assert sum(time is not None for time in times) == kept
    assert times[-1] == WALL + 119 * S // 10


def test_held_values_with_equal_steps_are_recognized() -> None:
    approaching = np.repeat(np.arange(5.0, 2.0, -0.1), 10)
    assert np.flatnonzero(find_new_values(approaching)).tolist() == list(range(0, 300, 10))


def test_held_values_between_gaps_are_not_new() -> None:
    measured = 2 + np.random.default_rng(0).random(20)
    values = np.repeat(measured, 10)
    values[np.arange(200) % 10 >= 3] = np.nan
    new = find_new_values(values) & np.isfinite(values)
    assert np.flatnonzero(new).tolist() == list(range(0, 200, 10))
