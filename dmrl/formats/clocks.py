"""Clocks of files: counters that wrap, clocks that start again, unset and simulated times.

Every format takes its times from here. ``settle_times`` processes the times of a whole file,
``CounterUnwrapper`` one value after the other; `dmrl.formats.ros.message_clock` has the same rules
for the stamps of a bag's messages. ``find_new_values`` finds measurements among held values.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dmrl.errors import SourceError
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import say

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

NS_PER_S = 1_000_000_000
WRAP_PERIODS_NS = (
    *(tick_ns << bits for tick_ns in (1000, 1_000_000) for bits in (16, 24, 31, 32)),
    *(1_000_000 << 8, 1 << 32, NS_PER_S, 86_400 * NS_PER_S, 604_800 * NS_PER_S),
)
"""Periods of common counters, nanoseconds: 8 to 32 bits of ms, us or ns; second, day, GPS week."""
SHORT_PERIOD_NS = NS_PER_S
"""Periods below it may be shorter than rows that are only out of order step back."""
DISORDER_S, DISORDER_PERIODS = 1.0, 10
"""Largest step back of rows that are only out of order: seconds and median periods, the smaller.

Two periods are always allowed, for slow logs.
"""
WRAP_GAP_PERIODS = 2
"""Largest gap at a wrap in median periods, or twice the largest other gap. More is a restart."""
GLITCH_ROWS = 3
"""Most rows in succession whose time is wrong, between rows whose times go on."""
SHUFFLED_SHARE = 0.1
"""Share of steps back from which rows are shuffled, and not several flights."""
CLOCK_SET_NS = 10**17
"""Step forward, three years, that is no gap but a clock that was set."""
REGULAR_CHANGES_MIN = 6
"""Changes, all of them a multiple of some rows apart, from which a logger holds values."""
CHANCE_MIN = 2
"""Repeats beyond those by chance from which values were held."""
UNSET_MIN_NS = 60 * NS_PER_S
"""Least time of a clock that is set. Nearer to it, 0 may be a time."""
EQUAL_TIMES_MIN = 10
"""Rows from which equal times are an error: their digits were lost."""


def unwrap(values: ArrayLike, bits: int) -> Ints:
    """Return (N,) counts that continue where the counter wrapped to 0.

    Each step is the smallest one, forward or back, that gives the next value. So values slightly
    out of order stay so, and a gap of half the counter's range or more is not detected.

    Parameters
    ----------
    values
        (N,) integers, as counted.
    bits
        Width of the counter: 8 for a frame number, 32 for microseconds.

    Returns
    -------
    Ints
        (N,) int64; the first value is unchanged.

    Examples
    --------
    >>> unwrap([254, 255, 0, 2, 1], 8).tolist()
    [254, 255, 256, 258, 257]
    """
    counts = np.asarray(values, np.int64)
    half = 1 << (bits - 1)
    steps = (np.diff(counts) + half) % (1 << bits) - half
    return np.concatenate([counts[:1], counts[:1] + np.cumsum(steps)])


class CounterUnwrapper:
    """Unwrapper of a counter with few bits, one value at a time.

    Parameters
    ----------
    bits
        Width of the counter.
    forward
        True: the counter never steps back, so up to 2**bits - 1 values may be missing. False: take
        the nearest value, before or after.
    """

    def __init__(self, bits: int, *, forward: bool = False) -> None:
        self._period = 1 << bits
        self._back = 0 if forward else self._period // 2
        self._last: int | None = None

    def __call__(self, value: int) -> int:
        """Return the unwrapped value of the counter.

        Examples
        --------
        >>> unwrapped = CounterUnwrapper(8)
        >>> [unwrapped(value) for value in (254, 255, 1, 0)]
        [254, 255, 257, 256]
        """
        self._last = self.find_nearest(value)
        return self._last

    def find_nearest(self, value: int) -> int:
        """Return the unwrapped value without storing it. It may have more bits than the counter."""
        if self._last is None:
            return value
        return self._last + (value - self._last + self._back) % self._period - self._back


@dataclass(frozen=True, slots=True)
class SettledTimes:
    """Times of a file on one clock: (N,) nanoseconds in order, and (N,) the row of each."""

    time_ns: Ints
    rows: Ints


def settle_times(times_ns: ArrayLike, name_row: Callable[[int], str]) -> SettledTimes:
    """Put the times of a file on one clock, and in order.

    A counter that wraps goes on, if its period is one of `WRAP_PERIODS_NS`. Times of 0 before a
    clock was set, and times that jump and return, are left out. Rows that are slightly out of order
    are sorted.

    Parameters
    ----------
    times_ns
        (N,) nanoseconds, in the order of the file.
    name_row
        Return the file and line of a row, by its index.

    Raises
    ------
    SourceError
        If the clock starts again, as in a file with two flights, or all times are equal.
    """
    times = np.asarray(times_ns, np.int64)
    rows = np.arange(len(times))
    if len(times) >= EQUAL_TIMES_MIN and (times == times[0]).all():
        raise SourceError(
            f"{name_row(0)}: all {len(times)} times are {times[0] * 1e-9:.9g} s: they were saved "
            "with too few digits. Save them again"
        )
    rows = rows[~_find_unset(times, name_row)]
    if not _is_shuffled(times[rows]):
        rows = rows[~_find_glitches(times[rows], lambda k: name_row(int(rows[k])))]
    kept = times[rows]
    kept = _unwrap_or_refuse(kept, lambda k: name_row(int(rows[k])))
    if (np.diff(kept) < 0).any():
        first = int(np.flatnonzero(np.diff(kept) < 0)[0]) + 1
        say(f"{name_row(int(rows[first]))}: rows are not in time order from here on; sorted")
        order = np.argsort(kept, kind="stable")
        kept, rows = kept[order], rows[order]
    return SettledTimes(kept, rows)


def _find_tolerance(times: Ints) -> float:
    """Return the largest step back of rows that are only out of order, nanoseconds."""
    ahead = np.diff(times)
    ahead = ahead[ahead > 0]
    period = float(np.median(ahead)) if len(ahead) else DISORDER_S * NS_PER_S
    return max(min(DISORDER_S * NS_PER_S, DISORDER_PERIODS * period), 2 * period)


def _is_shuffled(times: Ints) -> bool:
    """Return whether rows are in no order of time: backwards, or sorted by something else."""
    return bool(np.count_nonzero(np.diff(times) < 0) > max(SHUFFLED_SHARE * len(times), 1))


def _find_unset(times: Ints, name_row: Callable[[int], str]) -> Mask:
    """Return a mask of the times of a clock that was not set: 0, or years before the others.

    A time of 0 among times near 0 is a time.
    """
    unset: Mask = np.asarray(times == 0)
    known = times[~unset]
    if not len(known) or known.min() <= max(int(np.ptp(known)), UNSET_MIN_NS):
        unset[:] = False
    known_rows = np.flatnonzero(~unset)
    jumps = np.flatnonzero(np.diff(times[known_rows]) > CLOCK_SET_NS)
    early, late = np.split(known_rows, jumps[:1] + 1)[:2] if len(jumps) else (jumps, jumps)
    if 0 < len(early) <= len(late) and times[late].min() - times[early].max() > CLOCK_SET_NS:
        unset[early] = True
    if unset.any():
        first = name_row(int(np.flatnonzero(unset)[0]))
        leave_out("rows with times from before the clock was set", first, int(unset.sum()))
    return unset


def _find_glitches(times: Ints, name_row: Callable[[int], str]) -> Mask:
    """Return a mask of the times of a few rows that jump, where the rows around them go on."""
    bad = np.zeros(len(times), bool)
    tolerance = _find_tolerance(times)
    for length in range(1, GLITCH_ROWS + 1):
        if len(times) < 2 * length + 2:
            break
        before, after = times[: -length - 1], times[length + 1 :]
        first, last = times[1:-length], times[length:-1]
        goes_on = (after >= before - tolerance) & (after - before <= (length + 1) * tolerance)
        jumps = (np.abs(first - before) > tolerance) & (np.abs(last - after) > tolerance)
        for start in np.flatnonzero(goes_on & jumps) + 1:
            outside = (times[start : start + length] < before[start - 1] - tolerance) | (
                times[start : start + length] > after[start - 1] + tolerance
            )
            bad[start : start + length] |= outside
    if bad.any():
        first_row = name_row(int(np.flatnonzero(bad)[0]))
        leave_out("rows whose time jumps and returns", first_row, int(bad.sum()))
    return bad


def _unwrap_or_refuse(times: Ints, name_row: Callable[[int], str]) -> Ints:
    """Return the times of a counter that wrapped; the same times, if rows are out of order.

    Raises
    ------
    SourceError
        If the clock starts again.
    """
    tolerance = _find_tolerance(times)
    back = np.flatnonzero(np.diff(times) < -tolerance)
    # Wraps of a short counter step back no further than rows that are only out of order.
    is_short = len(times) > 0 and np.ptp(times) < SHORT_PERIOD_NS
    falls = np.flatnonzero(np.diff(times) < 0) if is_short else back
    for period in sorted(WRAP_PERIODS_NS) if len(falls) else ():
        half = period // 2
        steps = (np.diff(times) + half) % period - half
        ahead = np.delete(steps, falls)
        gap_ns = max(WRAP_GAP_PERIODS * np.median(ahead), 2 * ahead.max()) if len(ahead) else 0
        goes_on = (steps >= -tolerance).all() and (steps[falls] >= 0).all()
        if period > np.ptp(times) and goes_on and (steps[falls] <= gap_ns).all():
            first = name_row(int(falls[0]) + 1)
            say(f"{first}: the clock wrapped after {period * 1e-9:.9g} s; continued")
            return np.concatenate([times[:1], times[0] + np.cumsum(steps)])
    if not len(back) or _is_shuffled(times):
        return times
    raise SourceError(
        f"{name_row(int(back[0]) + 1)}: time goes back from {times[back[0]] * 1e-9:.9g} s to "
        f"{times[back[0] + 1] * 1e-9:.9g} s: a second flight, another robot, or a clock that "
        "started again. Split the file there"
    )


def find_new_values(values: NDArray[Any], *, polled: bool = False) -> Mask:
    """Return an (N,) mask of the values that are measurements, and not the last one held.

    A logger that is faster than a sensor repeats its last value. Values may also repeat by chance,
    where they have few digits. Of values with normal noise, chance repeats at most the share that
    their resolution is of their usual change.

    Parameters
    ----------
    values
        (N,) values; NaN: none.
    polled
        The logger is known to repeat values: every repeat is an old one.

    Examples
    --------
    >>> find_new_values(np.repeat([2.0, 2.31, 2.3, 2.75], 3)).nonzero()[0].tolist()
    [0, 3, 6, 9]
    >>> find_new_values(np.array([2.0, 2.0, 2.1, 2.1, 2.2, 2.1])).all()
    np.True_
    """
    values = np.asarray(values, float)
    known = np.isfinite(values)
    repeated = np.concatenate([[False], known[1:] & (values[1:] == values[:-1])])[: len(values)]
    steps = np.abs(np.diff(values[known]))
    steps = steps[steps > 0]
    changes = np.flatnonzero(known & ~repeated)
    if len(changes) >= REGULAR_CHANGES_MIN and np.gcd.reduce(np.diff(changes)) > 1:
        polled = True
    if not polled and len(steps):
        levels = np.diff(np.unique(values[known]))
        by_chance = min(float(levels.min() / np.median(steps)), 1.0)
        followers = int((known[1:] & known[:-1]).sum())
        polled = int(repeated.sum()) > by_chance * followers + CHANCE_MIN
    return ~repeated if polled else np.ones(len(values), bool)
