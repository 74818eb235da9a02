"""Camera updates of the keyframe filters, with the candidate nearest to each filter."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from dmrl.estimation.model.bearings import subtract_bearings
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.camera_residuals import CameraMeasurements, bearing_to_peer

UPDATE_INTERVAL_S = 0.4
"""Interval between the images of either camera that are used, seconds. No record of how the value
was chosen."""
KEYFRAME_OFFSET_STD: Array = np.array([0.05, 0.05, 0.05])
"""Added standard deviations of azimuth, elevation (rad) and log distance. An image is up to 0.05 s
from its keyframe."""
UPDATE_GATE = 16.0
"""Gate on the squared distance of a candidate that updates a filter: four standard deviations. No
record of how the value was chosen."""


@dataclass(frozen=True, slots=True)
class CameraUpdate:
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

    keyframe: int
    observer_sign: float
    bearing: Array
    std: Array
    first_filter: int
    copies: int = 1


CameraUpdates = Mapping[int, Sequence[CameraUpdate]]
"""Camera updates by keyframe."""
NO_UPDATES: CameraUpdates = MappingProxyType({})
"""No camera updates."""


def camera_updates(cameras: Sequence[CameraMeasurements | None]) -> CameraUpdates:
    """Select camera updates from the images of several pairs.

    Parameters
    ----------
    cameras
        Camera measurements of each pair.
    """
    out: dict[int, list[CameraUpdate]] = {}
    for number, mine in enumerate(cameras):
        for glance in [] if mine is None else _pair_updates(mine, number):
            out.setdefault(glance.keyframe, []).append(glance)
    return out


def repeat_updates(updates: CameraUpdates, copies: int) -> CameraUpdates:
    """Return the updates for ``copies`` filters side by side for every pair."""
    return {
        key: [
            replace(glance, first_filter=glance.first_filter * copies, copies=copies)
            for glance in here
        ]
        for key, here in updates.items()
    }


def _pair_updates(camera: CameraMeasurements, number: int) -> list[CameraUpdate]:
    """Return the updates of one pair, each at the keyframe nearest to its image."""
    out = []
    for side in (1.0, -1.0):
        last_s = -np.inf
        for k in np.flatnonzero(camera.observer_sign == side).tolist():
            if camera.time_s[k] < last_s + UPDATE_INTERVAL_S:
                continue
            last_s = camera.time_s[k]
            there = np.isfinite(camera.bearing[k, :, 0])
            std = np.hypot(camera.std[k, there], KEYFRAME_OFFSET_STD)
            key = int(camera.keyframe[k] + (camera.fraction[k] > 0.5))
            out.append(CameraUpdate(key, side, camera.bearing[k, there], std, number))
    return out


def update_with_camera(
    state: Array, covariance: Array, height_m: Array, update: CameraUpdate, log_likelihood: Array
) -> None:
    """Update filters in place with the candidate of an image that is nearest to each.

    The update uses the azimuth alone. A filter far from every candidate stays as it is.
    """
    polar, slope = bearing_to_peer(
        state[:, :3], np.full(len(state), update.observer_sign), height_m
    )
    row, farther = slope[:, 0], slope[:, 2, :2]
    cross = np.einsum("bij,bj->bi", covariance[..., :3], row)
    spread = np.zeros((len(state), 1, 3))
    spread[:, 0, 0] = np.einsum("bi,bi->b", row, cross[:, :3])
    spread[:, 0, 2] = np.einsum("bi,bij,bj->b", farther, covariance[:, :2, :2], farther)
    spread = spread + update.std**2
    off = subtract_bearings(update.bearing, polar[:, None])
    squared = (off**2 / spread).sum(axis=2)
    nearest, filters = squared.argmin(axis=1), np.arange(len(state))
    least, variance = squared[filters, nearest], spread[filters, nearest, 0]
    log_likelihood -= 0.5 * np.log(variance) + np.log1p(0.5 * least)
    gain = np.where(least < UPDATE_GATE, 1 / variance, 0.0)[:, None] * cross
    state += gain * off[filters, nearest, :1]
    covariance -= gain[:, :, None] * cross[:, None, :]
