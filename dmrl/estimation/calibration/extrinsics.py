"""Calibrate a camera's mount and image delay from flights. Arrays only.

The network gives the peer's position in the image; ranges and odometry give it in the horizontal
frame. Over a whole flight the difference between them is the rotation of the mount and the offset
of the clock: the bias that Li et al. observed in their labels and did not correct. The matching of
detections and peers depends on both. So several delays are tried and the best one is refined. Two
delays that fit equally well raise an error.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from dmrl.errors import SettingError
from dmrl.estimation.calibration.mount_solver import (
    MAX_VALUES,
    MountEstimate,
    pixel_jacobian,
    solve_mount,
)
from dmrl.estimation.calibration.noise import Noise
from dmrl.estimation.calibration.observations import (
    CalibrationFlight,
    Matches,
    PeerView,
    expected_median_px,
    match_detections,
    median_residual_px,
    pixel_residuals,
    with_mount,
)
from dmrl.geometry.frames import Array, Camera

TRIED_DELAYS_S = np.arange(-5, 6) * 0.08
"""Delays that are tried, seconds. Neighbours overlap in the images of a peer that crosses the view.
"""
RANKING_IMAGES = 600
"""Number of images, over all peers and flights, that rank the tried delays. No record of how the
value was chosen."""
RANKING_RADIUS_PX, MATCH_RADII_PX = 60.0, (60.0, 60.0)
"""Largest distance of a match, pixels: while delays are ranked, and in each round of refinement. A
radius of 25 px had cut off one side of the errors."""
MAX_SQUARED_RESIDUAL = 9.0
"""Largest squared whitened residual, that of a false detection. Three standard deviations; no other
record of how the value was chosen."""
MAX_MISFIT_EXCESS = 0.1
"""Candidates with a misfit larger than the best by this share are not refined. No record of how the
value was chosen."""
MAX_REFINED = 4
"""Largest number of refined candidates. No record of how the value was chosen."""
SAME_DELAY_S = 0.015
"""Delays closer than this are the same, seconds. No record of how the value was chosen."""
MIN_LOG_LIKELIHOOD_GAP = 4.0
"""Smallest difference of the log likelihoods of two delays that are distinguishable: odds of one in
fifty."""
PROBE_SIGMAS, MIN_COST_INCREASE = (-4.0, -2.0, 2.0, 4.0), 0.1
"""Offsets, in standard errors, at which the width of the likelihood of the delay is measured; and
smallest increase of the cost there. No record of how the values were chosen."""
SAMPLING_STD_SHARE = 0.25
"""Lower bound of the delay's standard error, as a share of the interval between attitude samples.
No record of how the value was chosen."""
VALUE_NAMES = ("roll", "pitch", "yaw", "delay")
MIN_MATCHES = 50
"""Fewest matched detections of a calibration. No record of how the value was chosen."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """Calibrated camera with standard errors.

    Parameters
    ----------
    camera
        Camera with its mount and delay.
    mount_std_rad
        (3,) standard errors of roll, pitch and yaw. Errors of positions last for seconds, and
        partly for a flight (`dmrl.estimation.calibration.mount_solver`), so they do not fall with
        the number of images.
    delay_std_s
        Standard error of the delay: at least a small share of an attitude sample.
    matched
        Number of detections used.
    before_px, after_px
        Median distance between these and their predictions.
    expected_px
        This median by the errors of positions, attitude and detections as they are stated.
    """

    camera: Camera
    mount_std_rad: tuple[float, float, float]
    delay_std_s: float
    matched: int
    before_px: float
    after_px: float
    expected_px: float


@dataclass(frozen=True, slots=True)
class _Candidate:
    """Result of one initial delay: mount and delay, and misfit from 0 to `MAX_SQUARED_RESIDUAL`."""

    values: Array
    misfit: float


def calibrate_mount(
    flights: Sequence[CalibrationFlight], camera: Camera, noise: Noise
) -> Calibration | None:
    """Calibrate the mount's rotation and the delay; return None with too few matches.

    Parameters
    ----------
    flights
        Detections, attitude, and positions of the peers.
    camera
        Intrinsics, and the initial mount and delay.
    noise
        Noise of detections and attitude.

    Raises
    ------
    SettingError
        If two delays explain the images alike, or mount or delay may lie beyond the limits.
    """
    smooth = [flight.smooth_attitude() for flight in flights]
    views = [(flight, peer) for flight in smooth for peer in flight.peers.values()]
    if not views:
        return None
    start = np.array([*camera.mount_rad, camera.delay_s])
    tries = _rank_delays(views, camera, start, noise)
    if not tries:
        return None
    ends = _refine_candidates(views, camera, tries, noise)
    if not ends:
        return None
    found, matched = ends[0]
    _check_unambiguous([end for end, _ in ends])
    spread = np.sqrt(np.diag(found.covariance))
    _check_within_limits(found.values, spread)
    return Calibration(
        with_mount(camera, found.values),
        (float(spread[0]), float(spread[1]), float(spread[2])),
        _delay_std_s(views, camera, matched, found, noise),
        len(matched.time_s),
        median_residual_px(views, camera, matched, start),
        median_residual_px(views, camera, matched, found.values),
        expected_median_px(matched),
    )


def _rank_delays(
    views: Sequence[PeerView], camera: Camera, start: Array, noise: Noise
) -> list[_Candidate]:
    """Fit every initial delay; return the candidates, best first."""
    found = []
    views = [(flight.thin_images(RANKING_IMAGES // len(views)), peer) for flight, peer in views]
    for delay_s in (start[3], *TRIED_DELAYS_S):
        values = np.array([*start[:3], delay_s])
        matched = match_detections(views, with_mount(camera, values), RANKING_RADIUS_PX, noise)
        if len(matched.time_s) >= MIN_MATCHES:
            values = _fit_independent(views, camera, matched, values)
            found.append(_Candidate(values, _mean_misfit(views, camera, values, noise)))
    return sorted(found, key=lambda one: one.misfit)


def _mean_misfit(views: Sequence[PeerView], camera: Camera, values: Array, noise: Noise) -> float:
    """Return the mean squared residual of images with a peer, each at most `MAX_SQUARED_RESIDUAL`.

    An image without a nearby detection counts as the maximum. Otherwise a start that explains few
    images well would beat one that explains most.
    """
    matched = match_detections(views, with_mount(camera, values), RANKING_RADIUS_PX, noise)
    apart = (matched.whiten @ pixel_residuals(views, camera, matched, values)[..., None])[..., 0]
    missed = matched.expected - len(apart)
    fits = np.minimum((apart**2).sum(axis=1), MAX_SQUARED_RESIDUAL).sum()
    return float((fits + MAX_SQUARED_RESIDUAL * missed) / max(matched.expected, 1))


def _fit_independent(
    views: Sequence[PeerView], camera: Camera, matched: Matches, start: Array
) -> Array:
    """Fit mount and delay (4,) by maximum likelihood, as if all errors were new in every image."""

    def whiten_residuals(values: Array) -> Array:
        apart = pixel_residuals(views, camera, matched, values)
        return np.asarray((matched.whiten @ apart[..., None]).ravel())

    def whiten_jacobian(values: Array) -> Array:
        found = pixel_jacobian(views, camera, matched, values)
        return np.asarray(-(matched.whiten @ found).reshape(-1, 4))

    start = np.clip(start, -0.99 * MAX_VALUES, 0.99 * MAX_VALUES)
    found = least_squares(
        whiten_residuals,
        start,
        whiten_jacobian,
        bounds=(-MAX_VALUES, MAX_VALUES),
        loss="cauchy",
        xtol=1e-4,
        max_nfev=10,
    )
    return np.asarray(found.x)


def _select_distinct(tries: Sequence[_Candidate]) -> list[_Candidate]:
    """Return the best candidates, one for each delay."""
    kept: list[_Candidate] = []
    for one in tries:
        alone = all(abs(one.values[3] - other.values[3]) > SAME_DELAY_S for other in kept)
        if alone and one.misfit < tries[0].misfit * (1 + MAX_MISFIT_EXCESS):
            kept.append(one)
    return kept[:MAX_REFINED]


def _refine_candidates(
    views: Sequence[PeerView], camera: Camera, tries: Sequence[_Candidate], noise: Noise
) -> list[tuple[MountEstimate, Matches]]:
    """Refine the best candidates; return the results, likeliest first.

    The likeliest result gives the error of a single detection. With it all candidates are solved
    again and compared.
    """
    spread_px = float(np.hypot(noise.pixel_std_px, noise.attitude_std_rad * camera.fx_px))
    refined = [
        _refine_candidate(views, camera, one, noise, spread_px) for one in _select_distinct(tries)
    ]
    ends = sorted((end for end in refined if end is not None), key=lambda end: end[0].cost)
    again = [
        (solve_mount(views, camera, matched, end.values, noise, ends[0][0].spread_px), matched)
        for end, matched in ends
    ]
    return sorted(again, key=lambda end: end[0].cost)


def _refine_candidate(
    views: Sequence[PeerView], camera: Camera, one: _Candidate, noise: Noise, spread_px: float
) -> tuple[MountEstimate, Matches] | None:
    """Refine one candidate with repeated matching; return None with too few matches."""
    values, end = one.values, None
    for radius_px in MATCH_RADII_PX:
        matched = match_detections(views, with_mount(camera, values), radius_px, noise)
        if len(matched.time_s) < MIN_MATCHES:
            return None
        found = solve_mount(views, camera, matched, values, noise, spread_px)
        values, end = found.values, (found, matched)
    return end


def _delay_std_s(
    views: Sequence[PeerView], camera: Camera, matched: Matches, found: MountEstimate, noise: Noise
) -> float:
    """Return the standard error of the delay, from the likelihood of nearby delays.

    At the best delay the likelihood may be narrower than overall. A short flight has a few quick
    tilts, and each one pulls the delay to its own optimum.
    """
    std_s = float(np.sqrt(found.covariance[3, 3]))
    widest_s = std_s
    for apart in PROBE_SIGMAS:
        beside = found.values + np.array([0.0, 0.0, 0.0, apart * std_s])
        cost = solve_mount(
            views, camera, matched, beside, noise, found.spread_px, fix_delay=True
        ).cost
        worse = max(cost - found.cost, MIN_COST_INCREASE)
        widest_s = max(widest_s, abs(apart) * std_s / float(np.sqrt(2 * worse)))
    sample_s = max(float(np.median(np.diff(flight.attitude_s))) for flight, _ in views)
    return float(np.hypot(widest_s, SAMPLING_STD_SHARE * sample_s))


def _check_unambiguous(ends: Sequence[MountEstimate]) -> None:
    """Raise SettingError if another delay is about as likely as the best."""
    best = ends[0]
    for other in ends[1:]:
        apart_s = abs(float(other.values[3] - best.values[3]))
        if other.cost < best.cost + MIN_LOG_LIKELIHOOD_GAP and apart_s > SAME_DELAY_S:
            raise SettingError(
                f"delays of {1e3 * best.values[3]:.0f} and {1e3 * other.values[3]:.0f} ms explain "
                "the images alike. Add flights, best with peers that cross the image faster"
            )


def _check_within_limits(values: Array, std: Array) -> None:
    """Raise SettingError if a value reaches the end of its range, where the solution only stops."""
    for name, value, spread, limit in zip(VALUE_NAMES, values, std, MAX_VALUES, strict=True):
        if abs(value) + spread > limit:
            unit, scale = ("ms", 1e3) if name == "delay" else ("degrees", np.degrees(1.0))
            raise SettingError(
                f"the {name} comes out at {scale * value:.0f} {unit}, the end of what is searched "
                f"({scale * limit:.0f}). Check the intrinsics (--camera) and the clocks"
            )
