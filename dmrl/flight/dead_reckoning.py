"""Dead reckoning of one robot from its own log, sample by sample."""

import numpy as np

from dmrl.flight.flight_arrays import RobotLog
from dmrl.geometry.frames import Array

HEIGHT_SAMPLES = 10
"""Number of samples before the present over which the height is averaged: 0.1 s."""
SENSORS = ("roll_rad", "pitch_rad", "yaw_rate_radps", "vx_mps", "vy_mps", "height_m")
"""Fields of a `RobotLog`."""


class DeadReckoning:
    """Path and heading of a robot, integrated by the trapezoid rule as its log grows.

    A sensor that is silent keeps its last value.

    Parameters
    ----------
    log
        The robot's log, filled up to the present.
    """

    def __init__(self, log: RobotLog) -> None:
        count = len(log.time_s)
        self._log = log
        self.yaw_rad = np.zeros(count)
        """(N,) heading relative to the start."""
        self.path_m = np.zeros((count, 3))
        """(N, 3) position over the start, along the heading at the start; z is the height."""
        self.sensors = np.zeros((len(SENSORS), count))
        """(6, N) values of `SENSORS`."""

    def extend(self, part: slice) -> None:
        """Integrate the samples of a part that follows the last one."""
        log = self._log
        fresh = np.stack([getattr(log, name)[part] for name in SENSORS])
        first = max(part.start - 1, 0)
        for row, held in zip(fresh, self.sensors[:, first], strict=True):
            if np.isnan(row).any():
                known = np.maximum.accumulate(np.where(np.isnan(row), -1, np.arange(len(row))))
                row[:] = np.where(known < 0, held, row[known])
        self.sensors[:, part] = fresh
        grown = slice(first, part.stop)
        dt_s = np.diff(log.time_s[grown])
        _, _, rate, vx, vy, height = self.sensors[:, grown]
        yaw = self.yaw_rad[first] + np.cumsum(dt_s * (rate[1:] + rate[:-1]) / 2)
        self.yaw_rad[first + 1 : part.stop] = yaw
        over_ground = np.exp(1j * self.yaw_rad[grown]) * (vx + 1j * vy)
        steps = dt_s * (over_ground[1:] + over_ground[:-1]) / 2
        place = complex(*self.path_m[first, :2]) + np.cumsum(steps)
        self.path_m[first + 1 : part.stop, 0] = place.real
        self.path_m[first + 1 : part.stop, 1] = place.imag
        self.path_m[grown, 2] = height

    def _mean_height(self, sample: int) -> float:
        """Return the mean height over the samples before; the noise of one looks like motion."""
        return float(self.path_m[max(sample - HEIGHT_SAMPLES, 0) : sample + 1, 2].mean())

    def motion(self, first: int, last: int) -> tuple[float, Array, float]:
        """Return seconds, the (3,) displacement in the frame of the first sample, and the turn."""
        c, s = np.cos(self.yaw_rad[first]), np.sin(self.yaw_rad[first])
        x, y, _ = self.path_m[last] - self.path_m[first]
        z = self._mean_height(last) - self._mean_height(first)
        dt_s = float(self._log.time_s[last] - self._log.time_s[first])
        turn_rad = float(self.yaw_rad[last] - self.yaw_rad[first])
        return dt_s, np.array([c * x + s * y, c * y - s * x, z]), turn_rad
