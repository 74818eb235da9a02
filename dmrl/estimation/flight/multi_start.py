"""Multi-start solve of a flight: from every likely guess, and out of local minima."""

from collections.abc import Sequence

import numpy as np

from dmrl.estimation.flight.hypotheses import MAX_FLIPS, flip_pass, mirror_guesses
from dmrl.estimation.flight.initial_guesses import InitialGuesses
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.keyframes import GLOBALS, KEYFRAME_HZ, KeyframeProblem, NoiseModel
from dmrl.estimation.solver.levenberg_marquardt import (
    ROUGH_TOLERANCE,
    MapEstimate,
    is_same_solution,
    solve,
)
from dmrl.estimation.solver.residuals import (
    OWN_GYRO,
    PEER_GYRO,
    RANGE_BIAS,
    RANGE_ERROR,
    STATE_SIZE,
)

MAX_LIKELIHOOD_DEFICIT = 100.0
"""Guesses whose log likelihood is this far below the best are not solved. No record of how the
value was chosen."""
GUESSES_BESIDE_SEGMENTS = 2
"""Number of guesses that are solved beside the joined segments of a flight. No record of how the
value was chosen."""
RESTART_COST_MARGIN, MAX_RESTARTS = 200.0, 4
"""Largest cost above the best, and largest number, of solutions that are solved again from zero
constants. A simulated flight had its true solution stuck 130 above a wrong one."""
MIN_COST_GAIN = 0.5
"""Smallest cost reduction that makes a solution a new one, whose passes are flipped again. No
record of how the value was chosen."""


def find_solutions(
    flight: KeyframeProblem, noise: NoiseModel, starts: InitialGuesses, pieced: Sequence[Array]
) -> list[MapEstimate]:
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
    found = [solve(flight, noise, start, tolerance=ROUGH_TOLERANCE) for start in pieced]
    score = starts.score
    for number in np.argsort(-score)[: GUESSES_BESIDE_SEGMENTS if pieced else None]:
        start = starts.tracks[:, number]
        if score[number] > score.max() - MAX_LIKELIHOOD_DEFICIT and not any(
            is_same_solution(start, s) for s in begun
        ):
            begun.append(start)
            first = _initial_state(flight, start, starts.range_offset_m)
            found.append(solve(flight, noise, *first, found, ROUGH_TOLERANCE))
    found += [
        solve(
            flight,
            noise,
            _reset_range_errors(flight, s.state),
            previous=found,
            tolerance=ROUGH_TOLERANCE,
        )
        for s in select_distinct(found, RESTART_COST_MARGIN)[: 1 if pieced else MAX_RESTARTS]
    ]
    best = min(found, key=lambda s: s.cost)
    for start in mirror_guesses(best.state, KEYFRAME_HZ):
        found.append(solve(flight, noise, start, previous=found, tolerance=ROUGH_TOLERANCE))
    return sorted(_flip_passes(flight, noise, found), key=lambda s: s.cost)


def select_distinct(found: Sequence[MapEstimate], within: float) -> list[MapEstimate]:
    """Return the distinct solutions within a cost margin of the best, best first.

    Parameters
    ----------
    found
        Solutions of one flight.
    within
        The margin.
    """
    ordered = sorted(found, key=lambda s: s.cost)
    out: list[MapEstimate] = []
    for one in ordered:
        close = one.cost <= ordered[0].cost + within
        if close and not any(is_same_solution(one.state, other.state) for other in out):
            out.append(one)
    return out


def _flip_passes(
    flight: KeyframeProblem, noise: NoiseModel, found: list[MapEstimate]
) -> list[MapEstimate]:
    """Return the solutions, with those that the best one leads to when its passes are flipped."""
    found, best, tried = [*found], None, 0
    while best is None or min(s.cost for s in found) < best.cost - MIN_COST_GAIN:
        best = min(found, key=lambda s: s.cost)
        for start in flip_pass(best.state, KEYFRAME_HZ)[: MAX_FLIPS - tried]:
            tried += 1
            found.append(solve(flight, noise, start, best.constants, found, ROUGH_TOLERANCE))
            if found[-1].cost < best.cost - MIN_COST_GAIN:
                break
    return found


def _reset_range_errors(flight: KeyframeProblem, state: Array) -> Array:
    """Return states (K, 6) with the range errors of the first guess.

    A solve that got stuck may succeed from there, with constants of zero, and become the best.
    """
    out = state.copy()
    out[:, RANGE_ERROR] = 0.0
    out[flight.range_keyframe, RANGE_ERROR] = flight.range_offset_guess_m
    return out


def _initial_state(flight: KeyframeProblem, track: Array, offset_m: float) -> tuple[Array, Array]:
    """Return states (K, 6) and constants (G,) of a smoothed track (K, 5).

    The range error starts at the detected step offset.
    """
    state, constants = np.zeros((len(track), STATE_SIZE)), np.zeros(len(GLOBALS))
    state[:, :3] = track[:, :3]
    state[flight.range_keyframe, RANGE_ERROR] = flight.range_offset_guess_m
    constants[[RANGE_BIAS, OWN_GYRO, PEER_GYRO]] = offset_m, *track[-1, 3:]
    return state, constants
