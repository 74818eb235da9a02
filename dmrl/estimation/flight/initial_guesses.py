"""Where the solve of a flight may start: what the smoother makes of likely guesses."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dmrl.estimation.filters import keyframe_ekf
from dmrl.estimation.filters.camera_update import glances_of, repeated
from dmrl.estimation.flight.hypotheses import KEPT, START_STD, candidates
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.keyframes import KEY_HZ, Noise, Problem

SHORT_M, LIKELIER = 0.4, 10.0
"""Ranges that much too short are tried, and believed if the flight is that much likelier, a
logarithm: where it is no question of passes, likelihoods differ by a few."""
NEAR_SHARE, NEAR_M = 0.05, 0.6
"""Nothing is tried unless so many of the ranges are so short."""


@dataclass(frozen=True, slots=True)
class Starts:
    """Starts of a flight of K keyframes.

    Parameters
    ----------
    score
        (KEPT,) log likelihoods.
    tracks
        (K, KEPT, 5) x, y (m), psi (rad), biases of the yaw rates (rad/s).
    covariances
        (K, KEPT, 5, 5) of these.
    offset_m
        By how much ranges are too long in them.
    """

    score: Array
    tracks: Array
    covariances: Array
    offset_m: float = 0.0


def likely_starts(problems: Sequence[Problem], noise: Noise) -> list[Starts]:
    """Likely starts of each flight.

    Ranges that are too short by decimetres bring robots that pass each other seemingly to one
    place, where a way round the observer fits as well as one past it. No solve comes back from
    that. Filters tell: with longer ranges the flight is far likelier.

    Parameters
    ----------
    problems
        Any number of flights.
    noise
        What is believed about their sensors.
    """
    found = _starts(problems, noise)
    near = [n for n, flight in enumerate(problems) if _near(flight)]
    longer = [replace(problems[n], range_m=problems[n].range_m + SHORT_M) for n in near]
    for number, tried in zip(near, _starts(longer, noise), strict=True):
        if tried.score.max() > found[number].score.max() + LIKELIER:
            found[number] = replace(tried, offset_m=-SHORT_M)
    return found


def _near(flight: Problem) -> bool:
    """Whether the robots seem to have come close."""
    short = len(flight.range_m) > 0 and np.quantile(flight.range_m, NEAR_SHARE) < NEAR_M
    return bool(short)


def _starts(problems: Sequence[Problem], noise: Noise) -> list[Starts]:
    """Likely starts of each flight. Flights of equal length are smoothed side by side."""
    found: dict[int, Starts] = {}
    lengths = np.array([len(p.key_s) for p in problems], int)
    for length in np.unique(lengths):
        numbers = np.flatnonzero(lengths == length).tolist()
        scores, states, covariances = _smoothed([problems[n] for n in numbers], noise)
        for column, number in enumerate(numbers):
            mine = slice(column * KEPT, (column + 1) * KEPT)
            found[number] = Starts(scores[mine], states[:, mine], covariances[:, mine])
    return [found[number] for number in range(len(problems))]


def _smoothed(problems: list[Problem], noise: Noise) -> tuple[Array, Array, Array]:
    """Scores (P KEPT,), states and covariances (K, P KEPT, ...) of P flights of one length."""
    inputs = keyframe_ekf.inputs_of(problems, noise)
    glances = glances_of([flight.looks for flight in problems])
    start = candidates(inputs, KEY_HZ, glances).reshape(-1, 3)
    count = len(problems[0].key_s)
    given = inputs.repeated(KEPT, count), start, START_STD
    filtered = keyframe_ekf.run(*given, repeated(glances, KEPT))
    return filtered.log_likelihood, *keyframe_ekf.smoothed(filtered)
