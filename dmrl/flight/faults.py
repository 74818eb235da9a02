"""What goes wrong in a flight, and when. Times are true time, seconds from the flight's start."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dmrl.errors import SettingError
from dmrl.geometry.frames import Array

Mask = NDArray[np.bool_]
FaultKind = Literal[
    "nlos",
    "range_offset",
    "range_outliers",
    "range_gap",
    "yaw_rate_bias",
    "height_step",
    "height_gap",
    "velocity_stuck",
    "velocity_scale",
    "velocity_gap",
    "attitude_gap",
    "clock_drift",
    "clock_offset",
    "landing",
    "crash",
]
SIZES: dict[FaultKind, float] = {
    "nlos": 1.0,
    "range_offset": 0.35,
    "range_outliers": 0.25,
    "yaw_rate_bias": 0.05,
    "height_step": -0.35,
    "velocity_scale": 0.15,
    "clock_drift": 100.0,
    "clock_offset": 0.05,
    "crash": 9.0,
}
"""Size where none is given: metres, rad/s, seconds; outliers a share of the ranges, scale one of
the velocity, drift in ppm, a crash the speed in m/s that the robot's estimate runs away to. Other
kinds have none."""
WINDOWS_S: dict[FaultKind, float] = {
    "nlos": 3.0,
    "range_gap": 30.0,
    "height_step": 2.0,
    "height_gap": 5.0,
    "velocity_stuck": 10.0,
    "velocity_gap": 5.0,
    "attitude_gap": 5.0,
}
"""How long each lasts where nothing is said; other kinds last for the whole flight."""
LINKS = ("nlos", "range_offset", "range_outliers", "range_gap")
"""Kinds that befall the ranges between two robots, both ways."""
CLOCKS = ("clock_drift", "clock_offset")
ENDS = ("landing", "crash")
"""Kinds after which a robot lies on the floor."""

END_S = 10.0
"""Before the end of a flight a robot lands or crashes, where nothing is said."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that goes wrong, once or several times.

    Parameters
    ----------
    kind
        What; docs/flights.md has the table.
    robot
        Whom it befalls.
    peer
        Faults of ranges: the other end. Empty: every link of the robot.
    start_s
        When it begins. Without it, drawn; a landing or a crash comes 10 s before the end.
    duration_s
        How long it lasts each time. Without it, as long as is usual for the kind.
    size
        How large it is, in the unit of its kind. Without it, a usual size.
    number
        How many times, spread over the flight, at times that are drawn.

    Raises
    ------
    ValueError
        If these do not go together.
    """

    kind: FaultKind
    robot: str
    peer: str = ""
    start_s: float | None = None
    duration_s: float | None = None
    size: float | None = None
    number: int = 1

    def __post_init__(self) -> None:
        for wrong, why in (
            (self.peer and self.kind not in LINKS, "has no peer"),
            (self.size is not None and self.kind not in SIZES, "has no size"),
            (not np.isfinite(self.size or 0.0), "needs a finite size"),
            (self.kind == "range_outliers" and not 0 < self.amount <= 1, "needs a size in (0, 1]"),
            (self.start_s is not None and not self.start_s >= 0, "cannot start before 0 s"),
            (self.duration_s is not None and not self.duration_s > 0, "must last over 0 s"),
            (self.number < 1, "must happen once or more"),
            (self.number > 1 and self.start_s is not None, "has a start_s or a number, not both"),
            (self.number > 1 and self.lasts_s is None, "happens several times: give duration_s"),
            (self.kind in ENDS and self.duration_s is not None, "lasts to the end: no duration_s"),
            (self.kind in CLOCKS and self._timed, "lasts for the whole flight"),
        ):
            if wrong:
                raise ValueError(f"{self} {why}")

    def __str__(self) -> str:
        return f"{self.kind} of {'-'.join(filter(None, (self.robot, self.peer)))}"

    @property
    def _timed(self) -> bool:
        return self.start_s is not None or self.duration_s is not None or self.number > 1

    @property
    def amount(self) -> float:
        """Its size, or the usual one."""
        return self.size if self.size is not None else SIZES.get(self.kind, 0.0)

    @property
    def lasts_s(self) -> float | None:
        """How long it lasts each time; None: to the end."""
        return self.duration_s if self.duration_s is not None else WINDOWS_S.get(self.kind)


@dataclass(frozen=True, slots=True)
class Happened:
    """A fault and when it happened.

    Parameters
    ----------
    fault
        What.
    windows_s
        (W, 2) starts and ends, true time, seconds.
    """

    fault: Fault
    windows_s: Array

    def during(self, true_time_s: Array) -> Mask:
        """(N,) whether it goes on at these times."""
        start, end = self.windows_s.T[..., None]
        return np.asarray(((true_time_s >= start) & (true_time_s < end)).any(axis=0))

    def befalls(self, link: tuple[str, str]) -> bool:
        """Whether it is one of the ranges between these two, whichever of them ranges."""
        fault = self.fault
        return fault.kind in LINKS and fault.robot in link and fault.peer in ("", *link)


def check(faults: Sequence[Fault], names: Sequence[str], flight_s: float) -> None:
    """Refuse what cannot befall a flight.

    Parameters
    ----------
    faults
        What shall go wrong.
    names
        The robots.
    flight_s
        Length of the flight.

    Raises
    ------
    SettingError
        If a robot is none of the flight's, or a fault does not fit into it.
    """
    for fault in faults:
        for name in (fault.robot, *([fault.peer] if fault.peer else [])):
            if name not in names:
                raise SettingError(f"{fault.kind} of {name!r}: choose one of {', '.join(names)}")
        if fault.peer == fault.robot:
            raise SettingError(f"{fault}: its peer is another robot")
        if fault.start_s is not None and fault.start_s >= flight_s:
            raise SettingError(
                f"{fault}: start_s {fault.start_s:g} is after the end, "
                f"{flight_s:g} s. Start it earlier"
            )
        if fault.start_s is None and (fault.lasts_s or 0.0) * fault.number > flight_s:
            raise SettingError(
                f"{fault}: {fault.number} times {fault.lasts_s:g} s do not "
                f"fit into {flight_s:g} s. Make them fewer or shorter"
            )


def happened(rng: Generator, fault: Fault, flight_s: float) -> Happened:
    """When a fault happens: its start, or one drawn in each of as many parts of the flight."""
    lasts_s = fault.lasts_s
    if fault.kind in ENDS:
        start = max(flight_s - END_S, 0.0) if fault.start_s is None else fault.start_s
        starts, lasts_s = np.array([start]), np.inf
    elif fault.start_s is not None or lasts_s is None:
        starts, lasts_s = np.array([fault.start_s or 0.0]), lasts_s or np.inf
    else:
        part_s = flight_s / fault.number
        starts = part_s * np.arange(fault.number)
        starts += rng.uniform(0.0, part_s - lasts_s, fault.number)
    # The last sample of a flight belongs to a fault that lasts to the end.
    ends = np.where(starts + lasts_s >= flight_s, np.inf, starts + lasts_s)
    return Happened(fault, np.stack([starts, ends], axis=1))
