"""Estimate relative positions of many pairs with covariance and status: the entry point."""

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
from dmrl.estimation.model.gate import GATE_M
from dmrl.estimation.model.pair import LONGEST_GAP_S, Array, Mask, Pair
from dmrl.estimation.model.status import (
    AMBIGUOUS,
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
"""Factor on the sigmas of the batch solve. Chosen on simulated flights in view: 93 to 99 % of the
true positions are inside the 95 % ellipse."""
GATE_SIGMA = 0.75
"""Factor on the sigmas that the gate uses. The written sigmas leave room for constant errors and so
predict more bad positions than there are. No figure of the choice is recorded."""
WORSE, FADED_M = (1.1, 1.5), 0.1
"""Velocity noise relative to the default model, and standard deviation of correlated range errors,
metres.

At the first ratio the gate uses the smaller sigmas, at the second the written ones, and in between
it interpolates. Beyond the range error it uses the written ones. The lasting errors of unusually
bad sensors are unknown, and the best-looking part of their flights is mostly chance. The range
error was raised because one of six realistic flights without a fault had been lost."""
SMOOTHER_INFLATION = 1.5
"""Factor on the sigmas of the smoother. No record of how the value was chosen."""
STILL, ALIKE = 0.022, 0.04
"""Smallest mean square, (m/s)^2, of the observer's velocity and of the relative velocity that make
the bearing observable. Bad logs of robots at rest reach 0.018 and 0.03."""
LOOKED_S = 3.0
"""Shortest time with consistent images that makes the bearing of a motionless flight observable,
seconds. No record of how the value was chosen."""
STEADY, REACH_M = 10, 0.5
"""Number of ranges before and after in the median that bounds a position; and margin of that bound,
metres. No record of how the values were chosen."""
RIVAL, RIVALS = 8.0, 3
"""Largest cost above the best, and largest number, of other solutions that are solved under the
selected noise. No record of how the values were chosen."""
MOST = 0.5
"""Share of a flight that determines the reason for its rejection."""


def estimate_pairs(
    pairs: list[Pair],
    method: Literal["batch", "smoother"] = "batch",
    *,
    noise: Noise | None = None,
    gate_m: float = GATE_M,
) -> list[tuple[Estimate, Estimate]]:
    """Estimate both directions of several pairs: peer by observer, and observer by peer.

    Parameters
    ----------
    pairs
        Any number of pairs. Pairs of equal length share work.
    method
        The batch solve, or the smoother that provides its initial guesses.
    noise
        Noise model of the sensors. None: selected for each flight.
    gate_m
        Largest error of a good position, metres.
    """
    problems = [problem(pair, KEY_HZ) for pair in pairs]
    made = []
    begun = likely_starts(problems, noise or Noise())
    for pair, flight, starts in zip(pairs, problems, begun, strict=True):
        if method == "smoother":
            made.append(_both(flight, _from_smoother(flight, noise or Noise(), starts), gate_m))
            continue
        # The segments between long dropouts are solved first, as flights of their own. Joined,
        # they are one more initial guess of the whole flight.
        cut = stretches(pair)
        parts = estimate_pairs(cut, noise=noise, gate_m=gate_m) if cut else []
        pieced = [joined(flight, [here for here, _ in parts])] if parts else []
        whole = _from_batch(flight, noise, starts, pieced)
        made.append(mended(_both(flight, whole, gate_m), parts))
    return made


def _both(flight: Problem, estimate: Estimate, gate_m: float) -> tuple[Estimate, Estimate]:
    """Return the estimates of both robots, with their statuses."""
    estimate, far = within_reach(flight, estimate)
    own, peer, relative = restlessness(flight, estimate.state)
    looks = trusted(flight.looks, estimate.state)
    looked = [
        agreeing(looks, estimate.state, side, flight.key_s, LONGEST_GAP_S) for side in (1, -1)
    ]
    # Consistent images replace missing ranges.
    silent = flight.silent | (flight.unheard & ~(looked[0] | looked[1]))
    # Without motion the bearing is unobservable, unless the camera detects the peer.
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
    """Return the factor on the written sigmas that the gate uses.

    Parameters
    ----------
    noise
        Selected noise model of the sensors.
    """
    usual = Noise()
    if noise.range_error_std_m > FADED_M:
        return 1.0
    worse = noise.velocity_std_mps / usual.velocity_std_mps
    return float(np.interp(worse, WORSE, (GATE_SIGMA, 1.0)))


def unmoved(moved: float, relative: float) -> Refused | None:
    """Return the reason why a motion leaves the bearing unobservable; None if it does not.

    Parameters
    ----------
    moved, relative
        Mean squares of the observer's velocity and of the relative velocity, (m/s)^2.
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
    """Return an estimate with its statuses and, if no position is OK, the reason.

    Parameters
    ----------
    estimate
        Estimate of a pair.
    silent
        (K,) whether a sensor of either robot, or their ranges, dropped out.
    why
        Reason why the motion leaves the bearing unobservable; None if it does not.
    gate_m
        Largest error of a good position, metres.
    far
        (K,) where the estimate was farther than the ranges allow. None: nowhere.
    sigma
        Factor on the sigmas that the gate uses.
    """
    status = statuses(estimate.state, estimate.covariance * sigma**2, gate_m)
    floor = silent if far is None else silent | far
    status = np.maximum(status, floor * np.int8(UNCONVERGED))
    if why:
        status[:] = AMBIGUOUS
    refused = _refused(status, why, bool(silent.mean() > MOST))
    return replace(estimate, status=status, refused=refused)


def _refused(status: Statuses, why: Refused | None, silent: bool) -> Refused | None:
    """Return the reason why no position is OK; None if any is."""
    if (status == OK).any():
        return None
    if why:
        return why
    if silent:
        return "silent"
    return "open" if (status == AMBIGUOUS).mean() > MOST else "imprecise"


def within_reach(flight: Problem, estimate: Estimate) -> tuple[Estimate, Mask]:
    """Clip an estimate to the distance that the ranges allow, and return where it exceeded it.

    Parameters
    ----------
    flight
        Keyframes of the flight.
    estimate
        Estimate of the flight.
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
    """Estimate pairs with the published filter, at every step of their time grids.

    Parameters
    ----------
    pairs
        Any number of pairs.
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
    """Return the estimate of the smoother, with the spread between its guesses."""
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
    """Return the estimate of the batch solve, with the selected noise model."""
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
    """Solve again under the selected noise model; return the solutions, best first.

    The cost difference between solutions depends on the noise model.
    """
    found = [solve_batch(flight, noise, best.state, best.constants)]
    for end in distinct(ends, RIVAL)[1 : 1 + RIVALS]:
        found.append(solve_batch(flight, noise, end.state, end.constants, found, ROUGH))
    return sorted(found, key=lambda s: s.cost)
