"""Counters that wrap, and times of arrival that jitter, made into times.

Each in two forms: ``unwrap`` and ``dejitter`` for all of a file at once, which know what comes
after; ``Unwrapped`` and ``SteadySender`` for one value after the other, as they arrive.
"""

from collections import deque

import numpy as np
from numpy.typing import ArrayLike, NDArray

Ints = NDArray[np.int64]

EARLY = 0.3
"""Share of a period by which an arrival may come before it is due."""
EARLIER, LATER = 0.3, 0.01
"""Shares of an arrival's distance to when it was due by which the next is due earlier, later."""


def unwrap(values: ArrayLike, bits: int) -> Ints:
    """(N,) counts that go on where the counter began again at 0.

    A step is taken to be the nearest one, back or forth, that gives the next value: values a
    little out of order stay so, and a gap of half the counter's range or more is not seen.

    Parameters
    ----------
    values
        (N,) integers, as counted.
    bits
        Width of the counter: 8 for a frame number, 32 for microseconds.

    Returns
    -------
    Ints
        (N,) int64; the first is as it was.

    Examples
    --------
    >>> unwrap([254, 255, 0, 2, 1], 8).tolist()
    [254, 255, 256, 258, 257]
    """
    counts = np.asarray(values, np.int64)
    half = 1 << (bits - 1)
    steps = (np.diff(counts) + half) % (1 << bits) - half
    return np.concatenate([counts[:1], counts[:1] + np.cumsum(steps)])


class Unwrapped:
    """A counter of few bits as one that does not wrap.

    Parameters
    ----------
    bits
        Of the counter.
    forward
        True: it never steps back, so that up to 2**bits - 1 may be missing. False: the
        nearest value counts, before or after.
    """

    def __init__(self, bits: int, *, forward: bool = False) -> None:
        self._period = 1 << bits
        self._back = 0 if forward else self._period // 2
        self._last: int | None = None

    def __call__(self, value: int) -> int:
        """The counter's value with its wraps added.

        Examples
        --------
        >>> unwrapped = Unwrapped(8)
        >>> [unwrapped(value) for value in (254, 255, 1, 0)]
        [254, 255, 257, 256]
        """
        self._last = self.near(value)
        return self._last

    def near(self, value: int) -> int:
        """The same, but the value is not remembered, and may have bits more than the counter."""
        if self._last is None:
            return value
        return self._last + (value - self._last + self._back) % self._period - self._back


def dejitter(arrival_ns: ArrayLike, count: ArrayLike | None = None) -> Ints:
    """(N,) regular times just early enough that nothing arrives before it was sent.

    A sender with a steady clock makes number n at a + b n; the way to the receiver adds a
    delay that is never negative. The line that lies under all arrivals, and nearest to them
    on average, is an edge of their lower hull. What stays is the shortest delay, which no
    arrival shows.

    Parameters
    ----------
    arrival_ns
        (N,) times of arrival, nanoseconds.
    count
        (N,) the sender's numbers, unwrapped, increasing. None: numbered here, with gaps where
        the arrivals leave a hole; where that cannot be told from jitter, the arrivals stand.

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
    number = _numbered(arrival) if count is None else np.asarray(count, np.int64)
    # Small numbers: float64 holds nanoseconds since 1970 to a quarter of a microsecond only.
    x, y = (number - number[0]).astype(float), (arrival - arrival[0]).astype(float)
    hull = _lower_hull(x, y)
    edge = min(max(int(np.searchsorted(x[hull], x.mean())), 1), len(hull) - 1)
    left, right = hull[edge - 1], hull[edge]
    slope = (y[right] - y[left]) / (x[right] - x[left])
    line = np.floor(y[left] + slope * (x - x[left]) + 1e-6)
    if count is None and (y - line).max() > slope:
        return arrival.copy()
    return np.asarray(arrival[0] + line.astype(np.int64))


def _numbered(arrival: Ints) -> Ints:
    """Numbers of a steady sender: one more each time, and more where there is a hole."""
    steps = np.diff(arrival)
    period = max(float(np.median(steps)), 1.0)
    period = float(steps[steps < 1.5 * period].mean())
    numbers, number, due = [0], 0, float(arrival[0])
    for moment in arrival[1:].tolist():
        passed = max(int((moment - due) / period + EARLY), 1)
        number, due = number + passed, due + passed * period
        # Follows the earliest arrivals at once, and a slower clock by and by.
        due += (moment - due) * (EARLIER if moment < due else LATER)
        numbers.append(number)
    return np.array(numbers, np.int64)


def _lower_hull(x: NDArray[np.float64], y: NDArray[np.float64]) -> list[int]:
    """Indices of the lower convex hull of points in order of x (Andrew's monotone chain)."""
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


class SteadySender:
    """Times of a sender without a clock that sends at an even pace.

    When the next sample is due follows early arrivals at once and late ones slowly, as only
    lateness has other reasons than the sender. A pause of some samples' length starts anew.
    """

    MEMORY = 64
    """Arrivals from which the pace is known."""
    LEAST = 8
    """Arrivals before which they stand as they are."""
    LATE = 0.02
    """Share of its lateness by which a late arrival puts off the next."""
    PAUSE = 4.0
    """Lateness, in paces, that is no jitter."""

    def __init__(self) -> None:
        self._arrivals: deque[int] = deque(maxlen=self.MEMORY)
        self._due_ns = 0.0

    def __call__(self, arrival_ns: int) -> int:
        """When what arrived now was sent; never later than now."""
        self._arrivals.append(arrival_ns)
        if len(self._arrivals) < self.LEAST:
            self._due_ns = arrival_ns
            return arrival_ns
        pace_ns = (self._arrivals[-1] - self._arrivals[0]) / (len(self._arrivals) - 1)
        self._due_ns += pace_ns
        late_ns = arrival_ns - self._due_ns
        if late_ns > self.PAUSE * pace_ns:
            self._arrivals.clear()
            self._arrivals.append(arrival_ns)
            self._due_ns = arrival_ns
        else:
            self._due_ns += late_ns if late_ns < 0 else self.LATE * late_ns
        return min(round(self._due_ns), arrival_ns)
