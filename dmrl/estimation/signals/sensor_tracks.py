"""A robot's logs as they came, on a time grid, without what no robot can have done."""

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter, minimum_filter1d

from dmrl.estimation.model.pair import LONGEST_GAP_S, RATE_HZ, Array, Mask, Track, resample
from dmrl.estimation.signals.jump_detection import levelled_height

SMOOTHED_S = 0.5
"""Window over which heights are smoothed, by parabolas: a range finder errs by 2 cm in every
sample, which is 4 px at 1 m, and a drone climbs slowly."""
FAST_MPS, FAST_RADPS, TIMES_USUAL, LASTING_S = 3.0, 5.0, 4.0, 0.2
"""An estimate runs away after a crash: beyond these, and so many times the flight's median, for so
long. The robot lies still then, so its rates count as zero and as unknown."""
AROUND = 2 * round(RATE_HZ) + 1
"""Samples of a second before and after, in which the rates may be those of a fall already."""
FROZEN_SHARE = 0.5
"""Where more of a log than this repeats itself, that is how it is written."""

Signals = tuple[Array, Array]
"""Times (N,), seconds, and (N, C) values."""


def track(yaw_rate: Signals, velocity: Signals, height: Signals, grid_s: Array) -> Track:
    """One robot's sensors on a time grid.

    Parameters
    ----------
    yaw_rate
        Column 0: rad/s.
    velocity
        Forward, left, m/s.
    height
        Column 0: metres. Steps in it are taken out, and it is smoothed.
    grid_s
        (K,) uniform grid at 100 Hz, seconds.
    """
    turn, turn_gap = resample(*yaw_rate, grid_s)
    speed, gap = resample(*velocity, grid_s)
    gap |= frozen(*velocity, grid_s)
    level = levelled_height(height[0], height[1][:, 0])
    above, height_gap = resample(height[0], level[:, None], grid_s)
    smooth_m = _smoothed(above[:, 0], int(SMOOTHED_S * RATE_HZ / 2))
    lost = wild(np.hypot(*speed.T), FAST_MPS) | wild(np.abs(turn[:, 0]), FAST_RADPS)
    known = ~lost
    gap |= turn_gap | lost
    rates = (speed[:, 0] * known, speed[:, 1] * known, turn[:, 0] * known)
    return Track(*rates, np.where(down(lost), 0.0, smooth_m), gap, height_gap)


def wild(size: Array, fast: float) -> Mask:
    """(K,) where a rate at 100 Hz, and a second around, is far beyond the flight's: it ran away.

    Parameters
    ----------
    size
        (K,) its size.
    fast
        What is slower never is.
    """
    limit = max(fast, TIMES_USUAL * float(np.median(size)))
    lasting = median_filter(size, round(LASTING_S * RATE_HZ), mode="mirror") > limit
    return np.asarray(maximum_filter1d(lasting, AROUND))


def down(lost: Mask) -> Mask:
    """(K,) where a robot whose estimate ran away for good lies on the floor, at a height of zero.

    Parameters
    ----------
    lost
        (K,) where it ran away, and a second around, at 100 Hz.
    """
    ran = minimum_filter1d(lost, AROUND)
    return np.asarray(np.logical_and.accumulate(ran[::-1])[::-1])


def frozen(time_s: Array, values: Array, grid_s: Array) -> Mask:
    """(K,) where a signal did not change for over half a second though it has noise elsewhere.

    Parameters
    ----------
    time_s
        (N,) times, seconds.
    values
        (N, C) signals.
    grid_s
        (K,) times asked for, seconds.
    """
    same = (np.diff(values, axis=0) == 0).all(axis=1)
    if len(time_s) < 2 or same.mean() > FROZEN_SHARE:
        return np.zeros(len(grid_s), bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(int), [0]]))).reshape(-1, 2)
    out = np.zeros(len(grid_s), bool)
    for first, last in edges:
        if time_s[last] - time_s[first] > LONGEST_GAP_S:
            out |= (grid_s >= time_s[first]) & (grid_s <= time_s[last])
    return out


def _smoothed(values: Array, reach: int) -> Array:
    """Each of (N,) values on the parabola through those within reach (Savitzky and Golay 1964)."""
    # SciPy's savgol_filter, whose package takes a second to import.
    weights = np.linalg.pinv(np.vander(np.arange(-reach, reach + 1), 3))[-1]
    padded = np.pad(values, reach, mode="reflect", reflect_type="odd")
    return np.convolve(padded, weights, mode="valid")
