"""Multi-start solve of a flight: from every likely guess, and out of local minima."""

from collections.abc import Sequence

import numpy as np

from dmrl.estimation.flight.hypotheses import BESIDE, mirrored, passed_by
from dmrl.estimation.flight.initial_guesses import Starts
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.keyframes import GLOBALS, KEY_HZ, Noise, Problem
from dmrl.estimation.solver.levenberg_marquardt import ROUGH, Solution, near, solve_batch
from dmrl.estimation.solver.residuals import BIAS, OWN_GYRO, PEER_GYRO, RANGE_ERROR, SIZE

HOPELESS = 100.0
"""Guesses whose log likelihood is this far below the best are not solved. No record of how the
value was chosen."""
BESIDE_PIECES = 2
"""Number of guesses that are solved beside the joined segments of a flight. No record of how the
value was chosen."""
STUCK, AGAIN = 200.0, 4
"""Largest cost above the best, and largest number, of solutions that are solved again from zero
constants. A simulated flight had its true solution stuck 130 above a wrong one."""
CHEAPER = 0.5
"""Smallest cost reduction that makes a solution a new one, whose passes are flipped again. No
record of how the value was chosen."""


def solutions(
    flight: Problem, noise: Noise, starts: Starts, pieced: Sequence[Array]
) -> list[Solution]:
    """Find the solutions of a flight from its likely guesses, best first.

    Guesses that agree halfway may still pass the peer on different sides. So every guess that is
    not hopeless is solved, until it reaches a solution found before.

    Parameters
    ----------
    flight, noise
        Keyframes of the flight, and the noise model.
    starts
        Initial guesses of this flight.
    pieced
        (K, 6) states each, joined from solved segments of the flight.
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
    """Return the distinct solutions within a cost margin of the best, best first.

    Parameters
    ----------
    found
        Solutions of one flight.
    within
        The margin.
    """
    ordered = sorted(found, key=lambda s: s.cost)
    out: list[Solution] = []
    for one in ordered:
        close = one.cost <= ordered[0].cost + within
        if close and not any(near(one.state, other.state) for other in out):
            out.append(one)
    return out


def _passed_by(flight: Problem, noise: Noise, found: list[Solution]) -> list[Solution]:
    """Return the solutions, with those that the best one leads to when its passes are flipped."""
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
    """Return states (K, 6) with the range errors of the first guess.

    A solve that got stuck may succeed from there, with constants of zero, and become the best.
    """
    out = state.copy()
    out[:, RANGE_ERROR] = 0.0
    out[flight.range_key, RANGE_ERROR] = flight.range_level_m
    return out


def _start(flight: Problem, track: Array, offset_m: float) -> tuple[Array, Array]:
    """Return states (K, 6) and constants (G,) of a smoothed track (K, 5).

    The range error starts at the detected step offset.
    """
    state, constants = np.zeros((len(track), SIZE)), np.zeros(len(GLOBALS))
    state[:, :3] = track[:, :3]
    state[flight.range_key, RANGE_ERROR] = flight.range_level_m
    constants[[BIAS, OWN_GYRO, PEER_GYRO]] = offset_m, *track[-1, 3:]
    return state, constants
