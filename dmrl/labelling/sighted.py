"""Positions from ranges and odometry, corrected by detections in the observer's images."""

from dataclasses import replace

import numpy as np

from dmrl.estimation.bearings import Sharpness, corrected
from dmrl.geometry.frames import horizontal_from_pixels
from dmrl.labelling.labels import Positions
from dmrl.labelling.sight import Sight
from dmrl.messages import STATUS_OK


def sighted(sight: Sight, found: Positions, pixel_std_px: float) -> tuple[Positions, int]:
    """The same positions, those that are OK corrected, and how many detections counted.

    Parameters
    ----------
    sight
        What the observer detected.
    found
        Where a peer is, at the images among other times.
    pixel_std_px
        Error of a detection in u and in v.
    """
    good = np.flatnonzero(found.status == STATUS_OK)
    # The image that each detection belongs to, and the place of that image's time in ``good``.
    # A detection in an image without a good position corrects nothing.
    image = np.repeat(np.arange(len(sight.time_ns)), np.diff(sight.first))
    place = np.searchsorted(found.time_ns[good], sight.time_ns[image])
    there = place < len(good)
    there[there] = found.time_ns[good][place[there]] == sight.time_ns[image[there]]
    if not there.any():
        return found, 0
    attitude = sight.attitude_rad[image[there]]
    uv, depth_m = sight.detections[there, :2], sight.detections[there, 2]
    roll_rad, pitch_rad = attitude.T
    points_m = horizontal_from_pixels(uv, depth_m, roll_rad, pitch_rad, sight.camera)
    seen = np.isfinite(points_m).all(axis=1)
    # Near the axis a pixel is an angle of 1 / focal length.
    focal_px = (sight.camera.fx_px + sight.camera.fy_px) / 2
    xyz_m, covariance, used = corrected(
        (found.time_ns[good] - found.time_ns[0]) * 1e-9,
        found.xyz_m[good],
        found.covariance[good],
        place[there][seen],
        points_m[seen],
        Sharpness(bearing_std_rad=pixel_std_px / focal_px),
    )
    all_xyz_m, all_covariance = found.xyz_m.copy(), found.covariance.copy()
    all_xyz_m[good], all_covariance[good] = xyz_m, covariance
    return replace(found, xyz_m=all_xyz_m, covariance=all_covariance), used
