"""What flights of the same robots agree on of their sensors: each is solved, and all are pooled."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.errors import RecordingError
from dmrl.estimation.flight.pairs import estimate_pairs
from dmrl.estimation.flight.random_effects import Pooled, pooled, told
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.estimate import Estimate
from dmrl.estimation.solver.keyframes import GLOBALS, Noise
from dmrl.estimation.solver.residuals import CLOCK
from dmrl.labelling.sensor_file import OF_PAIR, OF_ROBOT, Names, Sensors, Value
from dmrl.labelling.sensor_logs import SENSED, read_logs
from dmrl.recording import Contents

Ints = NDArray[np.intp]
Subject = tuple[str | Names, str]
"""A robot or both of a pair, and the name of a constant."""

LEAST_FLIGHTS = 2
"""One flight alone can't tell what stays from what was so that day."""
WORTH, OFF = 0.8, 2.0
"""What is kept is known better than this, against what is usual, or off by so many of its own
standard deviations."""
CLOCK_OFF = "clock_s"
"""Solved for with the others and told, but not kept: clocks are another every time."""
BLIND = ("still", "alike", "silent", "open")
"""Flights that tell no bearing, or may have been solved the wrong way round."""


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
        In how many it was solved for.
    kept
        Whether a flight that starts from it starts better.
    """

    of: str | Names
    name: str
    mean: float
    std: float
    flights: int
    kept: bool


@dataclass(frozen=True, slots=True)
class Agreed:
    """What is known, and every constant that was asked for."""

    sensors: Sensors
    constants: list[Constant]


def agreed(sources: Sequence[Path], solved: Iterator[dict[Names, Estimate]]) -> Agreed:
    """What flights agree on.

    Parameters
    ----------
    sources
        The recordings, for errors.
    solved
        Of each, its pairs as `solutions` finds them.

    Raises
    ------
    RecordingError
        If fewer than two flights of a pair tell where its robots were, or nothing is worth
        keeping: a file without a constant would change no label.
    """
    found = [one for flight in solved for one in flight.items()]
    usable = [(names, one) for names, one in found if one.refused not in BLIND]
    counts = {names: sum(n == names for n, _ in usable) for names, _ in usable}
    twice = [(names, one) for names, one in usable if counts[names] >= LEAST_FLIGHTS]
    if not twice:
        raise RecordingError(
            f"{sources[0]}: {len(sources)} recordings, and no pair of robots has "
            f"{LEAST_FLIGHTS} flights that tell where both were. Give more flights of the same "
            "robots; dmrl label says what is wrong with each"
        )
    place = {subject: place for names, _ in twice for subject, place in _places(names).items()}
    number = {subject: k for k, subject in enumerate(place)}
    flights = [told(one, _column(names, number)) for names, one in twice]
    kinds = np.array(list(place.values()))
    out = _agreed(list(place), pooled(flights, kinds), Noise().prior_std()[kinds])
    if not out.sensors.names:
        raise RecordingError(
            f"{sources[0]}: {len(sources)} recordings agree on nothing of their sensors that is "
            "known better than of any others. Give more flights, or longer ones"
        )
    return out


def solutions(source: Path) -> dict[Names, Estimate]:
    """The pairs of a flight, in the order of their names, by the batch solve.

    Raises
    ------
    RecordingError
        If the recording cannot be read.
    """
    pairs = read_logs(Contents(source, *SENSED)).pairs
    return dict(zip(pairs, (here for here, _ in estimate_pairs(list(pairs.values()))), strict=True))


def _places(names: Names) -> dict[Subject, int]:
    """Every constant of a pair, and its place among ``GLOBALS``."""
    shared: dict[Subject, int] = {(names, key): place for key, place in OF_PAIR.items()}
    for side, robot in enumerate(names):
        shared |= {(robot, key): places[side] for key, places in OF_ROBOT.items()}
    return {(names, CLOCK_OFF): CLOCK, **shared}


def _column(names: Names, number: Mapping[Subject, int]) -> Ints:
    """(G,) the numbers of a pair's constants, in the order of ``GLOBALS``."""
    out = np.zeros(len(GLOBALS), np.intp)
    for subject, place in _places(names).items():
        out[place] = number[subject]
    return out


def _agreed(subjects: Sequence[Subject], found: Pooled, usual: Array) -> Agreed:
    better = (found.std < WORTH * usual) | (np.abs(found.mean) > OFF * found.std)
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
    return Agreed(Sensors(robots, pairs), constants)
