"""Estimate relative positions of many pairs with covariance and status: the entry point."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.ndimage import median_filter

from dmrl.estimation.filters import ekf
from dmrl.estimation.flight.hypotheses import between_solution_covariance
from dmrl.estimation.flight.initial_guesses import InitialGuesses, find_initial_guesses
from dmrl.estimation.flight.multi_start import find_solutions, select_distinct
from dmrl.estimation.flight.segments import (
    join_segments,
    prefer_confident_segments,
    split_at_dropouts,
)
from dmrl.estimation.model.gate import GATE_M
from dmrl.estimation.model.pair import MAX_DROPOUT_S, Array, Mask, Pair
from dmrl.estimation.model.status import (
    AMBIGUOUS,
    OK,
    UNCONVERGED,
    Statuses,
    classify_positions,
)
from dmrl.estimation.solver.camera_residuals import (
    keep_consistent_cameras,
    keyframes_with_agreement,
)
from dmrl.estimation.solver.covariance import compute_covariance, motion_energy
from dmrl.estimation.solver.estimate import Estimate, RejectionReason, seen_from_peer
from dmrl.estimation.solver.keyframes import (
    GLOBALS,
    KEYFRAME_HZ,
    KeyframeProblem,
    NoiseModel,
    build_keyframes,
)
from dmrl.estimation.solver.levenberg_marquardt import ROUGH_TOLERANCE, MapEstimate, solve
from dmrl.estimation.solver.noise_selection import fit_range_noise, select_noise_model
from dmrl.estimation.solver.residuals import RANGE_BIAS, RANGE_ERROR

SIGMA_INFLATION = 1.03
"""Factor on the sigmas of the batch solve. Chosen on simulated flights in view: 93 to 99 % of the
true positions are inside the 95 % ellipse."""
GATE_SIGMA_FACTOR = 0.75
"""Factor on the sigmas that the gate uses. The written sigmas leave room for constant errors and so
predict more bad positions than there are. No figure of the choice is recorded."""
NOISE_RATIO_BOUNDS, MAX_CORRELATED_RANGE_M = (1.1, 1.5), 0.1
"""Velocity noise relative to the default model, and standard deviation of correlated range errors,
metres.

At the first ratio the gate uses the smaller sigmas, at the second the written ones, and in between
it interpolates. Beyond the range error it uses the written ones. The lasting errors of unusually
bad sensors are unknown, and the best-looking part of their flights is mostly chance. The range
error was raised because one of six realistic flights without a fault had been lost."""
SMOOTHER_SIGMA_INFLATION = 1.5
"""Factor on the sigmas of the smoother. No record of how the value was chosen."""
MIN_OWN_ENERGY, MIN_RELATIVE_ENERGY = 0.022, 0.04
"""Smallest mean square, (m/s)^2, of the observer's velocity and of the relative velocity that make
the bearing observable. Bad logs of robots at rest reach 0.018 and 0.03."""
MIN_CAMERA_S = 3.0
"""Shortest time with consistent images that makes the bearing of a motionless flight observable,
seconds. No record of how the value was chosen."""
RANGE_MEDIAN_REACH, RANGE_MARGIN_M = 10, 0.5
"""Number of ranges before and after in the median that bounds a position; and margin of that bound,
metres. No record of how the values were chosen."""
RIVAL_COST_MARGIN, MAX_RIVALS = 8.0, 3
"""Largest cost above the best, and largest number, of other solutions that are solved under the
selected noise. No record of how the values were chosen."""
MAJORITY_SHARE = 0.5
"""Share of a flight that determines the reason for its rejection."""


def estimate_pairs(
    pairs: list[Pair],
    method: Literal["batch", "smoother"] = "batch",
    *,
    noise: NoiseModel | None = None,
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
    problems = [build_keyframes(pair, KEYFRAME_HZ) for pair in pairs]
    made = []
    begun = find_initial_guesses(problems, noise or NoiseModel())
    for pair, flight, starts in zip(pairs, problems, begun, strict=True):
        if method == "smoother":
            made.append(
                _both_directions(
                    flight, _estimate_by_smoother(flight, noise or NoiseModel(), starts), gate_m
                )
            )
            continue
        # The segments between long dropouts are solved first, as flights of their own. Joined,
        # they are one more initial guess of the whole flight.
        cut = split_at_dropouts(pair)
        parts = estimate_pairs(cut, noise=noise, gate_m=gate_m) if cut else []
        pieced = [join_segments(flight, [here for here, _ in parts])] if parts else []
        whole = _estimate_by_batch(flight, noise, starts, pieced)
        made.append(prefer_confident_segments(_both_directions(flight, whole, gate_m), parts))
    return made


def _both_directions(
    flight: KeyframeProblem, estimate: Estimate, gate_m: float
) -> tuple[Estimate, Estimate]:
    """Return the estimates of both robots, with their statuses."""
    estimate, far = clip_to_ranges(flight, estimate)
    own, peer, relative = motion_energy(flight, estimate.state)
    looks = keep_consistent_cameras(flight.camera, estimate.state)
    looked = [
        keyframes_with_agreement(looks, estimate.state, side, flight.keyframe_s, MAX_DROPOUT_S)
        for side in (1, -1)
    ]
    # Consistent images replace missing ranges.
    silent = flight.dropout | (flight.range_dropout & ~(looked[0] | looked[1]))
    # Without motion the bearing is unobservable, unless the camera detects the peer.
    enough = [at.sum() >= MIN_CAMERA_S * KEYFRAME_HZ for at in looked]
    why = [
        None if seen else insufficient_excitation(moved, relative)
        for seen, moved in zip(enough, (own, peer), strict=True)
    ]
    sigma = gate_sigma_factor(estimate.noise)
    return (
        with_status(estimate, silent, why[0], gate_m, far=far, sigma=sigma),
        with_status(seen_from_peer(estimate), silent, why[1], gate_m, far=far, sigma=sigma),
    )


def gate_sigma_factor(noise: NoiseModel) -> float:
    """Return the factor on the written sigmas that the gate uses.

    Parameters
    ----------
    noise
        Selected noise model of the sensors.
    """
    usual = NoiseModel()
    if noise.range_error_std_m > MAX_CORRELATED_RANGE_M:
        return 1.0
    worse = noise.velocity_std_mps / usual.velocity_std_mps
    return float(np.interp(worse, NOISE_RATIO_BOUNDS, (GATE_SIGMA_FACTOR, 1.0)))


def insufficient_excitation(moved: float, relative: float) -> RejectionReason | None:
    """Return the reason why a motion leaves the bearing unobservable; None if it does not.

    Parameters
    ----------
    moved, relative
        Mean squares of the observer's velocity and of the relative velocity, (m/s)^2.
    """
    if moved < MIN_OWN_ENERGY:
        return "still"
    return "alike" if relative < MIN_RELATIVE_ENERGY else None


def with_status(
    estimate: Estimate,
    silent: Mask,
    why: RejectionReason | None,
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
    status = classify_positions(estimate.state, estimate.covariance * sigma**2, gate_m)
    floor = silent if far is None else silent | far
    status = np.maximum(status, floor * np.int8(UNCONVERGED))
    if why:
        status[:] = AMBIGUOUS
    refused = _find_rejection_reason(status, why, bool(silent.mean() > MAJORITY_SHARE))
    return replace(estimate, status=status, rejection_reason=refused)


def _find_rejection_reason(
    status: Statuses, why: RejectionReason | None, silent: bool
) -> RejectionReason | None:
    """Return the reason why no position is OK; None if any is."""
    if (status == OK).any():
        return None
    if why:
        return why
    if silent:
        return "silent"
    return "open" if (status == AMBIGUOUS).mean() > MAJORITY_SHARE else "imprecise"


def clip_to_ranges(flight: KeyframeProblem, estimate: Estimate) -> tuple[Estimate, Mask]:
    """Clip an estimate to the distance that the ranges allow, and return where it exceeded it.

    Parameters
    ----------
    flight
        Keyframes of the flight.
    estimate
        Estimate of the flight.
    """
    if not len(flight.range_m):
        return estimate, np.zeros(len(flight.keyframe_s), bool)
    smooth_m = median_filter(flight.range_m, 2 * RANGE_MEDIAN_REACH + 1, mode="nearest")
    near = np.searchsorted(flight.keyframe_s[flight.range_keyframe], flight.keyframe_s)
    around = np.clip(
        near[:, None] + [-RANGE_MEDIAN_REACH, 0, RANGE_MEDIAN_REACH], 0, len(smooth_m) - 1
    )
    reach_m = smooth_m[around].max(axis=1) + RANGE_MARGIN_M
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
    steps = [ekf.build_steps(pair, ekf.PRESETS[preset]) for pair in pairs]
    out: dict[int, Estimate] = {}
    lengths = np.array([len(pair.time_s) for pair in pairs], int)
    for length in np.unique(lengths):
        numbers = np.flatnonzero(lengths == length).tolist()
        side_by_side = ekf.stack_pairs([steps[n] for n in numbers])
        state, spread = ekf.filter_many(side_by_side, ekf.PRESETS[preset])
        for k, n in enumerate(numbers):
            none, constants = np.zeros(length, np.int8), np.zeros(len(GLOBALS))
            made = Estimate(
                pairs[n].time_s, state[:, k], spread[:, k], none, constants, NoiseModel()
            )
            out[n] = replace(made, status=classify_positions(made.state, made.covariance, gate_m))
    return [out[n] for n in range(len(pairs))]


def _estimate_by_smoother(
    flight: KeyframeProblem, noise: NoiseModel, starts: InitialGuesses
) -> Estimate:
    """Return the estimate of the smoother, with the spread between its guesses."""
    order = np.argsort(-starts.score)
    best = int(order[0])
    ends = starts.tracks[..., :3].swapaxes(0, 1)[order]
    apart = between_solution_covariance(-starts.score[order], ends)
    constants = np.zeros(len(GLOBALS))
    constants[RANGE_BIAS] = starts.range_offset_m
    return Estimate(
        flight.keyframe_s,
        starts.tracks[:, best, :3],
        starts.covariances[:, best, :3, :3] * SMOOTHER_SIGMA_INFLATION**2 + apart,
        np.zeros(len(flight.keyframe_s), np.int8),
        constants,
        noise,
    )


def _estimate_by_batch(
    flight: KeyframeProblem,
    noise: NoiseModel | None,
    starts: InitialGuesses,
    pieced: Sequence[Array],
) -> Estimate:
    """Return the estimate of the batch solve, with the selected noise model."""
    known = () if flight.calibrated_std is None else tuple(flight.calibrated_std.tolist())
    first = noise or NoiseModel(calibrated_std=known)
    ends = find_solutions(flight, first, starts, pieced)
    if flight.camera is not None:
        flight = replace(flight, camera=keep_consistent_cameras(flight.camera, ends[0].state))
    found, best = (noise, ends[0]) if noise else select_noise_model(flight, first, ends[0])
    ends = _rank_solutions(flight, found, best, ends)
    apart = between_solution_covariance(
        np.array([s.cost for s in ends]), np.stack([s.state[:, :3] for s in ends])
    )
    best = ends[0]
    if not noise:
        found, best = fit_range_noise(flight, found, best)
    keyframes, constants = compute_covariance(flight, found, best)
    spread = keyframes[:, :3, :3] * SIGMA_INFLATION**2 + apart
    none = np.zeros(len(flight.keyframe_s), np.int8)
    state, error_m = best.state[:, :3], best.state[:, RANGE_ERROR]
    made = Estimate(flight.keyframe_s, state, spread, none, best.constants, found, error_m)
    return replace(made, constants_covariance=constants)


def _rank_solutions(
    flight: KeyframeProblem, noise: NoiseModel, best: MapEstimate, ends: Sequence[MapEstimate]
) -> list[MapEstimate]:
    """Solve again under the selected noise model; return the solutions, best first.

    The cost difference between solutions depends on the noise model.
    """
    found = [solve(flight, noise, best.state, best.constants)]
    for end in select_distinct(ends, RIVAL_COST_MARGIN)[1 : 1 + MAX_RIVALS]:
        found.append(solve(flight, noise, end.state, end.constants, found, ROUGH_TOLERANCE))
    return sorted(found, key=lambda s: s.cost)
