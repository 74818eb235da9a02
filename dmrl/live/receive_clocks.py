"""From a robot's clock, or none, to times of this computer, as samples arrive.

A sample is taken at some time of the sender's clock and arrives after a delay that varies and
is never negative. The least delay seen lately says best how the two clocks stand.
"""

import time
from collections import deque

SECOND_NS = 1_000_000_000


class HostTime:
    """Nanoseconds since 1970 that never go back, unlike the system's clock."""

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def __call__(self) -> int:
        """Now."""
        return time.monotonic_ns() + self._offset_ns


class SenderClock:
    """A sender's clock, on this computer's time.

    For the first second the difference of the clocks is the least delay so far. Then it is
    settled, and follows the least delay of the last `WINDOW_S`, and so the drift, at no more
    than `SLEW`: times keep the sender's own even steps.

    Parameters
    ----------
    settle_s
        How long to look before the difference is settled.
    """

    WINDOW_S = 10
    SLEW = 200e-6
    OTHER_PACE_NS = SECOND_NS // 2
    """A difference that changes by more is no drift: a clock of another pace is left alone."""

    def __init__(self, settle_s: float = 1.0) -> None:
        self.settled = False
        self._settle_ns = round(settle_s * SECOND_NS)
        self._first_ns: int | None = None
        self._last_ns = 0
        # Whole: a float64 holds nanoseconds since 1970 to a quarter of a microsecond only.
        self._offset_ns = 0
        # (second of the sender's clock, least difference in it)
        self._least: deque[tuple[int, int]] = deque(maxlen=self.WINDOW_S)

    @property
    def heard(self) -> bool:
        """Whether anything is known of the sender's clock."""
        return self._first_ns is not None

    def hear(self, sender_ns: int, arrival_ns: int) -> None:
        """Take note of a sample.

        Parameters
        ----------
        sender_ns
            When it was taken, on the sender's clock, unwrapped.
        arrival_ns
            When it came, on this computer's.
        """
        if self._first_ns is None:
            self._first_ns, self._last_ns = arrival_ns, sender_ns
        self._note(sender_ns // SECOND_NS, arrival_ns - sender_ns)
        wanted = min(least for _, least in self._least)
        if self.settled:
            reach = round(self.SLEW * max(sender_ns - self._last_ns, 0))
            change = wanted - self._offset_ns
            if abs(change) < self.OTHER_PACE_NS:
                self._offset_ns += min(max(change, -reach), reach)
        else:
            self._offset_ns = wanted
            self.settled = arrival_ns - self._first_ns >= self._settle_ns
        self._last_ns = max(sender_ns, self._last_ns)

    def host_ns(self, sender_ns: int) -> int:
        """A time of the sender's clock on this computer's time; something was heard before."""
        return sender_ns + self._offset_ns

    def _note(self, second: int, difference_ns: int) -> None:
        if self._least and self._least[-1][0] == second:
            difference_ns = min(difference_ns, self._least.pop()[1])
        self._least.append((second, difference_ns))
