"""Project positions of a peer, with their covariance, to labels of a robot's images."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.pair import Array
from dmrl.geometry.frames import Camera, pixels_from_horizontal
from dmrl.labelling.peer_positions import PeerPositions
from dmrl.messages import STATUS_OK, STATUS_UNCONVERGED

SOURCE = "estimate"
"""Source that estimated labels name."""
MARGIN_SIGMAS = 3.0
"""Largest distance of a label outside the image, in its own sigmas."""
MIN_DEPTH_M = 0.05
"""Depth below which a peer is not in front of the camera, metres."""


@dataclass(frozen=True, slots=True)
class CameraOptions:
    """Options of the projection of positions to pixels.

    Parameters
    ----------
    attitude_std_rad
        Standard deviation of roll and pitch.
    distorted
        Whether the images still have the lens's distortion.
    cameras
        By robot, in place of the recording's: with mount and delay.
    """

    attitude_std_rad: float
    distorted: bool = True
    cameras: Mapping[str, Camera] = field(default_factory=dict)

    def exposures_ns(self, robot: str, images_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return when images of a robot were taken, from their log times."""
        delay_s = self.cameras[robot].delay_s if robot in self.cameras else 0.0
        return images_ns - round(delay_s * 1e9)  # a delay is how much later the log time is


def label_images(
    peer: str, positions: PeerPositions, attitude_rad: Array, camera: Camera, options: CameraOptions
) -> Iterator[dict[str, Any] | None]:
    """Yield the fields of the peer's PeerLabel in each image, None if it is surely out of view.

    A peer that is not located (status not OK) may be in any image. If its best guess is out of
    view, its label is the image's centre with sigmas as wide as the image: without a label the
    image would count as one without the peer.

    Parameters
    ----------
    peer
        Its name.
    positions
        Of the peer at the times of the images.
    attitude_rad
        (N, 2) roll and pitch of the observer at those times.
    camera
        The observer's.
    options
        Options of the projection.
    """
    roll_rad, pitch_rad = attitude_rad.T
    uv, depth_m, jacobian = pixels_from_horizontal(
        positions.xyz_m, roll_rad, pitch_rad, camera, distorted=options.distorted
    )
    # To first order, the covariance of (u, v, depth) is J C J^T; C has position and attitude,
    # whose errors are assumed independent. Only its diagonal is needed.
    joint = np.zeros((len(uv), 5, 5))
    joint[:, :3, :3] = positions.covariance
    joint[:, [3, 4], [3, 4]] = options.attitude_std_rad**2
    variance = np.einsum("nij,njk,nik->ni", jacobian, joint, jacobian)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    size = np.array([camera.width_px, camera.height_px])
    # No wider than some images: a peer close by with a large sigma would be named everywhere.
    # Comparisons with the NaN of a peer behind the camera are false.
    reach = MARGIN_SIGMAS * np.minimum(sigma[:, :2], size)
    near = ((uv > -reach) & (uv < size + reach)).all(axis=1) & (depth_m > MIN_DEPTH_M)
    distance = np.linalg.norm(positions.xyz_m, axis=1)
    for k, status in enumerate(positions.status.tolist()):
        if near[k]:
            yield _to_fields(peer, status, [*uv[k], depth_m[k]], sigma[k])
        elif status != STATUS_OK:
            yield label_anywhere(peer, camera, float(distance[k]), status)
        else:
            yield None


def label_anywhere(
    peer: str, camera: Camera, distance_m: float, status: int = STATUS_UNCONVERGED
) -> dict[str, Any]:
    """Return the fields of the PeerLabel of a peer that may be in the image or not.

    Parameters
    ----------
    peer
        Its name.
    camera
        The observer's.
    distance_m
        Its largest distance.
    status
        Its status, not OK.
    """
    size = np.array([camera.width_px, camera.height_px])
    middle = [*size / 2, max(distance_m, MIN_DEPTH_M)]
    return _to_fields(peer, status, middle, [*size, distance_m])


def _to_fields(peer: str, status: int, value: Any, sigma: Any) -> dict[str, Any]:
    names = ("u_px", "v_px", "depth_m", "sigma_u_px", "sigma_v_px", "sigma_depth_m")
    numbers = zip(names, [*map(float, value), *map(float, sigma)], strict=True)
    return {"peer": peer, "status": status, "source": SOURCE, **dict(numbers)}
