"""What cameras saw, beside the ranges of one solve: bearings and distances of candidates.

An image shows some candidates; one of them may be the other robot, another one another robot or
nothing at all. At every linearisation the candidate of an image counts that lies nearest to the
solution, with one Cauchy loss for its three numbers, so that what fits nowhere hardly counts.

Azimuths tell what ranges do not. Distances and elevations mostly tell which candidate it is: their
errors, of a network's scale, of heights and of attitudes, last for the whole flight, so all images
of a camera together tell of the place what one of them would.
"""

from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.bearings import AGREES, difference, within
from dmrl.estimation.model.pair import Array, Mask, Pair

ALIKE_S = 0.3
"""Errors of a network last while it sees the same: images of this time count as one together."""
KNOWN = 9.0
"""Squares of elevation and distance beyond which they make a candidate count less, in full."""
TRUSTED, LEAST = 0.25, 10
"""A camera counts where so large a share of its images, and so many, agree with the solution.
Images of other things agree with a wrong one too, by chance: one in twenty was seen to."""
FAR, OPEN_RAD = 25.0, 0.05
"""Squared distance beyond which an image shows something else and pulls no more, with what a solve
that goes on may be off by in azimuth besides."""
LIMIT = 4.0
"""Squared distance of a candidate, in its sigmas, at which it counts half."""


@dataclass(frozen=True, slots=True)
class Looks:
    """The images of both cameras of a pair that show a candidate. I images, up to C candidates.

    Parameters
    ----------
    time_s
        (I,) when they were taken, ascending, seconds.
    key
        (I,) keyframe before each.
    part
        (I,) of the way from there to the next one.
    side
        (I,) 1 where the observer saw, -1 where the peer did.
    height_m
        (I,) peer's height less the observer's, metres.
    share
        (I,) by how much an image counts.
    lasting
        (I,) by how much its elevation and distance do besides.
    polar, std
        (I, C, 3) azimuth, elevation (rad) and log distance of the candidates, NaN where there
        are no more; and their standard deviations.
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
    """Looks at one solution."""

    rows: Array
    """(I, 3, 4) whitened Jacobians by x, y, psi, and the residual, of each image's nearest."""
    beyond: Array
    """(I,) squared distance in elevation and distance that tells nothing of the place."""
    share: Array
    """(I,) by how much each counts."""

    @property
    def squared(self) -> Array:
        """(I,) squared distances."""
        return np.asarray((self.rows[..., -1] ** 2).sum(axis=1) + self.beyond)


def looks_of(pair: Pair, key_s: Array, height_std_m: float) -> Looks | None:
    """Both cameras' images of a pair; None where there are none.

    Parameters
    ----------
    pair
        What both measured and saw.
    key_s
        (K,) times of the keyframes, seconds.
    height_std_m
        Error of the difference of heights, metres.
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
    polar, std = (
        np.concatenate([_padded(getattr(s, name), count) for s, _ in sides])[order]
        for name in ("polar", "std")
    )
    # An elevation tells as much as the heights that it is held against.
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
    """(I, count, 3) of (I, C, 3), NaN behind."""
    missing = count - values.shape[1]
    return np.asarray(np.pad(values, ((0, 0), (0, missing), (0, 0)), constant_values=np.nan))


def _shares(time_s: Array) -> Array:
    """(I,) one over the number of images around each that see the same."""
    around = [np.searchsorted(time_s, time_s + s * ALIKE_S / 2) for s in (-1, 1)]
    return np.asarray(1 / np.maximum(around[1] - around[0], 1))


def expected(looks: Looks, state: Array) -> tuple[Array, Array]:
    """Where the robot that looks should see the other, as `toward`, at the time of each image.

    Parameters
    ----------
    looks
        Of I images.
    state
        (K, 6) x, y (m), psi (rad), ...
    """
    part = looks.part[:, None]
    at = (1 - part) * state[looks.key, :3] + part * state[looks.key + 1, :3]
    return toward(at, looks.side, looks.height_m)


def toward(at: Array, side: Array, height_m: Array) -> tuple[Array, Array]:
    """Where one robot of a pair should see the other.

    Parameters
    ----------
    at
        (N, 3) x, y (m), psi (rad) of the peer in its observer's frame.
    side
        (N,) 1 where the observer looks, -1 where the peer does.
    height_m
        (N,) peer's height less the observer's, metres.

    Returns
    -------
    polar : Array
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
    """Each image's nearest candidate at a solution.

    Parameters
    ----------
    looks
        Of I images.
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
    """(I, C, 3) how far candidates are off, in sigmas; (I,) the nearest, (I,) its square."""
    off = difference(looks.polar, polar[:, None]) / looks.std
    squared = (off**2).sum(axis=-1)
    squared[np.isnan(squared)] = np.inf
    return off, np.asarray(squared.argmin(axis=1)), np.asarray(squared.min(axis=1))


def picked(looks: Looks, state: Array) -> Looks:
    """The looks with each image's nearest candidate alone.

    Parameters
    ----------
    looks
        Of I images.
    state
        (K, 6) the solution.
    """
    at = _candidates(looks, expected(looks, state)[0])[1][:, None, None]
    polar, std = (np.take_along_axis(v, at, axis=1) for v in (looks.polar, looks.std))
    return replace(looks, polar=polar, std=std)


def _squared(looks: Looks, state: Array) -> Array:
    """(I,) squared distance of each image's nearest candidate from a solution."""
    return _candidates(looks, expected(looks, state)[0])[2]


def trusted(looks: Looks | None, state: Array) -> Looks | None:
    """The images of those cameras of which enough agree with a solution; None where none do.

    Images that are far off are left out: where ranges tell little, each would still pull.

    Parameters
    ----------
    looks
        Of a flight.
    state
        (K, 6) its solution.
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
    """(K,) keyframes near which a robot's camera saw the other where a solution has it.

    Parameters
    ----------
    looks
        Of a flight.
    state
        (K, 6) its solution.
    side
        1: the observer's camera, -1: the peer's.
    key_s
        (K,) times of the keyframes, seconds.
    within_s
        How near, seconds.
    """
    if looks is None:
        return np.zeros(len(key_s), bool)
    good = (_squared(looks, state) < AGREES) & (looks.side == side)
    at_s = np.concatenate([[-np.inf], looks.time_s[good], [np.inf]])
    after = np.searchsorted(at_s, key_s)
    return np.asarray(np.minimum(at_s[after] - key_s, key_s - at_s[after - 1]) <= within_s)
