"""Camera updates of the keyframe filters, with the candidate nearest to each filter."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from dmrl.estimation.model.bearings import difference
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.camera_residuals import Looks, toward

LOOK_S = 0.4
"""Interval between the images of either camera that are used, seconds. No record of how the value
was chosen."""
LOOK_STD: Array = np.array([0.05, 0.05, 0.05])
"""Added standard deviations of azimuth, elevation (rad) and log distance. An image is up to 0.05 s
from its keyframe."""
LOOK_GATE = 16.0
"""Gate on the squared distance of a candidate that updates a filter: four standard deviations. No
record of how the value was chosen."""


@dataclass(frozen=True, slots=True)
class Glance:
    """Image of one pair, for the filters of that pair. C candidates.

    Parameters
    ----------
    keyframe
        Keyframe nearest to the image.
    observer_sign
        1 for the observer's camera, -1 for the peer's.
    bearing, std
        (C, 3) azimuth, elevation (rad), log distance of the candidates, as measured from the
        keyframe.
    first_filter, copies
        First filter of the pair, and the number of its filters.
    """

    key: int
    side: float
    polar: Array
    std: Array
    first: int
    copies: int = 1


Glances = Mapping[int, Sequence[Glance]]
"""Camera updates by keyframe."""
NOTHING: Glances = MappingProxyType({})
"""No camera updates."""


def glances_of(looks: Sequence[Looks | None]) -> Glances:
    """Select camera updates from the images of several pairs.

    Parameters
    ----------
    cameras
        Camera measurements of each pair.
    """
    out: dict[int, list[Glance]] = {}
    for number, mine in enumerate(looks):
        for glance in [] if mine is None else _glances(mine, number):
            out.setdefault(glance.key, []).append(glance)
    return out


def repeated(glances: Glances, copies: int) -> Glances:
    """Return the updates for ``copies`` filters side by side for every pair."""
    return {
        key: [replace(glance, first=glance.first * copies, copies=copies) for glance in here]
        for key, here in glances.items()
    }


def _glances(looks: Looks, number: int) -> list[Glance]:
    """Return the updates of one pair, each at the keyframe nearest to its image."""
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
    """Update filters in place with the candidate of an image that is nearest to each.

    The update uses the azimuth alone. A filter far from every candidate stays as it is.
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
