"""Resample a robot's logs on a time grid, and mark dropouts."""

import numpy as np
from scipy.ndimage import median_filter

from dmrl.estimation.model.pair import (
    GRID_RATE_HZ,
    MAX_DROPOUT_S,
    NORMAL_MEDIAN,
    Array,
    Mask,
    SensorTrack,
    longest_gap_s,
    resample,
)
from dmrl.estimation.signals.jump_detection import find_runs, remove_height_steps

HEIGHT_SMOOTHING_S = 0.5
"""Window of the parabolic smoothing of heights, seconds. The noise of a range finder is 2 cm in
every sample, 4 px of a label at 1 m, and a drone climbs slowly."""
MAX_REPEATED_SHARE = 0.5
"""A log that repeats more than this share of its samples is written that way. No record of how the
value was chosen."""

SPIKE_SAMPLES, MIN_SPIKE_RADPS = 41, 2.5
"""Samples of the median of a yaw rate, and smallest difference of a spike from it, rad/s. A
Crazyflie turns by 3.5 rad/s at most by default, and needs 0.2 s for it."""
MIN_SPIKE_SIGMAS = 8.0
"""Smallest difference of a spike in standard deviations of all differences. A yaw rate in degrees
per second differs by over 2.5 most of the time, and its log is corrected later."""

MIN_SATURATED_RUN, MAX_EQUAL_SHARE = 3, 0.05
"""Samples in a row at the end of a signal's range that show a saturated sensor: noise makes three
equal ones of a continuous signal impossible. Signals whose other samples equal their neighbours
more often are rounded, and do not show it."""

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
    spiky = find_spikes(yaw_rate[1][:, 0])
    turn, turn_gap = resample(yaw_rate[0][~spiky], yaw_rate[1][~spiky], grid_s)
    limited = spiky | find_saturated(yaw_rate[1][:, 0])
    turn_gap |= find_frozen(*yaw_rate, grid_s) | _near(yaw_rate[0][limited], grid_s)
    speed, gap = resample(*velocity, grid_s)
    limited = find_saturated(velocity[1][:, 0]) | find_saturated(velocity[1][:, 1])
    gap |= find_frozen(*velocity, grid_s) | _near(velocity[0][limited], grid_s)
    level = remove_height_steps(height[0], height[1][:, 0])
    above, height_gap = resample(height[0], level[:, None], grid_s, longest_gap_s(height[0]))
    smooth_m = _smooth_parabola(above[:, 0], int(HEIGHT_SMOOTHING_S * GRID_RATE_HZ / 2))
    gap |= turn_gap
    return SensorTrack(speed[:, 0], speed[:, 1], turn[:, 0], smooth_m, gap, height_gap, turn_gap)


def find_spikes(yaw_rate_radps: Array) -> Mask:
    """Return (N,) whether a yaw rate leaves the median of its surroundings for an instant.

    No robot turns that fast and back. A reset of the heading, or a bad sample, looks so.

    Parameters
    ----------
    yaw_rate_radps
        (N,) samples, rad/s.
    """
    size = np.abs(yaw_rate_radps - median_filter(yaw_rate_radps, SPIKE_SAMPLES, mode="nearest"))
    deviation = np.median(size) / NORMAL_MEDIAN if len(size) else 0.0
    return np.asarray(size > max(MIN_SPIKE_RADPS, MIN_SPIKE_SIGMAS * deviation))


def find_saturated(values: Array) -> Mask:
    """Return (N,) whether a signal stays at the largest or smallest of its values.

    Parameters
    ----------
    values
        (N,) samples of a signal.
    """
    out = np.zeros(len(values), bool)
    if len(values) < MIN_SATURATED_RUN or np.ptp(values) == 0:
        return out
    ends = (values == values.max()) | (values == values.min())
    equal = np.diff(values) == 0
    if (equal & ~ends[1:]).mean() > MAX_EQUAL_SHARE:
        return out
    for first, last in find_runs(ends):
        out[first:last] = last - first >= MIN_SATURATED_RUN
    return out


def _near(time_s: Array, grid_s: Array) -> Mask:
    """Return (K,) whether one of some times is within a step of the grid."""
    out, step_s = np.zeros(len(grid_s), bool), grid_s[1] - grid_s[0]
    at = np.rint((time_s - grid_s[0]) / step_s).astype(int)
    for shift in (-1, 0, 1):
        out[np.clip(at + shift, 0, len(grid_s) - 1)] = True
    return out if len(time_s) else np.zeros(len(grid_s), bool)


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
    out = np.zeros(len(grid_s), bool)
    for first, last in find_runs(same):
        if time_s[last] - time_s[first] > MAX_DROPOUT_S:
            out |= (grid_s >= time_s[first]) & (grid_s <= time_s[last])
    return out


def _smooth_parabola(values: Array, reach: int) -> Array:
    """Smooth (N,) values by a parabola through those within reach (Savitzky and Golay 1964)."""
    # Equal to SciPy's savgol_filter, whose package takes a second to import.
    weights = np.linalg.pinv(np.vander(np.arange(-reach, reach + 1), 3))[-1]
    padded = np.pad(values, reach, mode="reflect", reflect_type="odd")
    return np.convolve(padded, weights, mode="valid")
