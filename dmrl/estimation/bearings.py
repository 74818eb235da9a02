"""Positions of a peer, corrected by what its observer's camera detected.

Ranges and odometry leave an error that is large in bearing and stays for seconds; a detection's
error is small in bearing and new in every image. So the error of a position, in azimuth,
elevation and log range each, is taken for a process that fades (Ornstein and Uhlenbeck 1930) with
the standard deviation that the position claims, and the detections for measurements of it; a
Kalman filter and RTS smoother find it. Nothing here corrects an error that detections share with
the positions their network learned from: that one has to be averaged out over flights.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROUNDS = 2
"""Detections are chosen by the positions, then once more by the corrected ones."""


@dataclass(frozen=True, slots=True)
class Sharpness:
    """What is expected of detections and of the positions' errors.

    Parameters
    ----------
    bearing_std_rad
        Error of a detection in azimuth and elevation.
    range_std_ratio
        Error of a detection's distance, over the distance.
    fade_s
        Time in which the error of a position fades to 1/e.
    gate
        Greatest squared Mahalanobis distance of a detection that counts; of three numbers 99 %
        are below 11.3.
    """

    bearing_std_rad: float = 0.03
    range_std_ratio: float = 0.25
    fade_s: float = 4.0
    gate: float = 11.3


def corrected(
    time_s: Array,
    xyz_m: Array,
    covariance: Array,
    rows: NDArray[np.int64],
    points_m: Array,
    sharpness: Sharpness,
) -> tuple[Array, Array, int]:
    """Positions with the detections in them.

    Parameters
    ----------
    time_s
        (N,) ascending.
    xyz_m, covariance
        (N, 3) and (N, 3, 3) positions in the observer's horizontal frame, m and m^2.
    rows
        (M,) which of the N times a detection belongs to; several of one image have the same.
    points_m
        (M, 3) where the detections put a peer, the same frame.
    sharpness
        What is expected of them.

    Returns
    -------
    xyz_m, covariance : Array
        As given, corrected.
    used : int
        Detections that counted.
    """
    before, turn = _polar(xyz_m)
    std = np.sqrt(np.einsum("nij,njk,nik->ni", turn, covariance, turn))
    there, _ = _polar(points_m)
    noise = np.array(
        [sharpness.bearing_std_rad, sharpness.bearing_std_rad, sharpness.range_std_ratio]
    )
    error, variance = np.zeros_like(before), std**2
    chosen = np.zeros(0, np.int64)
    for _ in range(ROUNDS):
        off = _difference(there, before[rows])
        distance = ((off - error[rows]) ** 2 / (variance[rows] + noise**2)).sum(axis=1)
        chosen = _nearest(rows, distance, sharpness.gate)
        fade = np.exp(-np.diff(time_s) / sharpness.fade_s)
        error, variance = _smoothed(fade, std, rows[chosen], off[chosen], noise)
    if not len(chosen):
        return xyz_m, covariance, 0
    after = _cartesian(before + error)
    # Detections may share an error, so they never tell more than one of them would alone.
    variance = np.minimum(variance + noise**2, std**2)
    back = np.linalg.inv(_polar(after)[1])
    return after, np.einsum("nij,nj,nkj->nik", back, variance, back), len(chosen)


def _polar(xyz_m: Array) -> tuple[Array, Array]:
    """(N, 3) azimuth, elevation, log distance, and (N, 3, 3) their derivative by x, y, z."""
    x, y, z = xyz_m.T
    level2 = np.maximum(x * x + y * y, 1e-9)
    square, level = level2 + z * z, np.sqrt(level2)
    polar = np.stack([np.arctan2(y, x), np.arctan2(z, level), np.log(square) / 2], axis=1)
    zero = np.zeros_like(x)
    turn = np.stack(
        [
            np.stack([-y / level2, x / level2, zero], axis=1),
            np.stack([-x * z / level, -y * z / level, level], axis=1) / square[:, None],
            xyz_m / square[:, None],
        ],
        axis=1,
    )
    return polar, turn


def _cartesian(polar: Array) -> Array:
    azimuth, elevation, log_distance = polar.T
    level = np.exp(log_distance) * np.cos(elevation)
    up = np.exp(log_distance) * np.sin(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up], axis=1)


def _difference(there: Array, here: Array) -> Array:
    """There less here, azimuths the short way round."""
    off = there - here
    off[:, 0] = (off[:, 0] + np.pi) % (2 * np.pi) - np.pi
    return off


def _nearest(rows: NDArray[np.int64], distance: Array, gate: float) -> NDArray[np.int64]:
    """The nearest detection of each row, where it is within the gate."""
    order = np.lexsort((distance, rows))
    first = np.append(True, np.diff(rows[order]) > 0) if len(order) else np.zeros(0, bool)
    best = order[first]
    return np.asarray(best[distance[best] < gate])


def _smoothed(
    fade: Array, std: Array, rows: NDArray[np.int64], off: Array, noise: Array
) -> tuple[Array, Array]:
    """(N, 3) the errors and their variances: RTS over states in units of ``std``."""
    count = len(std)
    measured = np.full((count, 3), np.nan)
    measured[rows] = off
    mean, var = np.zeros((count, 3)), np.ones((count, 3))
    ahead_mean, ahead_var = mean.copy(), var.copy()
    for k in range(count):
        if k:
            ahead_mean[k] = fade[k - 1] * mean[k - 1]
            ahead_var[k] = fade[k - 1] ** 2 * var[k - 1] + 1 - fade[k - 1] ** 2
        gain = ahead_var[k] * std[k] / (std[k] ** 2 * ahead_var[k] + noise**2)
        seen = np.isfinite(measured[k])
        news = np.where(seen, measured[k] - std[k] * ahead_mean[k], 0.0)
        mean[k] = ahead_mean[k] + gain * news
        var[k] = ahead_var[k] * (1 - np.where(seen, gain * std[k], 0.0))
    for k in range(count - 2, -1, -1):
        gain = fade[k] * var[k] / ahead_var[k + 1]
        mean[k] += gain * (mean[k + 1] - ahead_mean[k + 1])
        var[k] += gain**2 * (var[k + 1] - ahead_var[k + 1])
    return std * mean, std**2 * var
