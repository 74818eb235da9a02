"""A recorded or simulated flight as the log variables of a Crazyflie."""

import math
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from dmrl.geometry.frames import Array
from dmrl.live.log_blocks import parse_robot_number

Signal = tuple[Array, Array]
"""Times (N,), seconds since take-off, and values (N,)."""

ROUNDING_S = 1e-6
"""Largest rounding error of a time. A block that is due with a new value must not miss it."""
BATTERY_FULL_V, BATTERY_EMPTY_V, BATTERY_S = 4.15, 3.3, 420.0


@dataclass(frozen=True, slots=True)
class SimulatedVariable:
    """One log variable: its type in cflib's names, and its values over the flight."""

    kind: str
    signal: Signal

    def value_at(self, time_s: float) -> float:
        """Return the last value before a time."""
        times, values = self.signal
        at = int(np.searchsorted(times, time_s + ROUNDING_S, side="right"))
        return float(values[max(at - 1, 0)])


@dataclass(frozen=True, slots=True)
class SimulatedFlight:
    """Measurements of one robot.

    Parameters
    ----------
    attitude
        (N,), (N, 4): roll, pitch, yaw (rad), yaw rate (rad/s), as in dmrl.v1.Attitude.
    velocity
        (N,), (N, 2): forward, left (m/s).
    height
        (N,), (N,): metres.
    ranges
        Distances to each peer, (N,), (N,), metres.
    """

    attitude: tuple[Array, Array]
    velocity: tuple[Array, Array]
    height: Signal
    ranges: Mapping[str, Signal]

    @property
    def end_s(self) -> float:
        """Time of landing."""
        return float(self.attitude[0][-1])

    def build_variables(self) -> dict[str, SimulatedVariable]:
        """Return the log variables, with the units and signs of the Crazyflie's firmware."""
        time_s, (roll, pitch, yaw, yaw_rate) = self.attitude[0], self.attitude[1].T
        vx, vy = (np.interp(time_s, self.velocity[0], part) for part in self.velocity[1].T)
        roll_rate, pitch_rate = np.gradient(roll, time_s), np.gradient(pitch, time_s)
        body = (
            roll_rate - np.sin(pitch) * yaw_rate,
            np.cos(roll) * pitch_rate + np.sin(roll) * np.cos(pitch) * yaw_rate,
            np.cos(roll) * np.cos(pitch) * yaw_rate - np.sin(roll) * pitch_rate,
        )
        floats = {
            "stateEstimate.vx": np.cos(yaw) * vx - np.sin(yaw) * vy,
            "stateEstimate.vy": np.sin(yaw) * vx + np.cos(yaw) * vy,
            "stateEstimate.roll": np.degrees(roll),
            "stateEstimate.pitch": -np.degrees(pitch),
            "stateEstimate.yaw": np.degrees((yaw + np.pi) % (2 * np.pi) - np.pi),
        }
        floats |= {f"gyro.{axis}": np.degrees(rate) for axis, rate in zip("xyz", body, strict=True)}
        known = {
            name: SimulatedVariable("float", (time_s, values)) for name, values in floats.items()
        }
        known["stateEstimate.z"] = SimulatedVariable("float", self.height)
        millimetres = np.clip(np.rint(1000 * self.height[1]), 0, 65535)
        known["range.zrange"] = SimulatedVariable("uint16_t", (self.height[0], millimetres))
        for peer, (ranged_s, range_m) in self.ranges.items():
            # Before the first ranging, the firmware's variable is 0.
            distance = np.concatenate([[-math.inf], ranged_s]), np.concatenate([[0.0], range_m])
            name = f"ranging.distance{parse_robot_number(peer)}"
            known[name] = SimulatedVariable("float", distance)
        left_v = BATTERY_FULL_V - (BATTERY_FULL_V - BATTERY_EMPTY_V) * time_s / BATTERY_S
        known["pm.vbat"] = SimulatedVariable("float", (time_s, np.maximum(left_v, BATTERY_EMPTY_V)))
        return known


class FlightClock:
    """Clock of a flight that starts with the first client.

    Parameters
    ----------
    speed
        Seconds of the flight per second.
    end_s
        Time of landing, seconds since take-off.
    """

    def __init__(self, speed: float, end_s: float) -> None:
        self.speed, self.end_s = speed, end_s
        self._start_s: float | None = None
        self._lock = threading.Lock()

    def take_off(self) -> None:
        """Start the flight, unless it has started."""
        with self._lock:
            if self._start_s is None:
                self._start_s = time.monotonic()

    @property
    def flying(self) -> bool:
        """Whether the flight has started."""
        return self._start_s is not None

    @property
    def landed(self) -> bool:
        """Whether the flight is over."""
        return self.flying and self.now_s() >= self.end_s

    def now_s(self) -> float:
        """Return the seconds since take-off; 0 before."""
        if self._start_s is None:
            return 0.0
        return (time.monotonic() - self._start_s) * self.speed


@dataclass(frozen=True, slots=True)
class SimulatedFaults:
    """Simulated faults of a drone.

    Parameters
    ----------
    drop
        Share of log packets and images that are not sent.
    dead_s
        First and last second of the flight without a connection; the drone restarts afterwards.
    boot_ms
        Its clock at take-off.
    drift_ppm
        Rate error of its clock; positive: faster than true time.
    """

    drop: float = 0.0
    dead_s: tuple[float, float] = (math.inf, math.inf)
    boot_ms: float = 12_340.0
    drift_ppm: float = 0.0

    def is_dead(self, time_s: float) -> bool:
        """Return whether it is dead at a time of the flight."""
        return self.dead_s[0] <= time_s < self.dead_s[1]

    def clock_ms(self, time_s: float) -> float:
        """Return its clock at a time of the flight."""
        began_s = self.dead_s[1] if time_s >= self.dead_s[1] else 0.0
        return self.boot_ms + 1000 * (time_s - began_s) * (1 + 1e-6 * self.drift_ppm)

    def time_at_clock(self, clock_ms: float, time_s: float) -> float:
        """Return the time of the flight, near ``time_s``, at which its clock has this value."""
        return time_s + (clock_ms - self.clock_ms(time_s)) / 1000 / (1 + 1e-6 * self.drift_ppm)


FlightImages = Iterator[tuple[float, bytes]]
"""Times, seconds since take-off, and encoded images, in order."""
