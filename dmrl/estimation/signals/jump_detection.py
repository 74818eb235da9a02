"""Detect steps of signals, such as a shadowed range or a height over a table.

A change much faster than the trend of the second before is not the robot's motion. An offset that
appears at once mostly disappears at once: between two jumps the signal is off by about the size of
the jump. The detection uses the data alone, before any solution exists that the offset could bend.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import median_filter

from dmrl.estimation.model.pair import Array, Mask

MIN_OFFSET_SHARE = 0.5
"""After a jump down, an offset below this share of the jump counts as zero. No record of how the
value was chosen."""
TREND_HALF_WINDOW_S = 1.0
"""Half the window of a signal's trend, seconds: a robot keeps its velocity for about that long. No
record of how the value was chosen."""
MAX_OFFSET_S = 30.0
"""Longest offset, seconds. A longer one was no jump, or its end was missed. No record of how the
value was chosen."""
HEIGHT_MEDIAN_S, MIN_HEIGHT_STEP_M = 0.05, 0.12
"""Length of the medians of a height before and after a step, seconds; and smallest step, metres, as
smaller ones may be noise. No record of how the values were chosen."""
MIN_STEPS = 10.0
"""Median change of a signal over its smallest, from which repeated values are no rounding."""
MIN_STEP_SIGMAS = 5.0
"""Smallest jump, in standard deviations of a sample's change. No record of how the value was
chosen."""


def step_offsets(
    values: Array, step_s: float, least: float, reach: int, moved: Array | float = 0.0
) -> Array:
    """Return (N,) the excess of a signal: piecewise constant, mostly 0.

    Parameters
    ----------
    values
        (N,) the signal.
    step_s
        Seconds between samples.
    least
        Smallest jump. Jumps must also exceed the signal's noise.
    reach
        Number of samples in the medians before and after.
    moved
        (N,) largest change of the signal by motion, from the samples before to those after.
    """
    if len(values) < 4 * reach:
        return np.zeros(len(values))
    single = np.diff(values)
    trend = median_filter(single, 2 * round(TREND_HALF_WINDOW_S / step_s) + 1, mode="mirror")
    noise = 1.5 * float(np.median(np.abs(single - trend))) / np.sqrt(min(reach, 3))
    may = max(least, MIN_STEP_SIGMAS * noise * np.sqrt(1.5))
    middle = np.median(sliding_window_view(np.pad(values, reach, mode="edge"), reach), axis=1)
    change = middle[1 + reach : reach + len(values)] - middle[1 : len(values)] - reach * trend
    change[:reach], change[-reach:] = 0.0, 0.0
    jumps = []
    plain = np.abs(change + reach * trend) - np.broadcast_to(moved, values.shape)[1:]
    for first, last in find_runs((np.abs(change) > may) & (plain > least / 4)):
        jump = float(change[first + int(np.argmax(np.abs(change[first:last])))])
        jumps.append((first + int(np.argmax(np.sign(jump) * single[first:last])) + 1, jump))
    return _offsets_between_jumps(jumps, len(values), round(MAX_OFFSET_S / step_s))


def _offsets_between_jumps(jumps: list[tuple[int, float]], count: int, longest: int) -> Array:
    """Return (count,) offsets between jumps, given as the first sample after each and its size."""
    out, start = np.zeros(count), 0
    level = max(0.0, -jumps[0][1]) if jumps else 0.0  # the signal may begin with an offset
    for k, (at, jump) in enumerate(jumps):
        out[start:at] = level if at - start < longest else 0.0
        later = [one for when, one in jumps[k:] if when - at < longest]
        level, start = _offset_after_jump(level, jump, _returns_to_zero(level, later)), at
    out[start:] = level if count - start < longest else 0.0
    return out


def _returns_to_zero(level: float, jumps: list[float]) -> bool:
    """Return whether jumps on top of each other return to a correct signal."""
    for jump in jumps:
        level += jump
        if level <= -MIN_OFFSET_SHARE * jump:
            return level >= MIN_OFFSET_SHARE * jump
    return False


def _offset_after_jump(level: float, jump: float, on_top: bool) -> float:
    """Return the offset after a jump, never negative.

    A second jump up adds to the first offset if both come down again. Otherwise the end of the
    first one was missed.
    """
    if jump > 0:
        return level + jump if on_top else jump
    return level + jump if level + jump > -MIN_OFFSET_SHARE * jump else 0.0


def find_held(values: Array) -> Array:
    """Return (N,) whether a sample repeats the one before it, in a signal that seldom does.

    A log that is rounded repeats values by chance, and counts as not held.

    Parameters
    ----------
    values
        (N,) samples of one sensor, in the order of time.
    """
    same = np.diff(values, prepend=np.nan) == 0
    steps = np.abs(np.diff(values[~same]))
    coarse = len(steps) < 2 or np.median(steps) < MIN_STEPS * steps.min(
        initial=np.inf, where=steps > 0
    )
    return np.zeros(len(values), bool) if coarse else same


def find_spacing(values: Array) -> float:
    """Return the median distance between neighbouring values: the unit of a rounded log.

    Parameters
    ----------
    values
        (N,) samples in any order.
    """
    distinct = np.unique(values)
    return float(np.median(np.diff(distinct))) if len(distinct) > 1 else 0.0


def find_runs(marked: Mask) -> list[tuple[int, int]]:
    """Return start and end (exclusive) of each run of marked samples."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], marked.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def remove_height_steps(time_s: Array, height_m: Array) -> Array:
    """Return (N,) heights above the floor, metres, with objects under the robot removed.

    Parameters
    ----------
    time_s
        (N,) increasing, seconds.
    height_m
        (N,) measured heights above the surface below.
    """
    if len(time_s) < 3:
        return height_m
    step_s = max(float(np.median(np.diff(time_s))), 1e-3)
    reach = max(1, round(HEIGHT_MEDIAN_S / step_s))
    return height_m + step_offsets(-height_m, step_s, MIN_HEIGHT_STEP_M, reach)
