"""Signals that jump where what they measure cannot: a shadowed range, a height over a table.

What changes far faster than it did the second before is not the robot, and what came at once
mostly goes at once: between two jumps a signal is off by about as much as it jumped. Said here
from the data alone, before any solution is known that such a signal could bend.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import median_filter

from dmrl.estimation.model.pair import Array

BACK_SHARE = 0.5
"""After a jump down, what is left of a level below this share of the jump is none."""
TREND_S = 1.0
"""Half the time over which a signal's trend is taken: a robot's velocity lasts that long."""
LONGEST_S = 30.0
"""What does not come back for so long was no jump, or the way back was missed."""
HEIGHT_REACH_S, HEIGHT_NOISE_M = 0.05, 0.12
"""Over how long a height is held against itself, and what may be noise at least."""
NOISE_SIGMAS = 5.0
"""Standard deviations of a sample's change that a jump exceeds."""


def levels(values: Array, step_s: float, least: float, reach: int) -> Array:
    """(N,) by how much a signal is too large, piecewise constant, mostly 0.

    Parameters
    ----------
    values
        (N,) the signal.
    step_s
        Seconds between samples.
    least
        Jumps are larger than this, and than the signal's noise.
    reach
        Medians of so many samples before and after are compared.
    """
    if len(values) < 4 * reach:
        return np.zeros(len(values))
    single = np.diff(values)
    trend = median_filter(single, 2 * round(TREND_S / step_s) + 1, mode="mirror")
    noise = 1.5 * float(np.median(np.abs(single - trend))) / np.sqrt(min(reach, 3))
    may = max(least, NOISE_SIGMAS * noise * np.sqrt(1.5))
    middle = np.median(sliding_window_view(np.pad(values, reach, mode="edge"), reach), axis=1)
    change = middle[1 + reach : reach + len(values)] - middle[1 : len(values)] - reach * trend
    change[:reach], change[-reach:] = 0.0, 0.0
    jumps = []
    for first, last in _runs(np.abs(change) > may):
        jump = float(change[first + int(np.argmax(np.abs(change[first:last])))])
        jumps.append((first + int(np.argmax(np.sign(jump) * single[first:last])) + 1, jump))
    return _between(jumps, len(values), round(LONGEST_S / step_s))


def _between(jumps: list[tuple[int, float]], count: int, longest: int) -> Array:
    """(count,) levels between jumps, each the first sample after it and how far it went."""
    out, start = np.zeros(count), 0
    level = max(0.0, -jumps[0][1]) if jumps else 0.0  # it may begin while it is too large
    for k, (at, jump) in enumerate(jumps):
        out[start:at] = level if at - start < longest else 0.0
        later = [one for when, one in jumps[k:] if when - at < longest]
        level, start = _after(level, jump, _comes_down(level, later)), at
    out[start:] = level if count - start < longest else 0.0
    return out


def _comes_down(level: float, jumps: list[float]) -> bool:
    """Whether jumps, each on top of the last, end where the signal is right again."""
    for jump in jumps:
        level += jump
        if level <= -BACK_SHARE * jump:
            return level >= BACK_SHARE * jump
    return False


def _after(level: float, jump: float, on_top: bool) -> float:
    """The level after a jump. Nothing is ever too small.

    What jumps up twice lies on top of what was there if both come down again; else the way back
    between them was missed.
    """
    if jump > 0:
        return level + jump if on_top else jump
    return level + jump if level + jump > -BACK_SHARE * jump else 0.0


def _runs(marked: Array) -> list[tuple[int, int]]:
    """First and one past the last of each run of what is marked."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], marked.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def levelled_height(time_s: Array, height_m: Array) -> Array:
    """(N,) heights above the floor, metres, where a robot flew over something as well.

    Parameters
    ----------
    time_s
        (N,) going forward, seconds.
    height_m
        (N,) as measured: above what is below.
    """
    if len(time_s) < 3:
        return height_m
    step_s = max(float(np.median(np.diff(time_s))), 1e-3)
    reach = max(1, round(HEIGHT_REACH_S / step_s))
    return height_m + levels(-height_m, step_s, HEIGHT_NOISE_M, reach)
