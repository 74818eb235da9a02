"""Conversion of a robot's times to this computer's clock while samples arrive.

A sample is taken at a time of the sender's clock. It arrives after a varying delay that is never
negative. The smallest recent delay is the best estimate of the clocks' offset.
"""

import time
from collections import deque

SECOND_NS = 1_000_000_000


class HostClock:
    """Clock of nanoseconds since 1970 that never steps back, unlike the system's clock."""

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def __call__(self) -> int:
        """Return the current time."""
        return time.monotonic_ns() + self._offset_ns


class SenderClock:
    """Estimator of a sender's clock on this computer's time.

    During the first second, the offset is the smallest delay so far. Then it is settled. It follows
    the smallest delay of the last `WINDOW_S`, and thus the drift, by at most `MAX_SLEW`, so that
    times keep the sender's own regular steps.

    Parameters
    ----------
    settle_s
        Seconds of observation before the offset is settled.
    """

    WINDOW_S = 10
    MAX_SLEW = 200e-6
    MAX_OFFSET_CHANGE_NS = SECOND_NS // 2
    """Largest change of the offset that counts as drift. Ignores clocks at another rate."""

    def __init__(self, settle_s: float = 1.0) -> None:
        self.settled = False
        self._settle_ns = round(settle_s * SECOND_NS)
        self._first_ns: int | None = None
        self._last_ns = 0
        # Integer: float64 resolves nanoseconds since 1970 to a quarter of a microsecond only.
        self._offset_ns = 0
        # (second of the sender's clock, smallest difference in it)
        self._least: deque[tuple[int, int]] = deque(maxlen=self.WINDOW_S)

    @property
    def has_samples(self) -> bool:
        """Whether a sample of the sender has arrived."""
        return self._first_ns is not None

    def add_sample(self, sender_ns: int, arrival_ns: int) -> None:
        """Update the offset with a sample.

        Parameters
        ----------
        sender_ns
            Time of the sample on the sender's clock, unwrapped.
        arrival_ns
            Time of arrival on this computer's clock.
        """
        if self._first_ns is None:
            self._first_ns, self._last_ns = arrival_ns, sender_ns
        self._update_minimum(sender_ns // SECOND_NS, arrival_ns - sender_ns)
        wanted = min(least for _, least in self._least)
        if self.settled:
            reach = round(self.MAX_SLEW * max(sender_ns - self._last_ns, 0))
            change = wanted - self._offset_ns
            if abs(change) < self.MAX_OFFSET_CHANGE_NS:
                self._offset_ns += min(max(change, -reach), reach)
        else:
            self._offset_ns = wanted
            self.settled = arrival_ns - self._first_ns >= self._settle_ns
        self._last_ns = max(sender_ns, self._last_ns)

    def to_host_ns(self, sender_ns: int) -> int:
        """Convert a time of the sender's clock to this computer's time; needs an earlier sample."""
        return sender_ns + self._offset_ns

    def _update_minimum(self, second: int, difference_ns: int) -> None:
        if self._least and self._least[-1][0] == second:
            difference_ns = min(difference_ns, self._least.pop()[1])
        self._least.append((second, difference_ns))
