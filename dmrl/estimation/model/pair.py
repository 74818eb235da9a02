"""Sensor data of two robots on one clock, the input of every estimator."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

GRID_RATE_HZ = 100.0
"""Rate of the common time grid, Hz. No record of how the value was chosen."""
MAX_DROPOUT_S = 0.5
"""Longest dropout that is interpolated without a warning, seconds. No record of how the value was
chosen."""
SLOW_PERIODS, MAX_SLOW_DROPOUT_S = 1.5, 2.0
"""Periods of a slow log of heights or ranges, and seconds, beyond which a gap is a dropout: one
sample of a log at 1 Hz is missing."""
MAX_RANGE_M = 60.0
"""Longest plausible UWB range, metres. It rejects 65535 and other fill values."""
NORMAL_MEDIAN = 0.6745
"""Median absolute value of a standard normal distribution."""
SIGMA_OF_MEDIAN = 1.4826
"""Standard deviation of a normal distribution over the median of its absolute values."""


@dataclass(frozen=True, slots=True)
class SensorTrack:
    """Sensor signals of one robot on a uniform time grid of K samples.

    Parameters
    ----------
    vx_mps, vy_mps
        (K,) velocity in the robot's horizontal frame, m/s.
    yaw_rate_radps
        (K,) yaw rate about the vertical, positive to the left, rad/s.
    height_m
        (K,) height above the floor, metres.
    dropout
        (K,) whether velocity or yaw rate dropped out. The values there are interpolated.
    height_dropout
        (K,) whether the height dropped out. None: at no time.
    turn_dropout
        (K,) whether the yaw rate dropped out, which is part of ``dropout``. None: whenever
        ``dropout`` says so.
    """

    vx_mps: Array
    vy_mps: Array
    yaw_rate_radps: Array
    height_m: Array
    dropout: Mask
    height_dropout: Mask | None = None
    turn_dropout: Mask | None = None

    def select(self, samples: Mask) -> "SensorTrack":
        """Return some of the samples."""
        height_gap, turn_gap = (
            None if gap is None else gap[samples]
            for gap in (self.height_dropout, self.turn_dropout)
        )
        vx, vy, turn, height = (signal[samples] for signal in self.signals())
        return SensorTrack(vx, vy, turn, height, self.dropout[samples], height_gap, turn_gap)

    def signals(self) -> tuple[Array, Array, Array, Array]:
        """Return vx, vy, yaw rate and height, (K,) each."""
        return self.vx_mps, self.vy_mps, self.yaw_rate_radps, self.height_m


@dataclass(frozen=True, slots=True)
class BearingMeasurements:
    """Candidate detections of the peer in one camera: I images with up to C candidates.

    Parameters
    ----------
    time_s
        (I,) capture times of the images with a candidate, seconds, non-decreasing.
    bearing
        (I, C, 3) azimuth, elevation (rad) in the horizontal frame of the robot with the camera, and
        the natural logarithm of the distance in metres. NaN pads images with fewer candidates.
    std
        (I, C, 3) standard deviations of these.
    """

    time_s: Array
    bearing: Array
    std: Array

    def crop(self, start_s: float, end_s: float) -> "BearingMeasurements":
        """Return the images in an interval of time, seconds."""
        return self.take((self.time_s >= start_s) & (self.time_s <= end_s))

    def take(self, images: Mask) -> "BearingMeasurements":
        """Return some of the images."""
        return BearingMeasurements(self.time_s[images], self.bearing[images], self.std[images])


@dataclass(frozen=True, slots=True)
class Pair:
    """Signals of an observer and its peer, and the ranges between them.

    Parameters
    ----------
    time_s
        (K,) uniform time grid, seconds.
    own, peer
        Sensor signals of either robot at these times.
    range_time_s
        (R,) times of the ranges, seconds, inside the grid, non-decreasing.
    range_m
        (R,) measured distances, metres.
    own_bearings, peer_bearings
        Candidates of either camera. None: no camera, or no candidate. Images outside the grid are
        ignored.
    known_std
        Standard deviations of unknowns that a calibration determined, by name and robots (0:
        observer, 1: peer).
    range_sender
        (R,) robot that measured each range: 0 the observer, 1 the peer. None: not known.

    Raises
    ------
    ValueError
        If a value is not finite, a length is wrong, a time decreases or leaves the grid, or a range
        is not positive. Use ``usable_ranges`` and ``resample`` first.
    """

    time_s: Array
    own: SensorTrack
    peer: SensorTrack
    range_time_s: Array
    range_m: Array
    own_bearings: BearingMeasurements | None = None
    peer_bearings: BearingMeasurements | None = None
    known_std: Mapping[tuple[str, tuple[int, ...]], float] = field(default_factory=dict)
    range_sender: NDArray[np.int8] | None = None

    def __post_init__(self) -> None:
        count = len(self.time_s)
        steps = np.diff(self.time_s)
        if count < 2 or not np.allclose(steps, steps[0], rtol=1e-3) or steps[0] <= 0:
            raise ValueError("time_s: the grid is not uniform and increasing. Use `resample`")
        for name, track in (("own", self.own), ("peer", self.peer)):
            for signal in (*track.signals(), track.dropout):
                if signal.shape != (count,) or not np.isfinite(signal).all():
                    raise ValueError(
                        f"{name}: signals are not {count} finite numbers each. Use `resample`"
                    )
        self._check_ranges()

    def _check_ranges(self) -> None:
        if len(self.range_time_s) != len(self.range_m):
            raise ValueError("range_time_s: pass as many range times as ranges")
        if not usable_ranges(self.range_time_s, self.range_m, np.inf).all():
            raise ValueError(
                "range_m: ranges are not finite, positive and in time order. Use `usable_ranges`"
            )
        outside = (self.range_time_s < self.time_s[0]) | (self.range_time_s > self.time_s[-1])
        if outside.any():
            raise ValueError(f"range_time_s: {outside.sum()} ranges lie outside the time grid")

    @property
    def dt_s(self) -> float:
        """Step of the grid, seconds."""
        return float(self.time_s[-1] - self.time_s[0]) / (len(self.time_s) - 1)

    def swap_robots(self) -> "Pair":
        """Return the pair with observer and peer exchanged."""
        ranges = self.range_time_s, self.range_m
        sees = self.peer_bearings, self.own_bearings
        known: dict[tuple[str, tuple[int, ...]], float] = {
            (name, own if len(own) == 2 else (1 - own[0],)): std
            for (name, own), std in self.known_std.items()
        }
        sender = None if self.range_sender is None else np.asarray(1 - self.range_sender, np.int8)
        return Pair(self.time_s, self.peer, self.own, *ranges, *sees, known, sender)

    def crop(self, start_s: float, end_s: float) -> "Pair":
        """Return the pair in an interval of time, seconds."""
        at = (self.time_s >= start_s) & (self.time_s <= end_s)
        time_s = self.time_s[at]
        heard = (self.range_time_s >= time_s[0]) & (self.range_time_s <= time_s[-1])
        ranges = self.range_time_s[heard], self.range_m[heard]
        own, peer = (
            s and s.crop(time_s[0], time_s[-1]) for s in (self.own_bearings, self.peer_bearings)
        )
        sender = None if self.range_sender is None else self.range_sender[heard]
        tracks = self.own.select(at), self.peer.select(at)
        return Pair(time_s, *tracks, *ranges, own, peer, self.known_std, sender)


def usable_ranges(time_s: Array, range_m: Array, longest_m: float = MAX_RANGE_M) -> Mask:
    """Return (R,) whether ranges are finite, positive, not too long, and in time order.

    Parameters
    ----------
    time_s
        (R,) times in the order of arrival, seconds.
    range_m
        (R,) measured distances, metres.
    longest_m
        Longest plausible range, metres.
    """
    latest = np.fmax.accumulate(np.concatenate([[-np.inf], time_s]))[:-1]
    good = np.isfinite(range_m) & (range_m > 0) & (range_m <= longest_m)
    return np.asarray(good & (time_s >= latest))


def longest_gap_s(time_s: Array) -> float:
    """Return the longest time between two samples that is no dropout, seconds.

    Parameters
    ----------
    time_s
        (N,) times of a height, or of a robot's ranges, seconds. Heights change slowly, and odometry
        leads from range to range, so that slow logs are used.
    """
    period_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    return float(np.clip(SLOW_PERIODS * period_s, MAX_DROPOUT_S, MAX_SLOW_DROPOUT_S))


def resample(
    time_s: Array, values: Array, grid_s: Array, longest_s: float = MAX_DROPOUT_S
) -> tuple[Array, Mask]:
    """Interpolate signals on a time grid and mark dropouts.

    Samples that are not finite, or whose time does not increase, are ignored.

    Parameters
    ----------
    time_s
        (N,) times, seconds.
    values
        (N, C) signals.
    grid_s
        (K,) uniform grid, seconds.
    longest_s
        Longest time between samples that is no dropout, seconds.

    Returns
    -------
    signal : Array
        (K, C); the first and the last value extend to the ends of the grid.
    dropout : Mask
        (K,) whether the nearest samples on both sides are farther apart.

    Raises
    ------
    ValueError
        If no sample is usable.
    """
    latest = np.fmax.accumulate(np.concatenate([[-np.inf], time_s]))[:-1]
    good = np.isfinite(values).all(axis=1) & np.isfinite(time_s) & (time_s > latest)
    time_s, values = time_s[good], values[good]
    if not len(time_s):
        raise ValueError("values: no sample is finite with an increasing time")
    signal = np.column_stack([np.interp(grid_s, time_s, column) for column in values.T])
    after = np.searchsorted(time_s, grid_s)
    before_s = np.concatenate([[-np.inf], time_s])[after]
    after_s = np.concatenate([time_s, [np.inf]])[after]
    before_s = np.where(grid_s == after_s, grid_s, before_s)
    return signal, np.asarray(after_s - before_s > longest_s)
