"""Where a flight's solve may end: from every likely start, and past what it sticks at."""

from collections.abc import Sequence

import numpy as np

from dmrl.estimation.flight.hypotheses import BESIDE, mirrored, passed_by
from dmrl.estimation.flight.initial_guesses import Starts
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.keyframes import GLOBALS, KEY_HZ, Noise, Problem
from dmrl.estimation.solver.levenberg_marquardt import ROUGH, Solution, near, solve_batch
from dmrl.estimation.solver.residuals import BIAS, OWN_GYRO, PEER_GYRO, RANGE_ERROR, SIZE

HOPELESS = 100.0
"""Smoothed starts whose log likelihood is this far below the best's are not solved."""
BESIDE_PIECES = 2
"""So many starts of a flight are solved beside what its stretches led to."""
STUCK, AGAIN = 200.0, 4
"""Solutions that cost at most so much more than the best, and so many, are solved afresh: the true
one was seen to stick 130 above a wrong one."""
CHEAPER = 0.5
"""A solution that costs so much less is another one, and its passes are tried again."""


def solutions(
    flight: Problem, noise: Noise, starts: Starts, pieced: Sequence[Array]
) -> list[Solution]:
    """What likely starts lead to, best first.

    Even starts that look alike half-way may pass the peer on different sides: all are solved that
    are not hopeless, each until it comes to a solution that another one led to.

    Parameters
    ----------
    flight, noise
        The flight, and what is believed about its sensors.
    starts
        Of this flight.
    pieced
        (K, 6) states each, joined of what stretches of the flight led to.
    """
    begun: list[Array] = []
    found = [solve_batch(flight, noise, start, tolerance=ROUGH) for start in pieced]
    score = starts.score
    for number in np.argsort(-score)[: BESIDE_PIECES if pieced else None]:
        start = starts.tracks[:, number]
        if score[number] > score.max() - HOPELESS and not any(near(start, s) for s in begun):
            begun.append(start)
            first = _start(flight, start, starts.offset_m)
            found.append(solve_batch(flight, noise, *first, found, ROUGH))
    found += [
        solve_batch(flight, noise, _afresh(flight, s.state), known=found, tolerance=ROUGH)
        for s in distinct(found, STUCK)[: 1 if pieced else AGAIN]
    ]
    best = min(found, key=lambda s: s.cost)
    for start in mirrored(best.state, KEY_HZ):
        found.append(solve_batch(flight, noise, start, known=found, tolerance=ROUGH))
    return sorted(_passed_by(flight, noise, found), key=lambda s: s.cost)


def distinct(found: Sequence[Solution], within: float) -> list[Solution]:
    """Solutions that differ, best first, whose costs are at most so far above the best's.

    Parameters
    ----------
    found
        Solutions of one flight.
    within
        How far.
    """
    ordered = sorted(found, key=lambda s: s.cost)
    out: list[Solution] = []
    for one in ordered:
        close = one.cost <= ordered[0].cost + within
        if close and not any(near(one.state, other.state) for other in out):
            out.append(one)
    return out


def _passed_by(flight: Problem, noise: Noise, found: list[Solution]) -> list[Solution]:
    """Solutions, and what the best leads to with the peer past the observer on the other side."""
    found, best, tried = [*found], None, 0
    while best is None or min(s.cost for s in found) < best.cost - CHEAPER:
        best = min(found, key=lambda s: s.cost)
        for start in passed_by(best.state, KEY_HZ)[: BESIDE - tried]:
            tried += 1
            found.append(solve_batch(flight, noise, start, best.constants, found, ROUGH))
            if found[-1].cost < best.cost - CHEAPER:
                break
    return found


def _afresh(flight: Problem, state: Array) -> Array:
    """States (K, 6) with the ranges' errors of the first guess.

    Solved again from there, with constants of zero, what stuck on its way may come free, and what
    is worse now may be the best then.
    """
    out = state.copy()
    out[:, RANGE_ERROR] = 0.0
    out[flight.range_key, RANGE_ERROR] = flight.range_level_m
    return out


def _start(flight: Problem, track: Array, offset_m: float) -> tuple[Array, Array]:
    """States (K, 6) and globals (G,) that a smoothed track (K, 5) says, with jumped ranges."""
    state, constants = np.zeros((len(track), SIZE)), np.zeros(len(GLOBALS))
    state[:, :3] = track[:, :3]
    state[flight.range_key, RANGE_ERROR] = flight.range_level_m
    constants[[BIAS, OWN_GYRO, PEER_GYRO]] = offset_m, *track[-1, 3:]
    return state, constants
