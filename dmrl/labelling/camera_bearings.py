"""Convert a camera's detections to bearings."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from dmrl.estimation.model.bearings import to_bearing
from dmrl.estimation.model.pair import BearingMeasurements, Pair
from dmrl.geometry.frames import horizontal_from_pixels
from dmrl.labelling.observer_log import ObserverLog

DISTANCE_RATIO = 0.25
"""Error of a detection's distance over the distance, for networks that estimate none."""
MIN_DISTANCE_RATIO = 0.05
"""Smallest such error. Networks are overconfident about distances."""

Names = tuple[str, str]


def detections_to_bearings(
    observer: ObserverLog, start_ns: int, pixel_std_px: float, attitude_std_rad: float
) -> BearingMeasurements:
    """Return an observer's detections as bearings and distances.

    Parameters
    ----------
    observer
        Its detections, attitude and camera.
    start_ns
        Log time of second zero.
    pixel_std_px
        Error of a detection in u and in v.
    attitude_std_rad
        Standard deviation of roll and pitch.
    """
    image = np.repeat(np.arange(len(observer.time_ns)), np.diff(observer.first_row))
    depth_m, sigma_m = observer.detections[:, 2:4].T
    roll_rad, pitch_rad = observer.attitude_rad[image].T
    points_m = horizontal_from_pixels(
        observer.detections[:, :2], depth_m, roll_rad, pitch_rad, observer.camera
    )
    good = np.isfinite(points_m).all(axis=1)
    ratio = np.where(sigma_m > 0, sigma_m / depth_m, DISTANCE_RATIO)
    # Near the axis a pixel is an angle of 1 / focal length.
    angle = pixel_std_px / ((observer.camera.fx_px + observer.camera.fy_px) / 2)
    std = np.column_stack(
        [
            np.full(len(ratio), angle),
            np.full(len(ratio), np.hypot(angle, attitude_std_rad)),
            np.maximum(ratio, MIN_DISTANCE_RATIO),
        ]
    )
    images, row, per_image = np.unique(image[good], return_inverse=True, return_counts=True)
    column = np.arange(len(row)) - (np.cumsum(per_image) - per_image)[row]
    out = np.full((2, len(images), max(per_image, default=0), 3), np.nan)
    out[0, row, column], out[1, row, column] = to_bearing(points_m[good]), std[good]
    return BearingMeasurements(
        np.asarray((observer.time_ns[images] - start_ns) * 1e-9), out[0], out[1]
    )


def add_bearings(
    pairs: Mapping[Names, Pair], bearings: Mapping[str, BearingMeasurements]
) -> dict[Names, Pair]:
    """Return the pairs with the bearings of both robots' cameras.

    Parameters
    ----------
    pairs
        By names.
    bearings
        By robot.
    """
    return {
        (one, other): replace(
            pair, own_bearings=bearings.get(one), peer_bearings=bearings.get(other)
        )
        for (one, other), pair in pairs.items()
    }
