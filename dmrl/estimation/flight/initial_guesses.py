"""Initial guesses of a flight's solve, smoothed by the keyframe filter."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dmrl.estimation.filters import keyframe_ekf
from dmrl.estimation.filters.camera_update import camera_updates, repeat_updates
from dmrl.estimation.flight.hypotheses import GUESS_STD, KEPT_GUESSES, select_guesses
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.keyframes import KEYFRAME_HZ, KeyframeProblem, NoiseModel

SHORT_RANGE_M, MIN_LIKELIHOOD_GAIN = 0.4, 10.0
"""Range offset that is tried, metres; and gain of the log likelihood that accepts it. Without a
wrong side at a pass, log likelihoods differ by a few. Chosen on 24 simulated harsh flights of 100
s: three of them had ended in a solution that circles the observer."""
CLOSE_RANGE_SHARE, CLOSE_RANGE_M = 0.05, 0.6
"""Share of the ranges below a distance, metres, at which the offset is tried. Added with
``SHORT_RANGE_M``; no record of how the values were chosen."""


@dataclass(frozen=True, slots=True)
class InitialGuesses:
    """Initial guesses of a flight of K keyframes.

    Parameters
    ----------
    score
        (KEPT_GUESSES,) log likelihoods.
    tracks
        (K, KEPT_GUESSES, 5) x, y (m), psi (rad), biases of the yaw rates (rad/s).
    covariances
        (K, KEPT_GUESSES, 5, 5) of these.
    range_offset_m
        Assumed excess of the ranges, metres.
    """

    score: Array
    tracks: Array
    covariances: Array
    range_offset_m: float = 0.0


def find_initial_guesses(
    problems: Sequence[KeyframeProblem], noise: NoiseModel
) -> list[InitialGuesses]:
    """Find the likely initial guesses of each flight.

    Ranges that are decimetres too short make passing robots seem to meet. A path around the
    observer then fits as well as a path past it, and no solve recovers from that. The filters
    detect it: with longer ranges the flight is far likelier.

    Parameters
    ----------
    problems
        Keyframes of any number of flights.
    noise
        Noise model of their sensors.
    """
    found = _smooth_guesses(problems, noise)
    near = [n for n, flight in enumerate(problems) if _has_close_pass(flight)]
    longer = [replace(problems[n], range_m=problems[n].range_m + SHORT_RANGE_M) for n in near]
    for number, tried in zip(near, _smooth_guesses(longer, noise), strict=True):
        if tried.score.max() > found[number].score.max() + MIN_LIKELIHOOD_GAIN:
            found[number] = replace(tried, range_offset_m=-SHORT_RANGE_M)
    return found


def _has_close_pass(flight: KeyframeProblem) -> bool:
    """Return whether the ranges of a flight indicate a close pass."""
    short = (
        len(flight.range_m) > 0 and np.quantile(flight.range_m, CLOSE_RANGE_SHARE) < CLOSE_RANGE_M
    )
    return bool(short)


def _smooth_guesses(problems: Sequence[KeyframeProblem], noise: NoiseModel) -> list[InitialGuesses]:
    """Return the guesses of each flight. Flights of equal length are smoothed side by side."""
    found: dict[int, InitialGuesses] = {}
    lengths = np.array([len(p.keyframe_s) for p in problems], int)
    for length in np.unique(lengths):
        numbers = np.flatnonzero(lengths == length).tolist()
        scores, states, covariances = _smooth_flights([problems[n] for n in numbers], noise)
        for column, number in enumerate(numbers):
            mine = slice(column * KEPT_GUESSES, (column + 1) * KEPT_GUESSES)
            found[number] = InitialGuesses(scores[mine], states[:, mine], covariances[:, mine])
    return [found[number] for number in range(len(problems))]


def _smooth_flights(
    problems: list[KeyframeProblem], noise: NoiseModel
) -> tuple[Array, Array, Array]:
    """Filter and smooth P flights of one length.

    Returns
    -------
    scores, states, covariances
        (P KEPT_GUESSES,), (K, P KEPT_GUESSES, 5) and (K, P KEPT_GUESSES, 5, 5).
    """
    inputs = keyframe_ekf.build_inputs(problems, noise)
    glances = camera_updates([flight.camera for flight in problems])
    start = select_guesses(inputs, KEYFRAME_HZ, glances).reshape(-1, 3)
    count = len(problems[0].keyframe_s)
    given = inputs.repeat(KEPT_GUESSES, count), start, GUESS_STD
    filtered = keyframe_ekf.run_filters(*given, repeat_updates(glances, KEPT_GUESSES))
    return filtered.log_likelihood, *keyframe_ekf.smooth_rts(filtered)
