import numpy as np
import pytest

from dmrl.formats.counters import dejitter, unwrap


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
