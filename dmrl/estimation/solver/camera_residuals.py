"""Camera bearings and distances as residuals of the pair solver.

An image contains several candidates. One of them may be the peer; others are other robots or false
detections. Every linearization uses the candidate nearest to the solution, with one Cauchy loss for
its three values. A candidate that fits nowhere then hardly counts.

Azimuths add information that ranges lack. Distances and elevations mainly select the candidate.
Their errors (scale of a network, heights, attitudes) last for the whole flight, so all images of a
camera together inform the position as much as a single one.
"""

from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.bearings import AGREES, difference, within
from dmrl.estimation.model.pair import Array, Mask, Pair

ALIKE_S = 0.3
"""Time over which a network repeats its errors, seconds. The images in it count as one. No record
of how the value was chosen."""
KNOWN = 9.0
"""Largest square of the elevation and distance residual that is down-weighted as correlated. The
excess counts in full as mismatch of the candidate. Three standard deviations; no other record of
how the value was chosen."""
TRUSTED, LEAST = 0.25, 10
"""Smallest share, and smallest number, of consistent images of a camera that is used. Images of
other objects also agree with a wrong solution by chance: one in twenty did. No record of how the
values were chosen."""
FAR, OPEN_RAD = 25.0, 0.05
"""Squared distance beyond which an image is an outlier without weight; and azimuth error of an
unfinished solve that is added, radians. Added because wrong detections bent flights that a camera
rarely covers."""
LIMIT = 4.0
"""Loss scale: squared distance of a candidate, in standard deviations, at which it has half its
weight. No record of how the value was chosen."""


@dataclass(frozen=True, slots=True)
class Looks:
    """Bearing measurements of both cameras of a pair. I images, up to C candidates.

    Parameters
    ----------
    time_s
        (I,) capture times, ascending, seconds.
    keyframe
        (I,) keyframe before each.
    fraction
        (I,) fraction of the interval from there to the next one.
    observer_sign
        (I,) 1 for the observer's camera, -1 for the peer's.
    height_m
        (I,) peer's height minus the observer's, metres.
    weight
        (I,) weight of an image among those with the same errors.
    correlated_weight
        (I,) further weight of its elevation and distance.
    bearing, std
        (I, C, 3) azimuth, elevation (rad) and log distance of the candidates, NaN where there are
        fewer; and their standard deviations.
    """

    time_s: Array
    key: NDArray[np.intp]
    part: Array
    side: Array
    height_m: Array
    share: Array
    lasting: Array
    polar: Array
    std: Array


class Seen(NamedTuple):
    """Whitened camera residuals and Jacobians at one solution."""

    rows: Array
    """(I, 3, 4) Jacobians by x, y, psi, and the residual, of each image's nearest candidate."""
    beyond: Array
    """(I,) squared distance in elevation and log distance that does not inform the position."""
    share: Array
    """(I,) weight of each image."""

    @property
    def squared(self) -> Array:
        """(I,) squared distances."""
        return np.asarray((self.rows[..., -1] ** 2).sum(axis=1) + self.beyond)


def looks_of(pair: Pair, key_s: Array, height_std_m: float) -> Looks | None:
    """Collect the images of both cameras of a pair; None if there are none.

    Parameters
    ----------
    pair
        Sensor data and bearings of both robots.
    keyframe_s
        (K,) times of the keyframes, seconds.
    height_std_m
        Standard deviation of the height difference, metres.
    """
    both = (within(s, pair.time_s[0], pair.time_s[-1]) for s in (pair.own_sees, pair.peer_sees))
    sides = [(s, sign) for s, sign in zip(both, (1, -1), strict=True) if s and len(s.time_s)]
    if not sides:
        return None
    count = max(s.polar.shape[1] for s, _ in sides)
    time_s = np.concatenate([s.time_s for s, _ in sides])
    order = np.argsort(time_s, kind="stable")
    time_s = time_s[order]
    side = np.concatenate([np.full(len(s.time_s), float(sign)) for s, sign in sides])[order]
    polar = np.concatenate([_padded(s.polar, count) for s, _ in sides])[order]
    std = np.concatenate([_padded(s.std, count) for s, _ in sides])[order]
    # The elevation residual also contains the error of the height difference.
    std[..., 1] = np.hypot(std[..., 1], height_std_m / np.exp(polar[..., 2]))
    place = np.interp(time_s, key_s, np.arange(len(key_s)))
    key = np.minimum(place.astype(np.intp), len(key_s) - 2)
    share = np.concatenate([_shares(s.time_s) for s, _ in sides])[order]
    lasting = np.where(
        side > 0, *(1 / max(float(share[side == sign].sum()), 1.0) for sign in (1, -1))
    )
    height = pair.peer.height_m - pair.own.height_m
    return Looks(
        time_s,
        key,
        place - key,
        side,
        np.interp(time_s, pair.time_s, height),
        share,
        lasting,
        polar,
        std,
    )


def _padded(values: Array, count: int) -> Array:
    """Pad (I, C, 3) with NaN to (I, count, 3)."""
    missing = count - values.shape[1]
    return np.asarray(np.pad(values, ((0, 0), (0, missing), (0, 0)), constant_values=np.nan))


def _shares(time_s: Array) -> Array:
    """Return (I,) one over the number of images near each that share its errors."""
    around = [np.searchsorted(time_s, time_s + s * ALIKE_S / 2) for s in (-1, 1)]
    return np.asarray(1 / np.maximum(around[1] - around[0], 1))


def expected(looks: Looks, state: Array) -> tuple[Array, Array]:
    """Predict bearings and log distances of a solution, at the time of each image.

    Parameters
    ----------
    camera
        Measurements of I images.
    state
        (K, 6) x, y (m), psi (rad), ...

    Returns
    -------
    bearing, slope : Array
        As in `bearing_to_peer`.
    """
    part = looks.part[:, None]
    at = (1 - part) * state[looks.key, :3] + part * state[looks.key + 1, :3]
    return toward(at, looks.side, looks.height_m)


def toward(at: Array, side: Array, height_m: Array) -> tuple[Array, Array]:
    """Return the bearing and log distance from one robot of a pair to the other.

    Parameters
    ----------
    pose
        (N, 3) x, y (m), psi (rad) of the peer in its observer's frame.
    observer_sign
        (N,) 1 for the observer's camera, -1 for the peer's.
    height_m
        (N,) peer's height minus the observer's, metres.

    Returns
    -------
    bearing : Array
        (N, 3) azimuth, elevation (rad), log distance.
    slope : Array
        (N, 3, 3) their derivatives by x, y, psi.
    """
    x, y = (at[:, :2] * side[:, None]).T
    level2 = np.maximum(x * x + y * y, 1e-6)
    up = side * height_m
    square, level = level2 + up * up, np.sqrt(level2)
    heading = np.where(side < 0, at[:, 2], 0.0)
    polar = np.column_stack([np.arctan2(y, x) - heading, np.arctan2(up, level), np.log(square) / 2])
    slope = np.zeros((len(at), 3, 3))
    slope[:, 0, 0], slope[:, 0, 1] = -y / level2, x / level2
    slope[:, 1, 0], slope[:, 1, 1] = -x * up / (level * square), -y * up / (level * square)
    slope[:, 2, 0], slope[:, 2, 1] = x / square, y / square
    slope[:, :, :2] *= side[:, None, None]
    slope[:, 0, 2] = -1.0 * (side < 0)
    return polar, slope


def seen(looks: Looks, state: Array) -> Seen:
    """Linearize each image's nearest candidate at a solution.

    Parameters
    ----------
    camera
        Measurements of I images.
    state
        (K, 6) x, y (m), psi (rad), ...
    """
    polar, slope = expected(looks, state)
    off, nearest, _ = _candidates(looks, polar)
    images = np.arange(len(nearest))
    rows = np.empty((len(nearest), 3, 4))
    rows[..., :3] = -slope / looks.std[images, nearest][..., None]
    rows[..., 3] = off[images, nearest]
    squared = rows[:, 1:, 3] ** 2
    within = np.minimum(1.0, np.sqrt(KNOWN / np.maximum(squared, KNOWN)))
    rows[:, 1:, 3] *= within
    rows[:, 1:] *= np.sqrt(looks.lasting)[:, None, None]
    beyond = np.maximum(squared - KNOWN, 0.0).sum(axis=1)
    most = FAR * (1 + (OPEN_RAD / looks.std[images, nearest, 0]) ** 2)
    lost = (rows[..., 3] ** 2).sum(axis=1) + beyond > most
    rows[lost], beyond[lost] = 0.0, most[lost]
    return Seen(rows, beyond, looks.share)


def _candidates(looks: Looks, polar: Array) -> tuple[Array, NDArray[np.intp], Array]:
    """Return whitened residuals (I, C, 3), index of the nearest (I,) and its square (I,)."""
    off = difference(looks.polar, polar[:, None]) / looks.std
    squared = (off**2).sum(axis=-1)
    squared[np.isnan(squared)] = np.inf
    return off, np.asarray(squared.argmin(axis=1)), np.asarray(squared.min(axis=1))


def picked(looks: Looks, state: Array) -> Looks:
    """Keep the candidate of each image that is nearest to a solution.

    Parameters
    ----------
    camera
        Measurements of I images.
    state
        (K, 6) states of the solution.
    """
    at = _candidates(looks, expected(looks, state)[0])[1][:, None, None]
    polar, std = (np.take_along_axis(v, at, axis=1) for v in (looks.polar, looks.std))
    return replace(looks, polar=polar, std=std)


def _squared(looks: Looks, state: Array) -> Array:
    """Return (I,) squared distance of each image's nearest candidate from a solution."""
    return _candidates(looks, expected(looks, state)[0])[2]


def trusted(looks: Looks | None, state: Array) -> Looks | None:
    """Return the images of cameras consistent with the solution, or None.

    Outlier images are removed: where the ranges inform little, each of them would still bend it.

    Parameters
    ----------
    camera
        Measurements of a flight.
    state
        (K, 6) states of the solution.
    """
    if looks is None:
        return None
    squared, kept = _squared(looks, state), np.zeros(len(looks.side), bool)
    agree = squared < AGREES
    for side in (1, -1):
        mine = looks.side == side
        if agree[mine].sum() >= max(LEAST, TRUSTED * mine.sum()):
            kept |= mine & (squared < FAR)
    if kept.all() or not kept.any():
        return looks if kept.any() else None
    return Looks(*(getattr(looks, field.name)[kept] for field in fields(looks)))


def agreeing(looks: Looks | None, state: Array, side: int, key_s: Array, within_s: float) -> Mask:
    """Return (K,) keyframes near an image of one camera that is consistent with a solution.

    Parameters
    ----------
    camera
        Measurements of a flight.
    state
        (K, 6) states of the solution.
    observer_sign
        1 for the observer's camera, -1 for the peer's.
    keyframe_s
        (K,) times of the keyframes, seconds.
    within_s
        Largest time difference, seconds.
    """
    if looks is None:
        return np.zeros(len(key_s), bool)
    good = (_squared(looks, state) < AGREES) & (looks.side == side)
    at_s = np.concatenate([[-np.inf], looks.time_s[good], [np.inf]])
    after = np.searchsorted(at_s, key_s)
    return np.asarray(np.minimum(at_s[after] - key_s, key_s - at_s[after - 1]) <= within_s)
