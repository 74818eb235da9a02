"""Camera bearings and distances, and their association with estimated positions."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.pair import Array, BearingMeasurements, Mask

ASSOCIATION_GATE = 11.3
"""Gate on the squared Mahalanobis distance of a candidate. The 99 % point of chi-square with three
degrees of freedom."""


def to_bearing(xyz_m: Array) -> Array:
    """Return (N, 3) azimuth, elevation (rad) and log distance of (N, 3) positions, metres."""
    x, y, z = xyz_m.T
    level2 = np.maximum(x * x + y * y, 1e-6)
    up = np.arctan2(z, np.sqrt(level2))
    return np.column_stack([np.arctan2(y, x), up, np.log(level2 + z * z) / 2])


def bearing_variance(xyz_m: Array, covariance: Array) -> Array:
    """Return (N, 3) variances of azimuth, elevation and log distance of uncertain positions.

    Parameters
    ----------
    xyz_m, covariance
        (N, 3) metres, and (N, 3, 3) square metres.
    """
    x, y, z = xyz_m.T
    level2 = np.maximum(x * x + y * y, 1e-6)
    square, level, zero = level2 + z * z, np.sqrt(level2), 0 * x
    azimuth = np.column_stack([-y, x, zero]) / level2[:, None]
    elevation = np.column_stack([-x * z / level, -y * z / level, level]) / square[:, None]
    slope = np.stack([azimuth, elevation, xyz_m / square[:, None]], axis=1)
    return np.asarray(np.einsum("nij,njk,nik->ni", slope, covariance, slope))


def subtract_bearings(first: Array, second: Array) -> Array:
    """Return (..., 3) differences of azimuth (wrapped to +-pi), elevation and log distance."""
    off = np.asarray(first - second)
    off[..., 0] = (off[..., 0] + np.pi) % (2 * np.pi) - np.pi
    return off


class Association(NamedTuple):
    """Candidate of each of I images that is nearest to an expected position."""

    nearest: NDArray[np.intp]
    """(I,) index of the candidate."""
    squared_distance: Array
    """(I,) squared Mahalanobis distance."""
    log_likelihood: Array
    """(I,) log likelihood of the association."""

    @property
    def is_consistent(self) -> Mask:
        """(I,) whether the distance is inside the gate."""
        return np.asarray(self.squared_distance < ASSOCIATION_GATE)


def associate(bearings: BearingMeasurements, xyz_m: Array, covariance: Array) -> Association:
    """Associate every image with the candidate nearest to an expected position.

    Parameters
    ----------
    sightings
        Candidates of I images.
    xyz_m, covariance
        (I, 3) metres and (I, 3, 3), in the horizontal frame of the robot with the camera, at the
        times of the images.
    """
    off = subtract_bearings(bearings.bearing, to_bearing(xyz_m)[:, None])
    variance = bearing_variance(xyz_m, covariance)[:, None] + bearings.std**2
    squared = (off**2 / variance).sum(axis=2)
    squared = np.where(np.isnan(squared), np.inf, squared)
    nearest, images = squared.argmin(axis=1), np.arange(len(squared))
    least = squared[images, nearest]
    return Association(nearest, least, -(least + np.log(variance[images, nearest]).sum(axis=1)) / 2)


def drop_candidates(
    bearings: BearingMeasurements, images: Mask, candidates: NDArray[np.intp]
) -> BearingMeasurements:
    """Remove one candidate from some images; drop images without any other candidate.

    Parameters
    ----------
    sightings
        Candidates of I images.
    images
        (I,) images that lose a candidate.
    candidates
        (I,) index of the candidate to remove.
    """
    polar = bearings.bearing.copy()
    polar[np.flatnonzero(images), candidates[images]] = np.nan
    left = np.isfinite(polar[..., 0]).any(axis=1)
    return replace(
        bearings, time_s=bearings.time_s[left], bearing=polar[left], std=bearings.std[left]
    )
