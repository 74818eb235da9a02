"""A camera's detections as the estimators want them; and heights corrected by them."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from dmrl.estimation.filters.ou_smoother import faded
from dmrl.estimation.model.bearings import claim, polar_of
from dmrl.estimation.model.pair import Pair, Sightings
from dmrl.geometry.frames import horizontal_from_pixels
from dmrl.labelling.image_labels import Positions
from dmrl.labelling.observer_log import Sight
from dmrl.messages import STATUS_OK

DISTANCE_RATIO = 0.25
"""Error of a detection's distance over the distance, where the network does not say."""
LEAST_RATIO = 0.05
"""It is never smaller: networks are surer of distances than they should be."""
HEIGHT_FADES_S = 4.0
"""Time in which the error of a height fades to 1/e."""

Names = tuple[str, str]


def sightings_of(
    sight: Sight, start_ns: int, pixel_std_px: float, attitude_std_rad: float
) -> Sightings:
    """What an observer detected, as bearings and distances.

    Parameters
    ----------
    sight
        Its detections.
    start_ns
        Log time of second zero.
    pixel_std_px
        Error of a detection in u and in v.
    attitude_std_rad
        Standard deviation of roll and pitch.
    """
    image = np.repeat(np.arange(len(sight.time_ns)), np.diff(sight.first))
    depth_m, sigma_m = sight.detections[:, 2:].T
    roll_rad, pitch_rad = sight.attitude_rad[image].T
    points_m = horizontal_from_pixels(
        sight.detections[:, :2], depth_m, roll_rad, pitch_rad, sight.camera
    )
    good = np.isfinite(points_m).all(axis=1)
    ratio = np.where(sigma_m > 0, sigma_m / depth_m, DISTANCE_RATIO)
    # Near the axis a pixel is an angle of 1 / focal length.
    angle = pixel_std_px / ((sight.camera.fx_px + sight.camera.fy_px) / 2)
    std = np.column_stack(
        [
            np.full(len(ratio), angle),
            np.full(len(ratio), np.hypot(angle, attitude_std_rad)),
            np.maximum(ratio, LEAST_RATIO),
        ]
    )
    images, row, per_image = np.unique(image[good], return_inverse=True, return_counts=True)
    column = np.arange(len(row)) - (np.cumsum(per_image) - per_image)[row]
    out = np.full((2, len(images), max(per_image, default=0), 3), np.nan)
    out[0, row, column], out[1, row, column] = polar_of(points_m[good]), std[good]
    return Sightings(np.asarray((sight.time_ns[images] - start_ns) * 1e-9), out[0], out[1])


def with_sightings(
    pairs: Mapping[Names, Pair], found: Mapping[str, Sightings]
) -> dict[Names, Pair]:
    """Pairs with what the cameras of both showed.

    Parameters
    ----------
    pairs
        By names.
    found
        By robot.
    """
    return {
        (one, other): replace(pair, own_sees=found.get(one), peer_sees=found.get(other))
        for (one, other), pair in pairs.items()
    }


def levelled(found: Positions, start_ns: int, sees: Sightings) -> tuple[Positions, int]:
    """Positions that are OK with heights by elevations, and how many images showed the peer.

    The solve takes heights for known. What a camera saw where the solution has the peer tells
    their error, which fades in seconds.

    Parameters
    ----------
    found
        Where a peer is, at the images among other times.
    start_ns
        Log time of second zero.
    sees
        What the observer detected.
    """
    good = np.flatnonzero(found.status == STATUS_OK)
    time_s = np.asarray((found.time_ns[good] - start_ns) * 1e-9)
    place = np.minimum(np.searchsorted(time_s, sees.time_s - 1e-6), max(len(good) - 1, 0))
    there = np.abs(time_s[place] - sees.time_s) < 1e-6 if len(good) else np.zeros(0, bool)
    place = place[there]
    if not len(place):
        return found, 0
    shown = Sightings(sees.time_s[there], sees.polar[there], sees.std[there])
    here_m = found.xyz_m[good[place]]
    best = claim(shown, here_m, found.covariance[good[place]])
    images = np.flatnonzero(best.agrees)
    at = images, best.nearest[images], 1
    level_m = np.hypot(*here_m[images, :2].T)
    off_m = (shown.polar[at] - polar_of(here_m[images])[:, 1]) * level_m
    height_std_m = np.sqrt(found.covariance[good, 2, 2])
    error_m, variance = faded(
        time_s, height_std_m, HEIGHT_FADES_S, place[images], off_m, shown.std[at] * level_m
    )
    xyz, covariance = found.xyz_m.copy(), found.covariance.copy()
    xyz[good, 2] += error_m
    covariance[good, 2, 2] = variance
    return replace(found, xyz_m=xyz, covariance=covariance), len(images)
