import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from dmrl.estimation.clocks import Clock, connected, estimate_clock
from dmrl.estimation.exchanges import estimate_from_exchanges

Array = np.ndarray
OFFSET_S, DRIFT = 0.080, 20e-6


def distance(time_s: Array, seed: int) -> Array:
    """A distance of two robots that fly about, metres."""
    rng = np.random.default_rng(seed)
    waves = [
        rng.uniform(0.1, 0.4) * np.sin(rng.uniform(0.1, 2.0) * time_s + rng.uniform(0, 6))
        for _ in range(8)
    ]
    return 3.0 + np.sum(waves, axis=0)


def wrong(time_s: Array) -> Array:
    """Times of a clock that is 80 ms ahead in the middle of five minutes and 20 ppm fast."""
    return time_s + OFFSET_S + DRIFT * (time_s - 150)


def exchanges(seed: int) -> tuple[Array, Array, Array, Array]:
    """Five minutes of 25 exchanges a second, each logged by both some ms later, 10 % lost."""
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.03, 0.05, 7500))
    time = time[time < 300]
    measured = np.round(distance(time, seed) + rng.normal(0, 0.1, len(time)), 3)
    measured[rng.random(len(time)) < 0.03] += 1.5  # no line of sight
    here, there = rng.random((2, len(time))) > 0.1
    return (
        (time + rng.uniform(0, 0.01, len(time)))[here],
        measured[here],
        wrong(time + rng.uniform(0, 0.01, len(time)))[there],
        measured[there],
    )


def worst_s(clock: Clock | None) -> float:
    """Largest error of the corrected clock in the five minutes."""
    assert clock is not None
    time = np.linspace(0, 300, 61)
    return float(np.abs(clock.corrected(wrong(time)) - time).max())


@pytest.mark.parametrize("seed", range(5))
def test_offset_and_drift_come_back_to_5_ms_over_5_minutes(seed: int) -> None:
    clock = estimate_from_exchanges(*exchanges(seed))
    assert worst_s(clock) < 0.005
    assert clock is not None and clock.sigma_s < 0.001


@pytest.mark.parametrize("apart_s", [-40.0, 3600.0])
def test_clocks_may_be_far_apart(apart_s: float) -> None:
    here, range_m, there, peer_m = exchanges(0)
    clock = estimate_from_exchanges(here, range_m, there + apart_s, peer_m)
    assert clock is not None
    assert clock.offset_s == pytest.approx(-OFFSET_S - apart_s, abs=0.005)


def test_ranges_of_exchanges_of_their_own_tell_as_much_as_their_sigma_says() -> None:
    errors = []
    for seed in range(8):
        rng = np.random.default_rng(100 + seed)
        here, there = (np.sort(rng.uniform(0, 300, 9000)) for _ in range(2))
        clock = estimate_from_exchanges(
            here,
            distance(here, seed) + rng.normal(0, 0.1, 9000),
            wrong(there),
            distance(there, seed) + rng.normal(0, 0.1, 9000) + 0.2,
        )
        assert clock is not None
        errors.append((clock.offset_s + OFFSET_S) / clock.sigma_s)
    assert 0.3 < np.sqrt(np.mean(np.square(errors))) < 2.5


def test_a_signal_of_another_scale_aligns_as_well() -> None:
    """As the turn that a camera saw, in pixels, against a gyroscope."""
    time, rng = np.arange(0, 300, 0.01), np.random.default_rng(3)
    seen = np.arange(0, 300, 0.05)
    turn = distance(time, 5) - 3
    pixels = 9.2 * (distance(seen, 5) - 3) + rng.normal(0, 0.3, len(seen))
    assert worst_s(estimate_clock(time, turn, wrong(seen), pixels)) < 0.005


@pytest.mark.parametrize("count", [0, 5, 100])
def test_too_little_is_no_clock(count: int) -> None:
    here, range_m, there, peer_m = exchanges(0)
    assert estimate_from_exchanges(here, range_m, there[:count], peer_m[:count]) is None


def test_what_was_not_seen_twice_is_no_clock() -> None:
    here, range_m, there, _ = exchanges(0)
    noise = np.random.default_rng(0).normal(size=len(there))
    assert estimate_from_exchanges(here, range_m, there, noise) is None


def test_clocks_chain_and_undo() -> None:
    one, two = Clock(0.5, 1e-5, 100.0, 0.003), Clock(-2.0, -3e-5, 40.0, 0.004)
    time = np.linspace(0, 300, 7)
    chained = two.after(one)
    np.testing.assert_allclose(chained.corrected(time), two.corrected(one.corrected(time)))
    np.testing.assert_allclose(one.inverse().corrected(one.corrected(time)), time, atol=1e-9)
    assert chained.sigma_s == pytest.approx(0.005)


def test_the_surest_links_are_taken() -> None:
    pairs = {
        ("a", "b"): Clock(1.0, sigma_s=0.001),
        ("c", "b"): Clock(5.0, sigma_s=0.001),
        ("a", "c"): Clock(99.0, sigma_s=0.1),
        ("d", "e"): Clock(7.0),
    }
    found = connected(pairs, "a")
    assert found.keys() == {"a", "b", "c"}
    assert found["c"].offset_s == pytest.approx(1.0 - 5.0)


CLOCKS = st.builds(Clock, st.floats(-100, 100), st.floats(-1e-3, 1e-3), st.floats(-1000, 1000))
TIMES_S = np.linspace(-500, 500, 5)


@given(CLOCKS, CLOCKS)
def test_any_clocks_chain_and_undo(one: Clock, two: Clock) -> None:
    both = two.after(one).corrected(TIMES_S)
    np.testing.assert_allclose(both, two.corrected(one.corrected(TIMES_S)), atol=1e-8)
    np.testing.assert_allclose(one.inverse().corrected(one.corrected(TIMES_S)), TIMES_S, atol=1e-8)


@settings(max_examples=12, phases=[Phase.generate])
@given(st.floats(-50, 50), st.floats(-20e-6, 20e-6), st.floats(0.1, 5), st.integers(0, 99))
def test_any_offset_and_drift_come_back(
    offset_s: float, drift: float, scale: float, seed: int
) -> None:
    seen_s, also_s = np.arange(0, 60, 0.05), np.arange(0.02, 60, 0.07)
    stamps = also_s + offset_s + drift * (also_s - 30)
    values = scale * distance(also_s, seed) + 1.0
    clock = estimate_clock(seen_s, distance(seen_s, seed), stamps, values)
    assert clock is not None
    assert np.abs(clock.corrected(stamps) - also_s).max() < 0.01
