"""Faults of a flight and their times, in true time, seconds from the start of the flight."""

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
DEFAULT_SIZES: dict[FaultKind, float] = {
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
"""Default sizes. Unit by kind: metres, rad/s, seconds; a share of the ranges for outliers; a
share of the velocity for its scale; ppm for drift. A crash has the speed in m/s that the robot's
velocity estimate diverges to. Other kinds have no size."""
DEFAULT_DURATIONS_S: dict[FaultKind, float] = {
    "nlos": 3.0,
    "range_gap": 30.0,
    "height_step": 2.0,
    "height_gap": 5.0,
    "velocity_stuck": 10.0,
    "velocity_gap": 5.0,
    "attitude_gap": 5.0,
}
"""Default durations. Other kinds last for the whole flight."""
LINK_KINDS = ("nlos", "range_offset", "range_outliers", "range_gap")
"""Kinds that affect the ranges between two robots, in both directions."""
CLOCK_KINDS = ("clock_drift", "clock_offset")
END_KINDS = ("landing", "crash")
"""Kinds after which a robot lies on the floor."""

DEFAULT_END_S = 10.0
"""Default time from a landing or crash to the end of the flight, seconds."""


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault that happens once or several times.

    Parameters
    ----------
    kind
        Kind of the fault, see the table in docs/flights.md.
    robot
        Affected robot.
    peer
        For faults of ranges: the other robot. Empty: all links of the robot.
    start_s
        Start. Default: random; 10 s before the end for a landing or a crash.
    duration_s
        Duration of each occurrence. Default: that of the kind.
    size
        Size in the unit of the kind. Default: that of the kind.
    number
        Number of occurrences at random times, spread over the flight.

    Raises
    ------
    ValueError
        If the parameters contradict each other.
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
            (self.peer and self.kind not in LINK_KINDS, "has no peer"),
            (self.size is not None and self.kind not in DEFAULT_SIZES, "has no size"),
            (not np.isfinite(self.size or 0.0), "needs a finite size"),
            (self.kind == "range_outliers" and not 0 < self.amount <= 1, "needs a size in (0, 1]"),
            (self.start_s is not None and not self.start_s >= 0, "cannot start before 0 s"),
            (self.duration_s is not None and not self.duration_s > 0, "must last over 0 s"),
            (self.number < 1, "must happen once or more"),
            (self.number > 1 and self.start_s is not None, "has a start_s or a number, not both"),
            (self.number > 1 and self.lasts_s is None, "happens several times: give duration_s"),
            (
                self.kind in END_KINDS and self.duration_s is not None,
                "lasts to the end: no duration_s",
            ),
            (self.kind in CLOCK_KINDS and self._timed, "lasts for the whole flight"),
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
        """Size, or the default of the kind."""
        return self.size if self.size is not None else DEFAULT_SIZES.get(self.kind, 0.0)

    @property
    def lasts_s(self) -> float | None:
        """Duration of each occurrence, or None to last until the end."""
        return (
            self.duration_s if self.duration_s is not None else DEFAULT_DURATIONS_S.get(self.kind)
        )


@dataclass(frozen=True, slots=True)
class FaultEvent:
    """A fault with its times.

    Parameters
    ----------
    fault
        The fault.
    windows_s
        (W, 2) starts and ends, true time, seconds.
    """

    fault: Fault
    windows_s: Array

    def is_active(self, true_time_s: Array) -> Mask:
        """Return (N,) whether the fault is active at these times."""
        start, end = self.windows_s.T[..., None]
        return np.asarray(((true_time_s >= start) & (true_time_s < end)).any(axis=0))

    def affects_link(self, link: tuple[str, str]) -> bool:
        """Return whether the fault affects the ranges between two robots, in either direction."""
        fault = self.fault
        return fault.kind in LINK_KINDS and fault.robot in link and fault.peer in ("", *link)


def check_faults(faults: Sequence[Fault], names: Sequence[str], flight_s: float) -> None:
    """Raise SettingError unless all faults fit the flight.

    Parameters
    ----------
    faults
        Faults of the flight.
    names
        Names of the robots.
    flight_s
        Length of the flight, seconds.

    Raises
    ------
    SettingError
        If a fault names an unknown robot or does not fit into the flight.
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


def schedule_fault(rng: Generator, fault: Fault, flight_s: float) -> FaultEvent:
    """Schedule a fault: at its start, or once at random in each equal part of the flight."""
    lasts_s = fault.lasts_s
    if fault.kind in END_KINDS:
        start = max(flight_s - DEFAULT_END_S, 0.0) if fault.start_s is None else fault.start_s
        starts, lasts_s = np.array([start]), np.inf
    elif fault.start_s is not None or lasts_s is None:
        starts, lasts_s = np.array([fault.start_s or 0.0]), lasts_s or np.inf
    else:
        part_s = flight_s / fault.number
        starts = part_s * np.arange(fault.number)
        starts += rng.uniform(0.0, part_s - lasts_s, fault.number)
    # The last sample of a flight belongs to a fault that lasts to the end.
    ends = np.where(starts + lasts_s >= flight_s, np.inf, starts + lasts_s)
    return FaultEvent(fault, np.stack([starts, ends], axis=1))
