import numpy as np
import pytest

from dmrl.formats.counters import SteadySender, Unwrapped, dejitter, unwrap

MS = 1_000_000


@pytest.mark.parametrize("bits", [8, 24, 32])
def test_a_counter_goes_on_where_it_wraps(bits: int) -> None:
    true = np.cumsum(np.random.default_rng(0).integers(1, 2 ** (bits - 1) - 1, 50))
    assert (unwrap(true % 2**bits, bits) - true == unwrap(true % 2**bits, bits)[0] - true[0]).all()


def test_values_out_of_order_stay_so() -> None:
    assert unwrap([255, 1, 0, 2], 8).tolist() == [255, 257, 256, 258]
    assert unwrap([], 8).tolist() == []


@pytest.mark.parametrize("drop", [0.0, 0.05])
@pytest.mark.parametrize("counted", [True, False])
def test_jitter_of_arrival_is_taken_away(drop: float, counted: bool) -> None:
    rng = np.random.default_rng(1)
    number = np.flatnonzero(rng.random(4000) >= drop)
    sent = 10**18 + number * 50_050_000  # a clock that is 0.1 % slow
    arrival = np.maximum.accumulate(sent + rng.exponential(2e6, len(number)).astype(np.int64))
    found = dejitter(arrival, number if counted else None)
    assert (found <= arrival).all()
    assert np.abs(found - sent).max() < 50_000
    assert np.abs(arrival - sent).max() > 5_000_000


def test_where_holes_and_jitter_cannot_be_told_apart_arrivals_stand() -> None:
    arrival = np.cumsum(np.random.default_rng(2).exponential(5e7, 500)).astype(np.int64)
    assert (dejitter(arrival) == arrival).all()
    assert dejitter([5, 9]).tolist() == [5, 9]


def test_counters_unwrap_forward_or_to_the_nearest() -> None:
    frames = Unwrapped(8, forward=True)
    assert [frames(value) for value in (250, 255, 0, 254, 253)] == [250, 255, 256, 510, 765]
    times = Unwrapped(32)
    assert [times(value) for value in (4294967290, 5, 4294967295)] == [
        4294967290,
        4294967301,
        4294967295,
    ]


def test_a_counter_is_asked_for_values_of_more_bits_without_being_changed() -> None:
    times = Unwrapped(24)
    times(5)
    assert times.near((7 << 24) + 8) == 8
    assert times.near((1 << 24) - 2) == -2
    assert times(6) == 6


def test_arrivals_of_a_steady_sender_are_evened_out_and_never_in_the_future() -> None:
    rng = np.random.default_rng(3)
    sender, errors_ms, raw_ms, last = SteadySender(), [], [], 0
    for k in range(1000):
        true_ns = 50 * MS * k
        last = arrival = max(true_ns + round(rng.exponential(15) * MS), last)
        sent = sender(arrival)
        assert sent <= arrival
        errors_ms.append((sent - true_ns) / MS)
        raw_ms.append((arrival - true_ns) / MS)
    assert np.std(errors_ms[100:]) < 0.4 * np.std(raw_ms[100:])


def test_after_a_pause_arrivals_stand_as_they_are() -> None:
    sender = SteadySender()
    for k in range(20):
        sender(50 * MS * k)
    assert sender(5000 * MS) == 5000 * MS
    assert sender(5050 * MS) == 5050 * MS
