"""Removal of jitter from times of arrival.

``dejitter`` processes a whole file at once. ``SteadyRateFilter`` processes one arrival after the
other. Counters and clocks of files: `dmrl.formats.clocks`.
"""

from collections import deque

import numpy as np
from numpy.typing import ArrayLike, NDArray

Ints = NDArray[np.int64]

EARLY_TOLERANCE = 0.3
"""Largest earliness of an arrival, as a share of the period."""
EARLY_GAIN, LATE_GAIN = 0.3, 0.01
"""Shares of an early and of a late arrival's deviation by which the next due time is corrected."""


def dejitter(arrival_ns: ArrayLike, count: ArrayLike | None = None) -> Ints:
    """Return (N,) regular times, as late as possible with none after its arrival.

    A sender with a steady clock emits number n at a + b n. Transmission adds a delay that is never
    negative. The line below all arrivals and nearest to them on average is an edge of their lower
    hull. The shortest delay remains, since no arrival reveals it.

    Parameters
    ----------
    arrival_ns
        (N,) times of arrival, nanoseconds.
    count
        (N,) the sender's numbers, unwrapped, increasing. None: numbers are assigned, with gaps
        where arrivals are missing. If gaps cannot be distinguished from jitter, the arrivals are
        returned.

    Returns
    -------
    Ints
        (N,) nanoseconds, none after its arrival.

    Examples
    --------
    >>> dejitter([5, 10, 18, 20, 26]).tolist()
    [5, 10, 15, 20, 25]
    """
    arrival = np.asarray(arrival_ns, np.int64)
    if len(arrival) < 3:
        return arrival.copy()
    number = _number_arrivals(arrival) if count is None else np.asarray(count, np.int64)
    # Relative: float64 resolves nanoseconds since 1970 to a quarter of a microsecond only.
    x, y = (number - number[0]).astype(float), (arrival - arrival[0]).astype(float)
    hull = _lower_hull(x, y)
    edge = min(max(int(np.searchsorted(x[hull], x.mean())), 1), len(hull) - 1)
    left, right = hull[edge - 1], hull[edge]
    slope = (y[right] - y[left]) / (x[right] - x[left])
    line = np.floor(y[left] + slope * (x - x[left]) + 1e-6)
    if count is None and (y - line).max() > slope:
        return arrival.copy()
    return np.asarray(arrival[0] + line.astype(np.int64))


def _number_arrivals(arrival: Ints) -> Ints:
    """Assign numbers to the arrivals of a steady sender, with gaps for missing samples."""
    steps = np.diff(arrival)
    period = max(float(np.median(steps)), 1.0)
    period = float(steps[steps < 1.5 * period].mean())
    numbers, number, due = [0], 0, float(arrival[0])
    for moment in arrival[1:].tolist():
        passed = max(int((moment - due) / period + EARLY_TOLERANCE), 1)
        number, due = number + passed, due + passed * period
        # Adapts fast to early arrivals, and slowly to a slower clock.
        due += (moment - due) * (EARLY_GAIN if moment < due else LATE_GAIN)
        numbers.append(number)
    return np.array(numbers, np.int64)


def _lower_hull(x: NDArray[np.float64], y: NDArray[np.float64]) -> list[int]:
    """Return indices of the lower convex hull of points sorted by x (Andrew's monotone chain)."""
    hull: list[int] = []
    for k in range(len(x)):
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            if (x[b] - x[a]) * (y[k] - y[a]) > (y[b] - y[a]) * (x[k] - x[a]):
                break
            hull.pop()
        if hull and x[hull[-1]] == x[k]:
            if y[hull[-1]] <= y[k]:
                continue
            hull.pop()
        hull.append(k)
    return hull


class SteadyRateFilter:
    """Filter of arrival times from a sender that sends at a steady rate and has no clock.

    The next due time follows early arrivals at once and late ones slowly, since transmission only
    adds delay. A pause of several samples restarts the filter.
    """

    PERIOD_WINDOW = 64
    """Number of arrivals over which the period is measured."""
    MIN_ARRIVALS = 8
    """Number of arrivals before the filter starts; earlier ones are returned unchanged."""
    LATE_SHARE = 0.02
    """Share of its lateness by which a late arrival delays the next due time."""
    PAUSE_PERIODS = 4.0
    """Lateness that restarts the filter, in periods."""

    def __init__(self) -> None:
        self._arrivals: deque[int] = deque(maxlen=self.PERIOD_WINDOW)
        self._due_ns = 0.0

    def __call__(self, arrival_ns: int) -> int:
        """Return the send time of a sample that arrives now; never later than now."""
        self._arrivals.append(arrival_ns)
        if len(self._arrivals) < self.MIN_ARRIVALS:
            self._due_ns = arrival_ns
            return arrival_ns
        pace_ns = (self._arrivals[-1] - self._arrivals[0]) / (len(self._arrivals) - 1)
        self._due_ns += pace_ns
        late_ns = arrival_ns - self._due_ns
        if late_ns > self.PAUSE_PERIODS * pace_ns:
            self._arrivals.clear()
            self._arrivals.append(arrival_ns)
            self._due_ns = arrival_ns
        else:
            self._due_ns += late_ns if late_ns < 0 else self.LATE_SHARE * late_ns
        return min(round(self._due_ns), arrival_ns)
