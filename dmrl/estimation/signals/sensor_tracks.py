"""Resample a robot's logs on a time grid, without physically impossible readings."""

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter, minimum_filter1d

from dmrl.estimation.model.pair import (
    GRID_RATE_HZ,
    MAX_DROPOUT_S,
    Array,
    Mask,
    SensorTrack,
    resample,
)
from dmrl.estimation.signals.jump_detection import remove_height_steps

HEIGHT_SMOOTHING_S = 0.5
"""Window of the parabolic smoothing of heights, seconds. The noise of a range finder is 2 cm in
every sample, 4 px of a label at 1 m, and a drone climbs slowly."""
RUNAWAY_MPS, RUNAWAY_RADPS, RUNAWAY_RATIO, RUNAWAY_S = 3.0, 5.0, 4.0, 0.2
"""Limits of a runaway state estimate: speed, yaw rate, ratio to the flight's median, and duration.

An estimate runs away after a crash. The robot then lies still, so its rates are set to zero and
marked as dropout. In logs of real crashes the estimate reached 9 m/s. No record of how the values
were chosen."""
RUNAWAY_WINDOW = 2 * round(GRID_RATE_HZ) + 1
"""Window around a runaway estimate, samples: one second before and after, which may belong to the
fall."""
MAX_REPEATED_SHARE = 0.5
"""A log that repeats more than this share of its samples is written that way. No record of how the
value was chosen."""

Signals = tuple[Array, Array]
"""Times (N,), seconds, and (N, C) values."""


def build_track(
    yaw_rate: Signals, velocity: Signals, height: Signals, grid_s: Array
) -> SensorTrack:
    """Build the signals of one robot on a time grid.

    Parameters
    ----------
    yaw_rate
        Column 0: rad/s.
    velocity
        Forward, left, m/s.
    height
        Column 0: metres. Steps are removed, and the result is smoothed.
    grid_s
        (K,) uniform grid at 100 Hz, seconds.
    """
    turn, turn_gap = resample(*yaw_rate, grid_s)
    speed, gap = resample(*velocity, grid_s)
    gap |= find_frozen(*velocity, grid_s)
    level = remove_height_steps(height[0], height[1][:, 0])
    above, height_gap = resample(height[0], level[:, None], grid_s)
    smooth_m = _smooth_parabola(above[:, 0], int(HEIGHT_SMOOTHING_S * GRID_RATE_HZ / 2))
    lost = find_runaway(np.hypot(*speed.T), RUNAWAY_MPS) | find_runaway(
        np.abs(turn[:, 0]), RUNAWAY_RADPS
    )
    known = ~lost
    gap |= turn_gap | lost
    rates = (speed[:, 0] * known, speed[:, 1] * known, turn[:, 0] * known)
    return SensorTrack(*rates, np.where(find_crash(lost), 0.0, smooth_m), gap, height_gap)


def find_runaway(size: Array, fast: float) -> Mask:
    """Return (K,) where a rate at 100 Hz ran away, with one second around.

    Parameters
    ----------
    size
        (K,) absolute value of the rate.
    fast
        Rate below which no estimate has run away.
    """
    limit = max(fast, RUNAWAY_RATIO * float(np.median(size)))
    lasting = median_filter(size, round(RUNAWAY_S * GRID_RATE_HZ), mode="mirror") > limit
    return np.asarray(maximum_filter1d(lasting, RUNAWAY_WINDOW))


def find_crash(lost: Mask) -> Mask:
    """Return (K,) where a crashed robot lies on the floor, at a height of zero.

    Parameters
    ----------
    lost
        (K,) where its estimate ran away, and a second around, at 100 Hz.
    """
    ran = minimum_filter1d(lost, RUNAWAY_WINDOW)
    return np.asarray(np.logical_and.accumulate(ran[::-1])[::-1])


def find_frozen(time_s: Array, values: Array, grid_s: Array) -> Mask:
    """Return (K,) where a signal repeats one value for over half a second.

    Logs that mostly repeat values are written that way and count as not frozen.

    Parameters
    ----------
    time_s
        (N,) times, seconds.
    values
        (N, C) signals.
    grid_s
        (K,) times to test, seconds.
    """
    same = (np.diff(values, axis=0) == 0).all(axis=1)
    if len(time_s) < 2 or same.mean() > MAX_REPEATED_SHARE:
        return np.zeros(len(grid_s), bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(int), [0]]))).reshape(-1, 2)
    out = np.zeros(len(grid_s), bool)
    for first, last in edges:
        if time_s[last] - time_s[first] > MAX_DROPOUT_S:
            out |= (grid_s >= time_s[first]) & (grid_s <= time_s[last])
    return out


def _smooth_parabola(values: Array, reach: int) -> Array:
    """Smooth (N,) values by a parabola through those within reach (Savitzky and Golay 1964)."""
    # Equal to SciPy's savgol_filter, whose package takes a second to import.
    weights = np.linalg.pinv(np.vander(np.arange(-reach, reach + 1), 3))[-1]
    padded = np.pad(values, reach, mode="reflect", reflect_type="odd")
    return np.convolve(padded, weights, mode="valid")
