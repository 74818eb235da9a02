"""Estimate constant sensor errors from many flights: solve each, then pool all."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.errors import RecordingError
from dmrl.estimation.flight.pairs import estimate_pairs
from dmrl.estimation.flight.random_effects import PooledConstants, flight_information, pool_flights
from dmrl.estimation.solver.estimate import REASONS, Estimate
from dmrl.estimation.solver.layout import Subject
from dmrl.estimation.solver.unknowns import TABLE, Unknown
from dmrl.labelling.flight_log import SENSOR_TOPICS, read_flight
from dmrl.labelling.sensor_file import OF_PAIR, OF_ROBOT, Names, SensorConstants, Value
from dmrl.labelling.sensor_logs import build_sensor_logs

Ints = NDArray[np.intp]
Owned = tuple[str | Names, str]
"""A robot or both of a pair, and the key of a constant."""

MIN_FLIGHTS = 2
"""Fewest flights of a pair. One flight cannot separate lasting errors from those of a day."""
MAX_STD_SHARE, MIN_SIGMAS = 0.8, 2.0
"""A constant is kept if its std is below this share of the usual one, or its mean is more than so
many of its own standard deviations from zero."""
ROWS = {row.name: row for row in TABLE}
"""Rows of the unknowns by name."""
CLOCK_OFF = "clock_s"
"""Reported with the others, but not kept: clock offsets differ in every flight."""
UNUSABLE = {REASONS[reason] for reason in ("still", "alike", "silent", "open")}
"""Reasons of refusal after which a flight has no bearing, or perhaps a mirrored one."""


@dataclass(frozen=True, slots=True)
class Constant:
    """One constant of a robot or a pair of robots.

    Parameters
    ----------
    of
        The robot, or both.
    name
        Its key in the file.
    mean, std
        Mean over flights, and standard deviation of the next one about it.
    flights
        Number of flights that it was solved in.
    kept
        Whether it improves the start of a flight.
    """

    of: str | Names
    name: str
    mean: float
    std: float
    flights: int
    kept: bool


@dataclass(frozen=True, slots=True)
class SensorCalibration:
    """The kept constants, and every constant that was estimated."""

    sensors: SensorConstants
    constants: list[Constant]


def pool_sensor_constants(
    sources: Sequence[Path], solved: Iterator[dict[Names, Estimate]]
) -> SensorCalibration:
    """Return the constants that flights of the same robots have in common.

    Parameters
    ----------
    sources
        The recordings, for errors.
    solved
        The estimates of each, by `solve_flight`.

    Raises
    ------
    RecordingError
        If fewer than two flights of a pair can be used, or no constant is kept: a file without
        a constant would change no label.
    """
    found = [one for flight in solved for one in flight.items()]
    usable = [
        (names, one)
        for names, one in found
        if not any(cause.name in UNUSABLE for cause in one.causes)
    ]
    counts = {names: sum(n == names for n, _ in usable) for names, _ in usable}
    twice = [(names, one) for names, one in usable if counts[names] >= MIN_FLIGHTS]
    if not twice:
        raise RecordingError(
            f"{sources[0]}: {len(sources)} recordings, and no pair of robots has "
            f"{MIN_FLIGHTS} flights that tell where both were. Give more flights of the same "
            "robots; dmrl label says what is wrong with each"
        )
    place = {owned: name for names, _ in twice for owned, (name, _) in _subjects(names).items()}
    number = {owned: k for k, owned in enumerate(place)}
    flights = []
    for names, one in twice:
        mine = _subjects(names)
        column = np.array([number[owned] for owned in mine], np.intp)
        flights.append(flight_information(one, list(mine.values()), column))
    rows = [ROWS[name] for name in place.values()]
    out = _select_constants(list(place), pool_flights(flights, rows), rows)
    if not out.sensors.names:
        raise RecordingError(
            f"{sources[0]}: {len(sources)} recordings determine no sensor constant better than "
            "its prior. Give more flights, or longer ones"
        )
    return out


def solve_flight(source: Path) -> dict[Names, Estimate]:
    """Solve the pairs of a flight, in the order of their names, by the batch method.

    Raises
    ------
    RecordingError
        If the recording cannot be read.
    """
    pairs = build_sensor_logs(read_flight(source, *SENSOR_TOPICS)).pairs
    found = estimate_pairs(list(pairs.values()), plain=True)
    return dict(zip(pairs, (here for here, _ in found), strict=True))


def _subjects(names: Names) -> dict[Owned, Subject]:
    """Return the unknowns of a pair by the owner and key of each."""
    out: dict[Owned, Subject] = {(names, key): (name, (0, 1)) for key, name in OF_PAIR.items()}
    for side, robot in enumerate(names):
        out |= {(robot, key): (name, (side,)) for key, name in OF_ROBOT.items()}
    return {(names, CLOCK_OFF): ("clock", (1,)), **out}


def _select_constants(
    subjects: Sequence[Owned], found: PooledConstants, rows: Sequence[Unknown]
) -> SensorCalibration:
    usual = np.array([row.std for row in rows])
    better = (found.std < MAX_STD_SHARE * usual) | (np.abs(found.mean) > MIN_SIGMAS * found.std)
    columns = (found.mean, found.std, found.flights, better)
    constants = [
        Constant(of, name, float(mean), float(std), int(flights), bool(kept) and name != CLOCK_OFF)
        for (of, name), mean, std, flights, kept in zip(subjects, *columns, strict=True)
    ]
    robots: dict[str, dict[str, Value]] = {}
    pairs: dict[Names, dict[str, Value]] = {}
    for one in (one for one in constants if one.kept):
        if isinstance(one.of, str):
            robots.setdefault(one.of, {})[one.name] = one.mean, one.std
        else:
            pairs.setdefault(one.of, {})[one.name] = one.mean, one.std
    return SensorCalibration(SensorConstants(robots, pairs), constants)
