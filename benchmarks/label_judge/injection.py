"""A row of the table of faults, and the functions from which faults are built.

Arguments of the lambdas of rows: v is the signal, t its times in seconds, g the logs, s the size of
the fault, r the random generator, and k the link of a range.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from dmrl.flight import Fault
from label_judge.flights import BOTH, Array, Logs

Injector = Callable[[Logs, float, np.random.Generator], None]
GYRO = r"yaw|gyro|heading|turn"
FLOW = r"flow|veloc|speed|odometry"
RANGE = r"rang|antenna|uwb|multipath|detour|reflect"
HEIGHT = r"height|altitude|floor"
CLOCK = r"clock|time|delay|late|early"
MOTION = r"land|crash|still|lies|diverg|runs away"


@dataclass(frozen=True)
class Row:
    """A fault, one row of the table.

    Parameters
    ----------
    name
        Name of the row.
    inject
        Function that changes the logs in place by a given size.
    size
        Size in the unit of the fault; 0 for faults without a size, such as a wrong sign.
    cause
        Regular expression that matches a correct name of the cause; empty for harmless changes.
    robot
        Robot with the wrong sensor, or "" if it is an error of the pair.
    motion
        A landing or a crash, which the simulator flies.
    """

    name: str
    inject: Injector
    size: float
    cause: str
    robot: str = ""
    motion: tuple[Fault, ...] = ()

    @property
    def shrunk(self) -> "Row":
        """Return the fault at a third of its size."""
        return replace(self, name=f"{self.name}, a third", size=self.size / 3)


def column(robot: str, *names: str) -> Callable[[Callable[..., Array]], Injector]:
    """Return a decorator for functions that map (value, time_s, logs, size, rng) to a value."""

    def wrap(change: Callable[..., Array]) -> Injector:
        def inject(logs: Logs, size: float, rng: np.random.Generator) -> None:
            log = logs.robots[robot]
            for name in names:
                log[name] = np.asarray(change(log[name], log["time_s"], logs, size, rng), float)

        return inject

    return wrap


def links(*pairs: tuple[str, str]) -> Callable[[Callable[..., Array]], Injector]:
    """Return a decorator for functions that map (range_m, time_s, logs, size, rng, link)."""

    def wrap(change: Callable[..., Array]) -> Injector:
        def inject(logs: Logs, size: float, rng: np.random.Generator) -> None:
            for link in pairs:
                time_s, range_m = logs.ranges[link]
                changed = change(range_m, time_s, logs, size, rng, link)
                logs.ranges[link] = np.stack([time_s, np.maximum(changed, 0.01)])

        return inject

    return wrap


def select_part(time_s: Array, logs: Logs, *parts: tuple[float, float]) -> Array:
    """Return (N,) 1 in these parts of the flight, given as shares of its length, else 0."""
    share = time_s / logs.end_s
    return np.any([(share >= a) & (share < b) for a, b in parts], axis=0).astype(float)


def ramp_up(time_s: Array, logs: Logs) -> Array:
    """Return an (N,) ramp from 0 to 1 over the flight."""
    return np.asarray(np.clip(time_s / logs.end_s, 0.0, 1.0))


def silence(at: Array) -> Array:
    """Return (N,) NaN where the mask is positive, else 0, to be added to a signal."""
    return np.where(at > 0, np.nan, 0.0)


def select_seconds(time_s: Array, logs: Logs, seconds: float, *centres: float) -> Array:
    """Return (N,) 1 in windows of so many seconds centred at these shares of the flight, else 0."""
    half = seconds / logs.end_s / 2
    return select_part(time_s, logs, *((c - half, c + half) for c in centres))


def hold(value: Array, held: Array) -> Array:
    """Replace held values by the last value before them."""
    index = np.where(held > 0, 0, np.arange(len(value)))
    return value[np.maximum.accumulate(index)]


def delay(value: Array, time_s: Array, delay_s: float) -> Array:
    """Return the signal delayed by some seconds."""
    return np.interp(time_s - delay_s, time_s, value)


def filter_low(value: Array, tau_s: float) -> Array:
    """Filter (N,) samples at 100 Hz with a first-order lag."""
    share, out = 1 - np.exp(-0.01 / tau_s), value.copy()
    for k in range(1, len(out)):
        out[k] = out[k - 1] + share * (value[k] - out[k - 1])
    return out


def find_bearing(logs: Logs, link: tuple[str, str], time_s: Array) -> Array:
    """Return (N,) true bearings of the answering robot of a link, radians."""
    place = logs.flight.peer_in_horizontal(*link, time_s)
    return np.arctan2(place[:, 1], place[:, 0])


def find_place(logs: Logs, robot: str, time_s: Array) -> Array:
    """Return (N, 3) true positions of a robot in the world frame, metres."""
    return logs.flight.truth[robot].position_at(time_s)


def draw_pulses(rng: np.random.Generator, count: int, number: int, size: float) -> Array:
    """Draw (N,) zeros with some pulses of one sample and random sign."""
    out = np.zeros(count)
    out[rng.choice(count, number, replace=False)] = size * rng.choice([-1.0, 1.0], number)
    return out


OWN, PEER = "cf1", "cf2"
YAW, VX, VY, H = "yaw_rate_radps", "vx_mps", "vy_mps", "height_m"


def yaw(robot: str, change: Callable[..., Array]) -> Injector:
    """Return an injector that changes the yaw rate of a robot."""
    return column(robot, YAW)(change)


def flow(robot: str, change: Callable[..., Array], *names: str) -> Injector:
    """Return an injector that changes both velocities of a robot, or the named ones."""
    return column(robot, *(names or (VX, VY)))(change)


def height(robot: str, change: Callable[..., Array]) -> Injector:
    """Return an injector that changes the height of a robot."""
    return column(robot, H)(change)


def ranges(change: Callable[..., Array], *pairs: tuple[str, str]) -> Injector:
    """Return an injector that changes ranges, of both directions unless links are given."""
    return links(*(pairs or BOTH))(change)


def nothing(logs: Logs, size: float, rng: np.random.Generator) -> None:
    """Change nothing: for faults that the simulator flies."""


def both(*injectors: tuple[Injector, float]) -> Injector:
    """Return an injector of several faults with relative sizes."""

    def inject(logs: Logs, size: float, rng: np.random.Generator) -> None:
        for one, amount in injectors:
            one(logs, size * amount, rng)

    return inject
