"""What two robots measured, on one clock: the input of every estimator here."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

RATE_HZ = 100.0
"""Rate of the common time grid."""
LONGEST_GAP_S = 0.5
"""Silence of a sensor that is bridged without a word."""
LONGEST_RANGE_M = 60.0
"""Beyond the reach of UWB: 65535 and other fill values."""
SWAPPED = [0, 1, 3, 2, 5, 4, 8, 9, 6, 7, 10]
"""Order of ``GLOBALS`` seen from the peer."""


@dataclass(frozen=True, slots=True)
class Track:
    """One robot's own sensors on a uniform time grid of K samples.

    Parameters
    ----------
    vx_mps, vy_mps
        (K,) velocity in the robot's horizontal frame, m/s.
    yaw_rate_radps
        (K,) turning rate about the vertical, positive to the left, rad/s.
    height_m
        (K,) height above the floor, metres.
    gap
        (K,) whether velocity or yaw rate was silent; the values there are only filled in.
    height_gap
        (K,) whether the height was; None: nowhere.
    """

    vx_mps: Array
    vy_mps: Array
    yaw_rate_radps: Array
    height_m: Array
    gap: Mask
    height_gap: Mask | None = None

    def values(self) -> tuple[Array, Array, Array, Array]:
        """The four signals."""
        return self.vx_mps, self.vy_mps, self.yaw_rate_radps, self.height_m


@dataclass(frozen=True, slots=True)
class Sightings:
    """What a robot's camera showed that may be the other robot. I images, up to C candidates.

    Parameters
    ----------
    time_s
        (I,) when the images that show a candidate were taken, seconds, never going back.
    polar
        (I, C, 3) azimuth, elevation (rad) in the horizontal frame of the robot that saw, and the
        logarithm of the distance in metres; NaN where an image has no more candidates.
    std
        (I, C, 3) standard deviations of these.
    """

    time_s: Array
    polar: Array
    std: Array


@dataclass(frozen=True, slots=True)
class Pair:
    """An observer, its peer, and the ranges between them.

    Parameters
    ----------
    time_s
        (K,) uniform time grid, seconds.
    own, peer
        What either robot measured at those times.
    range_time_s
        (R,) times of the ranges, seconds, inside the grid, never going back.
    range_m
        (R,) measured distances, metres.
    own_sees, peer_sees
        What the camera of either showed; None: nothing, or it has none. Images outside the grid
        do not count.
    known_std
        (G,) standard deviations of what is constant over the flight, in the order of ``GLOBALS``,
        where they are known to be smaller than usual; None: nowhere.

    Raises
    ------
    ValueError
        If a value is not finite, a length is wrong, time goes back or leaves the grid, or a
        range is not in (0, 60] m: use ``usable_ranges`` and ``resample`` first.
    """

    time_s: Array
    own: Track
    peer: Track
    range_time_s: Array
    range_m: Array
    own_sees: Sightings | None = None
    peer_sees: Sightings | None = None
    known_std: Array | None = None

    def __post_init__(self) -> None:
        count = len(self.time_s)
        steps = np.diff(self.time_s)
        if count < 2 or not np.allclose(steps, steps[0], rtol=1e-3) or steps[0] <= 0:
            raise ValueError("the time grid is not uniform and forward. Use `resample`")
        for name, track in (("own", self.own), ("peer", self.peer)):
            for signal in (*track.values(), track.gap):
                if signal.shape != (count,) or not np.isfinite(signal).all():
                    raise ValueError(f"{name} signals are not {count} finite numbers each")
        self._check_ranges()

    def _check_ranges(self) -> None:
        if len(self.range_time_s) != len(self.range_m):
            raise ValueError("as many range times as ranges are needed")
        if not usable_ranges(self.range_time_s, self.range_m).all():
            raise ValueError("ranges are not finite, positive and in time order")
        outside = (self.range_time_s < self.time_s[0]) | (self.range_time_s > self.time_s[-1])
        if outside.any():
            raise ValueError(f"{outside.sum()} ranges lie outside the time grid")

    @property
    def dt_s(self) -> float:
        """Step of the grid, seconds."""
        return float(self.time_s[-1] - self.time_s[0]) / (len(self.time_s) - 1)

    def swapped(self) -> "Pair":
        """The same ranges seen from the peer."""
        ranges = self.range_time_s, self.range_m
        sees = self.peer_sees, self.own_sees
        known_std = None if self.known_std is None else self.known_std[SWAPPED]
        return Pair(self.time_s, self.peer, self.own, *ranges, *sees, known_std)


def usable_ranges(time_s: Array, range_m: Array) -> Mask:
    """(R,) which ranges are finite, in (0, 60] m, and no earlier than any range before them.

    Parameters
    ----------
    time_s
        (R,) times in the order of arrival, seconds.
    range_m
        (R,) measured distances, metres.
    """
    latest = np.fmax.accumulate(np.concatenate([[-np.inf], time_s]))[:-1]
    good = np.isfinite(range_m) & (range_m > 0) & (range_m <= LONGEST_RANGE_M)
    return np.asarray(good & (time_s >= latest))


def resample(time_s: Array, values: Array, grid_s: Array) -> tuple[Array, Mask]:
    """A signal on a time grid, interpolated, and where it was silent.

    Samples that are not finite, or do not go forward in time, are left out.

    Parameters
    ----------
    time_s
        (N,) times, seconds.
    values
        (N, C) signals.
    grid_s
        (K,) uniform grid, seconds.

    Returns
    -------
    signal : Array
        (K, C); held at the ends.
    gap : Mask
        (K,) whether the nearest samples on both sides are over 0.5 s apart.

    Raises
    ------
    ValueError
        If nothing is left.
    """
    latest = np.fmax.accumulate(np.concatenate([[-np.inf], time_s]))[:-1]
    good = np.isfinite(values).all(axis=1) & np.isfinite(time_s) & (time_s > latest)
    time_s, values = time_s[good], values[good]
    if not len(time_s):
        raise ValueError("no sample is finite and forward in time")
    signal = np.column_stack([np.interp(grid_s, time_s, column) for column in values.T])
    after = np.searchsorted(time_s, grid_s)
    before_s = np.concatenate([[-np.inf], time_s])[after]
    after_s = np.concatenate([time_s, [np.inf]])[after]
    before_s = np.where(grid_s == after_s, grid_s, before_s)
    return signal, np.asarray(after_s - before_s > LONGEST_GAP_S)
