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

from dmrl.estimation.model.bearings import ASSOCIATION_GATE, crop_to_time, subtract_bearings
from dmrl.estimation.model.pair import Array, Mask, Pair

CORRELATION_S = 0.3
"""Time over which a network repeats its errors, seconds. The images in it count as one. No record
of how the value was chosen."""
MAX_CORRELATED_SQUARE = 9.0
"""Largest square of the elevation and distance residual that is down-weighted as correlated. The
excess counts in full as mismatch of the candidate. Three standard deviations; no other record of
how the value was chosen."""
MIN_CONSISTENT_SHARE, MIN_CONSISTENT_IMAGES = 0.25, 10
"""Smallest share, and smallest number, of consistent images of a camera that is used. Images of
other objects also agree with a wrong solution by chance: one in twenty did. No record of how the
values were chosen."""
OUTLIER_SQUARED_DISTANCE, AZIMUTH_MARGIN_RAD = 25.0, 0.05
"""Squared distance beyond which an image is an outlier without weight; and azimuth error of an
unfinished solve that is added, radians. Added because wrong detections bent flights that a camera
rarely covers."""
BEARING_LOSS_SCALE = 4.0
"""Loss scale: squared distance of a candidate, in standard deviations, at which it has half its
weight. No record of how the value was chosen."""


@dataclass(frozen=True, slots=True)
class CameraMeasurements:
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
    keyframe: NDArray[np.intp]
    fraction: Array
    observer_sign: Array
    height_m: Array
    weight: Array
    correlated_weight: Array
    bearing: Array
    std: Array


class CameraResiduals(NamedTuple):
    """Whitened camera residuals and Jacobians at one solution."""

    rows: Array
    """(I, 3, 4) Jacobians by x, y, psi, and the residual, of each image's nearest candidate."""
    excess: Array
    """(I,) squared distance in elevation and log distance that does not inform the position."""
    weight: Array
    """(I,) weight of each image."""

    @property
    def squared_distance(self) -> Array:
        """(I,) squared distances."""
        return np.asarray((self.rows[..., -1] ** 2).sum(axis=1) + self.excess)


def camera_measurements(
    pair: Pair, keyframe_s: Array, height_std_m: float
) -> CameraMeasurements | None:
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
    both = (
        crop_to_time(s, pair.time_s[0], pair.time_s[-1])
        for s in (pair.own_bearings, pair.peer_bearings)
    )
    sides = [(s, sign) for s, sign in zip(both, (1, -1), strict=True) if s and len(s.time_s)]
    if not sides:
        return None
    count = max(s.bearing.shape[1] for s, _ in sides)
    time_s = np.concatenate([s.time_s for s, _ in sides])
    order = np.argsort(time_s, kind="stable")
    time_s = time_s[order]
    side = np.concatenate([np.full(len(s.time_s), float(sign)) for s, sign in sides])[order]
    polar = np.concatenate([_pad_candidates(s.bearing, count) for s, _ in sides])[order]
    std = np.concatenate([_pad_candidates(s.std, count) for s, _ in sides])[order]
    # The elevation residual also contains the error of the height difference.
    std[..., 1] = np.hypot(std[..., 1], height_std_m / np.exp(polar[..., 2]))
    place = np.interp(time_s, keyframe_s, np.arange(len(keyframe_s)))
    key = np.minimum(place.astype(np.intp), len(keyframe_s) - 2)
    share = np.concatenate([_image_weights(s.time_s) for s, _ in sides])[order]
    lasting = np.where(
        side > 0, *(1 / max(float(share[side == sign].sum()), 1.0) for sign in (1, -1))
    )
    height = pair.peer.height_m - pair.own.height_m
    return CameraMeasurements(
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


def _pad_candidates(values: Array, count: int) -> Array:
    """Pad (I, C, 3) with NaN to (I, count, 3)."""
    missing = count - values.shape[1]
    return np.asarray(np.pad(values, ((0, 0), (0, missing), (0, 0)), constant_values=np.nan))


def _image_weights(time_s: Array) -> Array:
    """Return (I,) one over the number of images near each that share its errors."""
    around = [np.searchsorted(time_s, time_s + s * CORRELATION_S / 2) for s in (-1, 1)]
    return np.asarray(1 / np.maximum(around[1] - around[0], 1))


def predict_bearings(camera: CameraMeasurements, state: Array) -> tuple[Array, Array]:
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
    part = camera.fraction[:, None]
    at = (1 - part) * state[camera.keyframe, :3] + part * state[camera.keyframe + 1, :3]
    return bearing_to_peer(at, camera.observer_sign, camera.height_m)


def bearing_to_peer(pose: Array, observer_sign: Array, height_m: Array) -> tuple[Array, Array]:
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
    x, y = (pose[:, :2] * observer_sign[:, None]).T
    level2 = np.maximum(x * x + y * y, 1e-6)
    up = observer_sign * height_m
    square, level = level2 + up * up, np.sqrt(level2)
    heading = np.where(observer_sign < 0, pose[:, 2], 0.0)
    polar = np.column_stack([np.arctan2(y, x) - heading, np.arctan2(up, level), np.log(square) / 2])
    slope = np.zeros((len(pose), 3, 3))
    slope[:, 0, 0], slope[:, 0, 1] = -y / level2, x / level2
    slope[:, 1, 0], slope[:, 1, 1] = -x * up / (level * square), -y * up / (level * square)
    slope[:, 2, 0], slope[:, 2, 1] = x / square, y / square
    slope[:, :, :2] *= observer_sign[:, None, None]
    slope[:, 0, 2] = -1.0 * (observer_sign < 0)
    return polar, slope


def linearize_camera(camera: CameraMeasurements, state: Array) -> CameraResiduals:
    """Linearize each image's nearest candidate at a solution.

    Parameters
    ----------
    camera
        Measurements of I images.
    state
        (K, 6) x, y (m), psi (rad), ...
    """
    polar, slope = predict_bearings(camera, state)
    off, nearest, _ = _nearest_candidates(camera, polar)
    images = np.arange(len(nearest))
    rows = np.empty((len(nearest), 3, 4))
    rows[..., :3] = -slope / camera.std[images, nearest][..., None]
    rows[..., 3] = off[images, nearest]
    squared = rows[:, 1:, 3] ** 2
    within = np.minimum(
        1.0, np.sqrt(MAX_CORRELATED_SQUARE / np.maximum(squared, MAX_CORRELATED_SQUARE))
    )
    rows[:, 1:, 3] *= within
    rows[:, 1:] *= np.sqrt(camera.correlated_weight)[:, None, None]
    beyond = np.maximum(squared - MAX_CORRELATED_SQUARE, 0.0).sum(axis=1)
    most = OUTLIER_SQUARED_DISTANCE * (
        1 + (AZIMUTH_MARGIN_RAD / camera.std[images, nearest, 0]) ** 2
    )
    lost = (rows[..., 3] ** 2).sum(axis=1) + beyond > most
    rows[lost], beyond[lost] = 0.0, most[lost]
    return CameraResiduals(rows, beyond, camera.weight)


def _nearest_candidates(
    camera: CameraMeasurements, bearing: Array
) -> tuple[Array, NDArray[np.intp], Array]:
    """Return whitened residuals (I, C, 3), index of the nearest (I,) and its square (I,)."""
    off = subtract_bearings(camera.bearing, bearing[:, None]) / camera.std
    squared = (off**2).sum(axis=-1)
    squared[np.isnan(squared)] = np.inf
    return off, np.asarray(squared.argmin(axis=1)), np.asarray(squared.min(axis=1))


def select_associated(camera: CameraMeasurements, state: Array) -> CameraMeasurements:
    """Keep the candidate of each image that is nearest to a solution.

    Parameters
    ----------
    camera
        Measurements of I images.
    state
        (K, 6) states of the solution.
    """
    at = _nearest_candidates(camera, predict_bearings(camera, state)[0])[1][:, None, None]
    polar, std = (np.take_along_axis(v, at, axis=1) for v in (camera.bearing, camera.std))
    return replace(camera, bearing=polar, std=std)


def _nearest_squared_distance(camera: CameraMeasurements, state: Array) -> Array:
    """Return (I,) squared distance of each image's nearest candidate from a solution."""
    return _nearest_candidates(camera, predict_bearings(camera, state)[0])[2]


def keep_consistent_cameras(
    camera: CameraMeasurements | None, state: Array
) -> CameraMeasurements | None:
    """Return the images of cameras consistent with the solution, or None.

    Outlier images are removed: where the ranges inform little, each of them would still bend it.

    Parameters
    ----------
    camera
        Measurements of a flight.
    state
        (K, 6) states of the solution.
    """
    if camera is None:
        return None
    squared, kept = (
        _nearest_squared_distance(camera, state),
        np.zeros(len(camera.observer_sign), bool),
    )
    agree = squared < ASSOCIATION_GATE
    for side in (1, -1):
        mine = camera.observer_sign == side
        if agree[mine].sum() >= max(MIN_CONSISTENT_IMAGES, MIN_CONSISTENT_SHARE * mine.sum()):
            kept |= mine & (squared < OUTLIER_SQUARED_DISTANCE)
    if kept.all() or not kept.any():
        return camera if kept.any() else None
    return CameraMeasurements(*(getattr(camera, field.name)[kept] for field in fields(camera)))


def keyframes_with_agreement(
    camera: CameraMeasurements | None,
    state: Array,
    observer_sign: int,
    keyframe_s: Array,
    within_s: float,
) -> Mask:
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
    if camera is None:
        return np.zeros(len(keyframe_s), bool)
    good = (_nearest_squared_distance(camera, state) < ASSOCIATION_GATE) & (
        camera.observer_sign == observer_sign
    )
    at_s = np.concatenate([[-np.inf], camera.time_s[good], [np.inf]])
    after = np.searchsorted(at_s, keyframe_s)
    return np.asarray(
        np.minimum(at_s[after] - keyframe_s, keyframe_s - at_s[after - 1]) <= within_s
    )
