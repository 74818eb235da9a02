"""What cameras saw, for the filters that tell starts apart: some images, whatever fits best."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from dmrl.estimation.model.bearings import difference
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.camera_residuals import Looks, toward

LOOK_S = 0.4
"""One image of either camera in so long a time is looked at."""
LOOK_STD: Array = np.array([0.05, 0.05, 0.05])
"""Of azimuth, elevation and log distance, as the image is up to 0.05 s from the keyframe."""
LOOK_GATE = 16.0
"""Squared distance within which a candidate moves a filter."""


@dataclass(frozen=True, slots=True)
class Glance:
    """An image of one pair, for the filters of that pair. C candidates.

    Parameters
    ----------
    key
        Keyframe.
    side
        1 where the observer saw, -1 where the peer did.
    polar, std
        (C, 3) azimuth, elevation (rad), log distance of the candidates seen at the keyframe.
    first, copies
        First filter of the pair, and how many there are.
    """

    key: int
    side: float
    polar: Array
    std: Array
    first: int
    copies: int = 1


Glances = Mapping[int, Sequence[Glance]]
"""By keyframe."""
NOTHING: Glances = MappingProxyType({})


def glances_of(looks: Sequence[Looks | None]) -> Glances:
    """Some images of several pairs.

    Parameters
    ----------
    looks
        What the cameras of each pair saw.
    """
    out: dict[int, list[Glance]] = {}
    for number, mine in enumerate(looks):
        for glance in [] if mine is None else _glances(mine, number):
            out.setdefault(glance.key, []).append(glance)
    return out


def repeated(glances: Glances, copies: int) -> Glances:
    """The same for filters that stand ``copies`` times side by side for every pair."""
    return {
        key: [replace(glance, first=glance.first * copies, copies=copies) for glance in here]
        for key, here in glances.items()
    }


def _glances(looks: Looks, number: int) -> list[Glance]:
    """Some images of a pair, each at the keyframe next to it."""
    out = []
    for side in (1.0, -1.0):
        last_s = -np.inf
        for k in np.flatnonzero(looks.side == side).tolist():
            if looks.time_s[k] < last_s + LOOK_S:
                continue
            last_s = looks.time_s[k]
            there = np.isfinite(looks.polar[k, :, 0])
            std = np.hypot(looks.std[k, there], LOOK_STD)
            key = int(looks.key[k] + (looks.part[k] > 0.5))
            out.append(Glance(key, side, looks.polar[k, there], std, number))
    return out


def glanced(
    state: Array, covariance: Array, height_m: Array, glance: Glance, log_likelihood: Array
) -> None:
    """Put the candidate of an image in that is nearest to each filter, in place.

    It moves a filter by its azimuth alone, and none that is far from it.
    """
    polar, slope = toward(state[:, :3], np.full(len(state), glance.side), height_m)
    row, farther = slope[:, 0], slope[:, 2, :2]
    cross = np.einsum("bij,bj->bi", covariance[..., :3], row)
    spread = np.zeros((len(state), 1, 3))
    spread[:, 0, 0] = np.einsum("bi,bi->b", row, cross[:, :3])
    spread[:, 0, 2] = np.einsum("bi,bij,bj->b", farther, covariance[:, :2, :2], farther)
    spread = spread + glance.std**2
    off = difference(glance.polar, polar[:, None])
    squared = (off**2 / spread).sum(axis=2)
    nearest, filters = squared.argmin(axis=1), np.arange(len(state))
    least, variance = squared[filters, nearest], spread[filters, nearest, 0]
    log_likelihood -= 0.5 * np.log(variance) + np.log1p(0.5 * least)
    gain = np.where(least < LOOK_GATE, 1 / variance, 0.0)[:, None] * cross
    state += gain * off[filters, nearest, :1]
    covariance -= gain[:, :, None] * cross[:, None, :]
