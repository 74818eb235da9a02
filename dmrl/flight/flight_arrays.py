"""What a flight is: each robot's log on its own clock, ranges, and the truth."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from dmrl.flight.faults import Happened
from dmrl.geometry.frames import Array

RATE_HZ = 100.0
"""Samples per second of logs and truth."""

Signal = TypeVar("Signal", NDArray[np.float64], NDArray[np.complex128])


def numbers(values: NDArray[Any]) -> Iterator[Any]:
    """Python's numbers of an array, one at a time: as such they take five times the memory."""
    return map(values.item, range(len(values)))


def scanned(step: Callable[[Any, Any], Any], values: Signal) -> Signal:
    """(N,) what a step makes, from zero on, of what it made before and the next value."""
    made = accumulate(numbers(values), step, initial=values.dtype.type(0).item())
    next(made)
    return np.fromiter(made, values.dtype, len(values))


@dataclass(frozen=True, slots=True)
class Clock:
    """A robot's clock against true time.

    Parameters
    ----------
    offset_s
        What it shows at true time zero.
    drift
        Seconds it gains per true second.
    """

    offset_s: float = 0.0
    drift: float = 0.0

    def shows(self, true_time_s: Array) -> Array:
        """What the clock shows at true times, seconds."""
        return self.offset_s + (1.0 + self.drift) * true_time_s

    def true_time(self, time_s: Array) -> Array:
        """True times at which the clock shows ``time_s``, seconds."""
        return (time_s - self.offset_s) / (1.0 + self.drift)


@dataclass(frozen=True, slots=True)
class RobotLog:
    """What one robot measured of itself, (N,) each, on its own clock, 100 Hz; NaN where silent.

    Parameters
    ----------
    time_s
        The robot's clock.
    roll_rad, pitch_rad
        Attitude Rz(yaw) Ry(pitch) Rx(roll), z up: pitch positive nose down.
    yaw_rate_radps
        Positive to the left.
    vx_mps, vy_mps
        Velocity in the robot's own horizontal frame: x forward, y left, turning with its yaw.
    height_m
        Above the floor.
    """

    time_s: Array
    roll_rad: Array
    pitch_rad: Array
    yaw_rate_radps: Array
    vx_mps: Array
    vy_mps: Array
    height_m: Array


@dataclass(frozen=True, slots=True)
class Truth:
    """Where one robot truly is, world frame (z up), true time, 100 Hz.

    Parameters
    ----------
    time_s
        (N,) true time.
    position
        (N, 3) metres.
    velocity
        (N, 3) metres per second.
    yaw, roll, pitch
        (N,) radians; yaw is not wrapped.
    """

    time_s: Array
    position: Array
    velocity: Array
    yaw: Array
    roll: Array
    pitch: Array

    def position_at(self, time_s: Array) -> Array:
        """(M, 3) position at true times, metres, linear between samples."""
        return np.stack([np.interp(time_s, self.time_s, axis) for axis in self.position.T], axis=1)

    def yaw_at(self, time_s: Array) -> Array:
        """(M,) yaw at true times, radians, linear between samples."""
        return np.interp(time_s, self.time_s, self.yaw)


@dataclass(frozen=True, slots=True)
class Ranges:
    """UWB distances from one robot to another.

    Parameters
    ----------
    time_s
        (M,) clock of the robot that ranges.
    range_m
        (M,) distances as measured: no bias removed.
    """

    time_s: Array
    range_m: Array


@dataclass(frozen=True, slots=True)
class Flight:
    """Everything that happened, and what was measured of it.

    Parameters
    ----------
    robots
        Log of each robot.
    truth
        Truth of each robot.
    ranges
        By (robot that ranges, robot that answers); both ways of each pair.
    clocks
        Clock of each robot.
    faults
        What went wrong, and when.
    """

    robots: dict[str, RobotLog]
    truth: dict[str, Truth]
    ranges: dict[tuple[str, str], Ranges]
    clocks: dict[str, Clock]
    faults: tuple[Happened, ...] = ()

    def peer_in_horizontal(self, i: str, j: str, time_s: Array) -> Array:
        """(N, 3) where robot ``j`` is in ``i``'s horizontal frame, metres.

        Parameters
        ----------
        i, j
            Names of the robot that looks, and of its peer.
        time_s
            (N,) true times, seconds.
        """
        here, peer = self.truth[i], self.truth[j]
        away = peer.position_at(time_s) - here.position_at(time_s)
        c, s = np.cos(here.yaw_at(time_s)), np.sin(here.yaw_at(time_s))
        x, y, z = away.T
        return np.stack([c * x + s * y, c * y - s * x, z], axis=1)
