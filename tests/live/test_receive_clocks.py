"""Clocks of senders are estimated from arrival times with jitter."""

import numpy as np
import pytest

from dmrl.live.receive_clocks import SenderClock

MS = 1_000_000
BASE_NS = 1_700_000_000_000_000_000


@pytest.mark.parametrize("drift_ppm", [-50.0, 0.0, 20.0, 100.0])
def test_a_drifting_clock_is_followed_to_a_millisecond_through_jitter(drift_ppm: float) -> None:
    rng = np.random.default_rng(1)
    clock, errors_ms = SenderClock(), []
    for k in range(12_000):
        sender_ns = 10 * MS * k
        true_ns = BASE_NS + round(sender_ns * (1 + 1e-6 * drift_ppm))
        clock.add_sample(sender_ns, true_ns + round((2 + rng.exponential(8)) * MS))
        if clock.settled:
            errors_ms.append((clock.to_host_ns(sender_ns) - true_ns) / MS)
    # The smallest delay, 2 ms, cannot be observed.
    assert min(errors_ms) > 0.5
    assert max(errors_ms) < 2.5


def test_settled_times_keep_the_senders_steps() -> None:
    rng = np.random.default_rng(2)
    clock, times = SenderClock(), []
    for k in range(1000):
        clock.add_sample(10 * MS * k, BASE_NS + 10 * MS * k + round(rng.exponential(30) * MS))
        if clock.settled:
            times.append(clock.to_host_ns(10 * MS * k))
    steps = np.diff(times)
    assert np.abs(steps - 10 * MS).max() <= SenderClock.MAX_SLEW * 10 * MS + 1


def test_sender_clock_of_another_rate_is_not_followed() -> None:
    clock = SenderClock()
    for k in range(2000):
        clock.add_sample(40 * MS * k, BASE_NS + 10 * MS * k)
    assert clock.to_host_ns(40 * MS) - clock.to_host_ns(0) == 40 * MS
    assert abs(clock.to_host_ns(0) - BASE_NS) < 4_000 * MS
