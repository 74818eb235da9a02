"""Bearings and distances that a camera showed, beside positions that are known."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.pair import Array, Mask, Sightings

AGREES = 11.3
"""Squared distance within which a candidate is the robot: 99 % of three numbers."""


def polar_of(xyz_m: Array) -> Array:
    """(N, 3) azimuth, elevation (rad) and log distance of (N, 3) places, metres."""
    x, y, z = xyz_m.T
    level2 = np.maximum(x * x + y * y, 1e-6)
    up = np.arctan2(z, np.sqrt(level2))
    return np.column_stack([np.arctan2(y, x), up, np.log(level2 + z * z) / 2])


def polar_variance(xyz_m: Array, covariance: Array) -> Array:
    """(N, 3) variances of azimuth, elevation and log distance of places that are uncertain.

    Parameters
    ----------
    xyz_m, covariance
        (N, 3) metres, (N, 3, 3).
    """
    x, y, z = xyz_m.T
    level2 = np.maximum(x * x + y * y, 1e-6)
    square, level, zero = level2 + z * z, np.sqrt(level2), 0 * x
    azimuth = np.column_stack([-y, x, zero]) / level2[:, None]
    elevation = np.column_stack([-x * z / level, -y * z / level, level]) / square[:, None]
    slope = np.stack([azimuth, elevation, xyz_m / square[:, None]], axis=1)
    return np.asarray(np.einsum("nij,njk,nik->ni", slope, covariance, slope))


def difference(there: Array, here: Array) -> Array:
    """(..., 3) azimuth, elevation, log distance there less here, azimuths the short way round."""
    off = np.asarray(there - here)
    off[..., 0] = (off[..., 0] + np.pi) % (2 * np.pi) - np.pi
    return off


class Claim(NamedTuple):
    """Which candidate of each of I images a place in it goes with best."""

    nearest: NDArray[np.intp]
    """(I,) its number."""
    squared: Array
    """(I,) squared Mahalanobis distance."""
    log_likelihood: Array
    """(I,) of it."""

    @property
    def agrees(self) -> Mask:
        """(I,) whether it may be the robot."""
        return np.asarray(self.squared < AGREES)


def claim(sightings: Sightings, xyz_m: Array, covariance: Array) -> Claim:
    """Candidates that are nearest to known places.

    Parameters
    ----------
    sightings
        Of I images.
    xyz_m, covariance
        (I, 3) metres and (I, 3, 3), in the horizontal frame of the robot that saw, at the images.
    """
    off = difference(sightings.polar, polar_of(xyz_m)[:, None])
    variance = polar_variance(xyz_m, covariance)[:, None] + sightings.std**2
    squared = (off**2 / variance).sum(axis=2)
    squared = np.where(np.isnan(squared), np.inf, squared)
    nearest, images = squared.argmin(axis=1), np.arange(len(squared))
    least = squared[images, nearest]
    return Claim(nearest, least, -(least + np.log(variance[images, nearest]).sum(axis=1)) / 2)


def within(sightings: Sightings | None, start_s: float, end_s: float) -> Sightings | None:
    """Those of a part of a flight.

    Parameters
    ----------
    sightings
        Of the flight.
    start_s, end_s
        First and last time of the part, seconds.
    """
    if sightings is None:
        return None
    inside = (sightings.time_s >= start_s) & (sightings.time_s <= end_s)
    return Sightings(sightings.time_s[inside], sightings.polar[inside], sightings.std[inside])


def without(sightings: Sightings, images: Mask, candidates: NDArray[np.intp]) -> Sightings:
    """Those that are left without a candidate of some images.

    Parameters
    ----------
    sightings
        Of I images.
    images
        (I,) which of them lose one.
    candidates
        (I,) number of the candidate.
    """
    polar = sightings.polar.copy()
    polar[np.flatnonzero(images), candidates[images]] = np.nan
    left = np.isfinite(polar[..., 0]).any(axis=1)
    return replace(
        sightings, time_s=sightings.time_s[left], polar=polar[left], std=sightings.std[left]
    )
