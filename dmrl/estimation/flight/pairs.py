"""Relative positions of many pairs with covariance and status: the entrance of this room."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.ndimage import median_filter

from dmrl.estimation.filters import ekf
from dmrl.estimation.flight.hypotheses import spread_of
from dmrl.estimation.flight.initial_guesses import Starts, likely_starts
from dmrl.estimation.flight.multi_start import distinct, solutions
from dmrl.estimation.flight.segments import joined, mended, stretches
from dmrl.estimation.model.pair import LONGEST_GAP_S, Array, Mask, Pair
from dmrl.estimation.model.status import (
    AMBIGUOUS,
    GATE_M,
    OK,
    UNCONVERGED,
    Statuses,
    statuses,
)
from dmrl.estimation.solver.camera_residuals import agreeing, trusted
from dmrl.estimation.solver.covariance import covariance, restlessness
from dmrl.estimation.solver.estimate import Estimate, Refused, swapped
from dmrl.estimation.solver.keyframes import GLOBALS, KEY_HZ, Noise, Problem, problem
from dmrl.estimation.solver.levenberg_marquardt import ROUGH, Solution, solve_batch
from dmrl.estimation.solver.noise_selection import noise_of, with_range_noise
from dmrl.estimation.solver.residuals import BIAS, RANGE_ERROR

INFLATION = 1.03
"""Sigmas of the batch solve are multiplied by this: the 95 % ellipse in view holds 93 to 99 %."""
GATE_SIGMA = 0.75
"""The gate goes by sigmas this much smaller: those of the ellipse expect more bad positions than
there are, as they make room for what is constant."""
WORSE, FADED_M = (1.1, 1.5), 0.1
"""Velocities this many times as noisy as the default's: with the first the gate goes by those
smaller sigmas, with the second by all of them, as where errors of ranges larger than this seem to
fade. What lasts of the errors of worse sensors than are usual is not known either, and what looks
best of such a flight is mostly luck."""
SMOOTHER_INFLATION = 1.5
STILL, ALIKE = 0.022, 0.04
"""Mean squares, (m/s)^2, of the observer's velocity and of the relative one, below which a
flight tells no bearing: bad logs of robots that stand still show 0.018 and 0.03."""
LOOKED_S = 3.0
"""A camera that saw the other for so long tells the bearing of a flight that has no motion."""
STEADY, REACH_M = 10, 0.5
"""A position is held against the medians of so many ranges before and after, and may be this
much farther."""
RIVAL, RIVALS = 8.0, 3
"""Solutions that cost at most so much more, and so many, are weighed again once it is known how
good the sensors are."""
MOST = 0.5
"""A share of a flight that says why nothing of it is OK."""


def estimate_pairs(
    pairs: list[Pair],
    method: Literal["batch", "smoother"] = "batch",
    *,
    noise: Noise | None = None,
    gate_m: float = GATE_M,
) -> list[tuple[Estimate, Estimate]]:
    """Estimates of several pairs: of the peer by the observer, and of the observer by the peer.

    Parameters
    ----------
    pairs
        Any number; those of equal length share work.
    method
        The batch solve, or the smoother that it starts from.
    noise
        What the sensors are like. None: found from the flight.
    gate_m
        A position that is off by more than this is a bad one, metres.
    """
    problems = [problem(pair, KEY_HZ) for pair in pairs]
    made = []
    begun = likely_starts(problems, noise or Noise())
    for pair, flight, starts in zip(pairs, problems, begun, strict=True):
        if method == "smoother":
            made.append(_both(flight, _from_smoother(flight, noise or Noise(), starts), gate_m))
            continue
        # Where a flight has gaps, each stretch between them is solved first, as a flight of its
        # own. Put together they are one more start for the whole.
        cut = stretches(pair)
        parts = estimate_pairs(cut, noise=noise, gate_m=gate_m) if cut else []
        pieced = [joined(flight, [here for here, _ in parts])] if parts else []
        whole = _from_batch(flight, noise, starts, pieced)
        made.append(mended(_both(flight, whole, gate_m), parts))
    return made


def _both(flight: Problem, estimate: Estimate, gate_m: float) -> tuple[Estimate, Estimate]:
    """Estimates seen from either robot, with their statuses."""
    estimate, far = within_reach(flight, estimate)
    own, peer, relative = restlessness(flight, estimate.state)
    looks = trusted(flight.looks, estimate.state)
    looked = [
        agreeing(looks, estimate.state, side, flight.key_s, LONGEST_GAP_S) for side in (1, -1)
    ]
    # Where a camera sees the other, ranges may be silent.
    silent = flight.silent | (flight.unheard & ~(looked[0] | looked[1]))
    # What does not move tells no bearing. A camera that sees the other tells it.
    enough = [at.sum() >= LOOKED_S * KEY_HZ for at in looked]
    why = [
        None if seen else unmoved(moved, relative)
        for seen, moved in zip(enough, (own, peer), strict=True)
    ]
    sigma = gate_sigma(estimate.noise)
    return (
        with_status(estimate, silent, why[0], gate_m, far=far, sigma=sigma),
        with_status(swapped(estimate), silent, why[1], gate_m, far=far, sigma=sigma),
    )


def gate_sigma(noise: Noise) -> float:
    """By sigmas how many times as large as those written the gate goes.

    Parameters
    ----------
    noise
        What the sensors turned out to be like.
    """
    usual = Noise()
    if noise.range_error_std_m > FADED_M:
        return 1.0
    worse = noise.velocity_std_mps / usual.velocity_std_mps
    return float(np.interp(worse, WORSE, (GATE_SIGMA, 1.0)))


def unmoved(moved: float, relative: float) -> Refused | None:
    """Why a motion tells no bearing; None where it does.

    Parameters
    ----------
    moved, relative
        Mean squares of the observer's velocity and of the peer's against it, (m/s)^2.
    """
    if moved < STILL:
        return "still"
    return "alike" if relative < ALIKE else None


def with_status(
    estimate: Estimate,
    silent: Mask,
    why: Refused | None,
    gate_m: float,
    *,
    far: Mask | None = None,
    sigma: float = 1.0,
) -> Estimate:
    """An estimate with its statuses, and why nothing of it is OK where that is so.

    Parameters
    ----------
    estimate
        What was found.
    silent
        (K,) whether a sensor of either robot, or their ranges, were silent.
    why
        Why its motion tells no bearing; None where it does.
    gate_m
        A position that is off by more than this is a bad one, metres.
    far
        (K,) where the estimate was farther than ranges allow; None: nowhere.
    sigma
        The gate goes by sigmas so much as large.
    """
    status = statuses(estimate.state, estimate.covariance * sigma**2, gate_m)
    floor = silent if far is None else silent | far
    status = np.maximum(status, floor * np.int8(UNCONVERGED))
    if why:
        status[:] = AMBIGUOUS
    refused = _refused(status, why, bool(silent.mean() > MOST))
    return replace(estimate, status=status, refused=refused)


def _refused(status: Statuses, why: Refused | None, silent: bool) -> Refused | None:
    if (status == OK).any():
        return None
    if why:
        return why
    if silent:
        return "silent"
    return "open" if (status == AMBIGUOUS).mean() > MOST else "imprecise"


def within_reach(flight: Problem, estimate: Estimate) -> tuple[Estimate, Mask]:
    """An estimate no farther than the ranges around it allow, and (K,) where it was.

    Parameters
    ----------
    flight
        The flight.
    estimate
        Its solution.
    """
    if not len(flight.range_m):
        return estimate, np.zeros(len(flight.key_s), bool)
    smooth_m = median_filter(flight.range_m, 2 * STEADY + 1, mode="nearest")
    near = np.searchsorted(flight.key_s[flight.range_key], flight.key_s)
    around = np.clip(near[:, None] + [-STEADY, 0, STEADY], 0, len(smooth_m) - 1)
    reach_m = smooth_m[around].max(axis=1) + REACH_M
    distance = np.hypot(*estimate.state[:, :2].T)
    far = distance > reach_m
    state = estimate.state.copy()
    state[far, :2] *= (reach_m[far] / distance[far])[:, None]
    return replace(estimate, state=state), far


def estimate_ekf(pairs: list[Pair], preset: str, *, gate_m: float = GATE_M) -> list[Estimate]:
    """Estimates by the published filter, at every step of the pairs' time grids.

    Parameters
    ----------
    pairs
        Any number.
    preset
        One of ``ekf.PRESETS``.
    gate_m
        As in `estimate_pairs`.
    """
    steps = [ekf.pair_steps(pair, ekf.PRESETS[preset]) for pair in pairs]
    out: dict[int, Estimate] = {}
    lengths = np.array([len(pair.time_s) for pair in pairs], int)
    for length in np.unique(lengths):
        numbers = np.flatnonzero(lengths == length).tolist()
        side_by_side = ekf.stack([steps[n] for n in numbers])
        state, spread = ekf.filter_many(side_by_side, ekf.PRESETS[preset])
        for k, n in enumerate(numbers):
            none, constants = np.zeros(length, np.int8), np.zeros(len(GLOBALS))
            made = Estimate(pairs[n].time_s, state[:, k], spread[:, k], none, constants, Noise())
            out[n] = replace(made, status=statuses(made.state, made.covariance, gate_m))
    return [out[n] for n in range(len(pairs))]


def _from_smoother(flight: Problem, noise: Noise, starts: Starts) -> Estimate:
    order = np.argsort(-starts.score)
    best = int(order[0])
    ends = starts.tracks[..., :3].swapaxes(0, 1)[order]
    apart = spread_of(-starts.score[order], ends)
    constants = np.zeros(len(GLOBALS))
    constants[BIAS] = starts.offset_m
    return Estimate(
        flight.key_s,
        starts.tracks[:, best, :3],
        starts.covariances[:, best, :3, :3] * SMOOTHER_INFLATION**2 + apart,
        np.zeros(len(flight.key_s), np.int8),
        constants,
        noise,
    )


def _from_batch(
    flight: Problem, noise: Noise | None, starts: Starts, pieced: Sequence[Array]
) -> Estimate:
    known = () if flight.known_std is None else tuple(flight.known_std.tolist())
    first = noise or Noise(known_std=known)
    ends = solutions(flight, first, starts, pieced)
    if flight.looks is not None:
        flight = replace(flight, looks=trusted(flight.looks, ends[0].state))
    found, best = (noise, ends[0]) if noise else noise_of(flight, first, ends[0])
    ends = _weighed(flight, found, best, ends)
    apart = spread_of(np.array([s.cost for s in ends]), np.stack([s.state[:, :3] for s in ends]))
    best = ends[0]
    if not noise:
        found, best = with_range_noise(flight, found, best)
    keyframes, constants = covariance(flight, found, best)
    spread = keyframes[:, :3, :3] * INFLATION**2 + apart
    none = np.zeros(len(flight.key_s), np.int8)
    state, error_m = best.state[:, :3], best.state[:, RANGE_ERROR]
    made = Estimate(flight.key_s, state, spread, none, best.constants, found, error_m)
    return replace(made, constants_covariance=constants)


def _weighed(
    flight: Problem, noise: Noise, best: Solution, ends: Sequence[Solution]
) -> list[Solution]:
    """Solutions of a flight under the noise that was found, best first.

    How much worse another solution is depends on how good the sensors are.
    """
    found = [solve_batch(flight, noise, best.state, best.constants)]
    for end in distinct(ends, RIVAL)[1 : 1 + RIVALS]:
        found.append(solve_batch(flight, noise, end.state, end.constants, found, ROUGH))
    return sorted(found, key=lambda s: s.cost)
