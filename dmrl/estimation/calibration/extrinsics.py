"""How a camera is mounted, and how late its images are stamped, from flights. Arrays only.

The network says where a peer is in the image; ranges and odometry say where it is in the
horizontal frame. What is left between the two, over a whole flight, is the mount's rotation and
the clock's offset: the bias that Li et al. saw in their labels and left there. Which detection is
of which peer depends on both, so several delays are tried, the best is refined, and where two
explain the images alike neither is believed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from dmrl.errors import SettingError
from dmrl.estimation.calibration.mount_solver import LARGEST, Mount, slopes_of, solve
from dmrl.estimation.calibration.observations import (
    Flight,
    Matched,
    Noise,
    View,
    match,
    median_px,
    mounted,
    residual,
)
from dmrl.geometry.frames import Array, Camera

TRIED_S = np.arange(-5, 6) * 0.08
"""Delays that are tried: their images of a peer that crosses the view still overlap."""
TRIED_IMAGES = 600
"""Images, of all peers and flights, that tell a good start from a bad one."""
WIDE_PX, RADII_PX = 60.0, (60.0, 60.0)
"""How far a detection may be from where its peer is expected: at first, and round by round."""
WORST = 9.0
"""Squared residual, whitened, of a detection that is nobody's."""
ALIKE = 0.1
"""Tries that fit worse by more than this share are not refined."""
REFINED = 4
"""Tries that are refined at most."""
SAME_S = 0.015
"""Delays so near to each other are one."""
LIKELY = 4.0
"""Two delays are not told apart if their log-likelihoods differ by less: one in fifty."""
ASIDE, LEAST_WORSE = (-4.0, -2.0, 2.0, 4.0), 0.1
"""Standard errors aside at which the likelihood is asked how wide it is."""
SAMPLED = 0.25
"""Share of the time between two samples of attitude that no delay is better known than."""
LEAST = 50
"""Fewest matched detections that are worth a calibration."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """The camera, and how well it is known.

    Parameters
    ----------
    camera
        With its mount and delay.
    mount_std_rad
        (3,) standard errors of roll, pitch and yaw. Errors of positions last for seconds, and
        partly for a flight (`dmrl.estimation.calibration.mount_solver`): a count of images would promise too much.
    delay_std_s
        Of the delay: at least a small share of a sample of attitude.
    matched
        How many detections were used.
    before_px, after_px
        Median distance of those from where their peers were expected.
    """

    camera: Camera
    mount_std_rad: tuple[float, float, float]
    delay_std_s: float
    matched: int
    before_px: float
    after_px: float


@dataclass(frozen=True, slots=True)
class _Try:
    """Where one start ended: mount and delay, and how badly the images fit, from 0 to `WORST`."""

    values: Array
    misfit: float


def calibrate(flights: Sequence[Flight], camera: Camera, noise: Noise) -> Calibration | None:
    """The mount's rotation and the delay; None where too few detections fit.

    Parameters
    ----------
    flights
        Detections, attitude, and positions of the peers.
    camera
        Intrinsics, and the mount and delay to start from.
    noise
        Of detections and attitude.

    Raises
    ------
    SettingError
        If two delays explain the images alike.
    """
    smooth = [flight.smoothed() for flight in flights]
    views = [(flight, peer) for flight in smooth for peer in flight.peers.values()]
    if not views:
        return None
    start = np.array([*camera.mount_rad, camera.delay_s])
    tries = _tries(views, camera, start, noise)
    if not tries:
        return None
    ends = _ends(views, camera, tries, noise)
    if not ends:
        return None
    found, matched = ends[0]
    _refuse_alike([end for end, _ in ends])
    spread = np.sqrt(np.diag(found.covariance))
    return Calibration(
        mounted(camera, found.values),
        (float(spread[0]), float(spread[1]), float(spread[2])),
        _delay_std_s(views, camera, matched, found, noise),
        len(matched.time_s),
        median_px(views, camera, matched, start),
        median_px(views, camera, matched, found.values),
    )


def _tries(views: Sequence[View], camera: Camera, start: Array, noise: Noise) -> list[_Try]:
    """Where each start ends, the best first."""
    found = []
    views = [(flight.thinned(TRIED_IMAGES // len(views)), peer) for flight, peer in views]
    for delay_s in (start[3], *TRIED_S):
        values = np.array([*start[:3], delay_s])
        matched = match(views, mounted(camera, values), WIDE_PX, noise)
        if len(matched.time_s) >= LEAST:
            values = _rough(views, camera, matched, values)
            found.append(_Try(values, _misfit(views, camera, values, noise)))
    return sorted(found, key=lambda one: one.misfit)


def _misfit(views: Sequence[View], camera: Camera, values: Array, noise: Noise) -> float:
    """Mean squared residual of the images in which a peer is expected, each at most `WORST`.

    A start that explains few images well must not beat one that explains most: an image without
    a detection near counts as the worst there is.
    """
    matched = match(views, mounted(camera, values), WIDE_PX, noise)
    apart = (matched.whiten @ residual(views, camera, matched, values)[..., None])[..., 0]
    missed = matched.expected - len(apart)
    fits = np.minimum((apart**2).sum(axis=1), WORST).sum()
    return float((fits + WORST * missed) / max(matched.expected, 1))


def _rough(views: Sequence[View], camera: Camera, matched: Matched, start: Array) -> Array:
    """(4,) mount and delay of the greatest likelihood, were all errors of single images."""

    def white(values: Array) -> Array:
        apart = residual(views, camera, matched, values)
        return np.asarray((matched.whiten @ apart[..., None]).ravel())

    def slopes(values: Array) -> Array:
        found = slopes_of(views, camera, matched, values)
        return np.asarray(-(matched.whiten @ found).reshape(-1, 4))

    start = np.clip(start, -0.99 * LARGEST, 0.99 * LARGEST)
    found = least_squares(
        white, start, slopes, bounds=(-LARGEST, LARGEST), loss="cauchy", xtol=1e-4, max_nfev=10
    )
    return np.asarray(found.x)


def _apart(tries: Sequence[_Try]) -> list[_Try]:
    """The best tries, of each delay one."""
    kept: list[_Try] = []
    for one in tries:
        alone = all(abs(one.values[3] - other.values[3]) > SAME_S for other in kept)
        if alone and one.misfit < tries[0].misfit * (1 + ALIKE):
            kept.append(one)
    return kept[:REFINED]


def _ends(
    views: Sequence[View], camera: Camera, tries: Sequence[_Try], noise: Noise
) -> list[tuple[Mount, Matched]]:
    """Where the best tries end, the likeliest first.

    How far off single detections are is what is left of them at the likeliest end; all are then
    solved, and held against each other, with that.
    """
    spread_px = float(np.hypot(noise.pixel_std_px, noise.attitude_std_rad * camera.fx_px))
    refined = [_refined(views, camera, one, noise, spread_px) for one in _apart(tries)]
    ends = sorted((end for end in refined if end is not None), key=lambda end: end[0].cost)
    again = [
        (solve(views, camera, matched, end.values, noise, ends[0][0].spread_px), matched)
        for end, matched in ends
    ]
    return sorted(again, key=lambda end: end[0].cost)


def _refined(
    views: Sequence[View], camera: Camera, one: _Try, noise: Noise, spread_px: float
) -> tuple[Mount, Matched] | None:
    """One start, matched again as it gets better; None where too few detections are near."""
    values, end = one.values, None
    for radius_px in RADII_PX:
        matched = match(views, mounted(camera, values), radius_px, noise)
        if len(matched.time_s) < LEAST:
            return None
        found = solve(views, camera, matched, values, noise, spread_px)
        values, end = found.values, (found, matched)
    return end


def _delay_std_s(
    views: Sequence[View], camera: Camera, matched: Matched, found: Mount, noise: Noise
) -> float:
    """Standard error of the delay: by how much worse others explain the images.

    At the best delay alone the likelihood may be sharper than it is wide: a short flight has a few
    quick tilts, and each draws the delay to where it fits that one.
    """
    std_s = float(np.sqrt(found.covariance[3, 3]))
    widest_s = std_s
    for apart in ASIDE:
        beside = found.values + np.array([0.0, 0.0, 0.0, apart * std_s])
        cost = solve(views, camera, matched, beside, noise, found.spread_px, held=True).cost
        worse = max(cost - found.cost, LEAST_WORSE)
        widest_s = max(widest_s, abs(apart) * std_s / float(np.sqrt(2 * worse)))
    sample_s = max(float(np.median(np.diff(flight.attitude_s))) for flight, _ in views)
    return float(np.hypot(widest_s, SAMPLED * sample_s))


def _refuse_alike(ends: Sequence[Mount]) -> None:
    """Refuse where a start ended at another delay that is about as likely."""
    best = ends[0]
    for other in ends[1:]:
        apart_s = abs(float(other.values[3] - best.values[3]))
        if other.cost < best.cost + LIKELY and apart_s > SAME_S:
            raise SettingError(
                f"delays of {1e3 * best.values[3]:.0f} and {1e3 * other.values[3]:.0f} ms explain "
                "the images alike. Calibrate with more flights, or such in which peers cross "
                "the view faster"
            )
