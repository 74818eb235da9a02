"""Arrays of a simulated flight: logs on each robot's clock, ranges and ground truth."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from dmrl.flight.faults import FaultEvent
from dmrl.geometry.frames import Array

DECIMALS = 8
"""Decimals of simulated values: the last bits of sines differ between processors."""
RATE_HZ = 100.0
"""Samples per second of logs and truth."""

Signal = TypeVar("Signal", NDArray[np.float64], NDArray[np.complex128])


def iter_numbers(values: NDArray[Any]) -> Iterator[Any]:
    """Iterate over an array as Python numbers, which take five times the memory in a list."""
    return map(values.item, range(len(values)))


def scan_values(step: Callable[[Any, Any], Any], values: Signal) -> Signal:
    """Apply a step to each value and the previous result, from zero. Return (N,) results."""
    made = accumulate(iter_numbers(values), step, initial=values.dtype.type(0).item())
    next(made)
    return np.fromiter(made, values.dtype, len(values))


@dataclass(frozen=True, slots=True)
class Clock:
    """Clock of a robot relative to true time.

    Parameters
    ----------
    offset_s
        Clock time at true time zero.
    drift
        Seconds gained per true second.
    """

    offset_s: float = 0.0
    drift: float = 0.0

    def to_clock_time(self, true_time_s: Array) -> Array:
        """Convert true times to clock times, seconds."""
        return self.offset_s + (1.0 + self.drift) * true_time_s

    def to_true_time(self, time_s: Array) -> Array:
        """Convert clock times to true times, seconds."""
        return (time_s - self.offset_s) / (1.0 + self.drift)


@dataclass(frozen=True, slots=True)
class RobotLog:
    """Measurements of one robot, (N,) each, on its own clock, 100 Hz. NaN where missing.

    Parameters
    ----------
    time_s
        Clock of the robot.
    roll_rad, pitch_rad
        Attitude Rz(yaw) Ry(pitch) Rx(roll), z up: pitch positive nose down.
    yaw_rate_radps
        Positive to the left.
    vx_mps, vy_mps
        Velocity in the robot's horizontal frame: x forward, y left, turning with its yaw.
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
    """Ground truth of one robot, world frame (z up), true time, 100 Hz.

    Parameters
    ----------
    time_s
        (N,) true time.
    position
        (N, 3) metres.
    velocity
        (N, 3) metres per second.
    yaw, roll, pitch
        (N,) radians. Yaw is not wrapped.
    """

    time_s: Array
    position: Array
    velocity: Array
    yaw: Array
    roll: Array
    pitch: Array

    def position_at(self, time_s: Array) -> Array:
        """Return (M, 3) positions at true times, metres, linear between samples."""
        place_m = np.empty((len(time_s), 3))  # np.stack would take as long as the rest
        for k, axis in enumerate(self.position.T):
            place_m[:, k] = np.interp(time_s, self.time_s, axis)
        return place_m

    def yaw_at(self, time_s: Array) -> Array:
        """Return (M,) yaws at true times, radians, linear between samples."""
        return np.interp(time_s, self.time_s, self.yaw)


@dataclass(frozen=True, slots=True)
class Ranges:
    """UWB distances from one robot to another.

    Parameters
    ----------
    time_s
        (M,) clock of the robot that ranges.
    range_m
        (M,) measured distances, with bias.
    """

    time_s: Array
    range_m: Array


@dataclass(frozen=True, slots=True)
class Flight:
    """A simulated flight: logs, ranges and ground truth.

    Parameters
    ----------
    robots
        Log of each robot.
    truth
        Ground truth of each robot.
    ranges
        By (robot that ranges, robot that answers), both directions of each pair.
    clocks
        Clock of each robot.
    faults
        Faults with their times.
    """

    robots: dict[str, RobotLog]
    truth: dict[str, Truth]
    ranges: dict[tuple[str, str], Ranges]
    clocks: dict[str, Clock]
    faults: tuple[FaultEvent, ...] = ()

    def peer_in_horizontal(self, i: str, j: str, time_s: Array) -> Array:
        """Return (N, 3) positions of robot ``j`` in ``i``'s horizontal frame, metres.

        Parameters
        ----------
        i, j
            Names of the observer and of its peer.
        time_s
            (N,) true times, seconds.
        """
        here, peer = self.truth[i], self.truth[j]
        away = peer.position_at(time_s) - here.position_at(time_s)
        c, s = np.cos(here.yaw_at(time_s)), np.sin(here.yaw_at(time_s))
        x, y, z = away.T
        return np.stack([c * x + s * y, c * y - s * x, z], axis=1)
