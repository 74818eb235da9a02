"""Detections of peers, flight by flight, and their predicted pixels. Arrays only."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from dmrl.estimation.calibration.noise import Noise
from dmrl.estimation.model.pair import SIGMA_OF_MEDIAN
from dmrl.geometry.frames import Array, Camera, is_inside, pixels_from_horizontal

MAX_GAP_S = 0.25
"""Longest gap over which positions are interpolated, seconds. No record of how the value was
chosen."""
SMOOTHING_STD_SAMPLES, SIMILARITY_SIGMAS, SMOOTHING_ROUNDS = 2.0, 3.0, 3
"""Attitude smoothing: std of the window, samples; similarity scale, std of the noise; iterations.

At 100 Hz the noise moves a peer in the image further from sample to sample than the flight does. No
record of how the values were chosen."""


@dataclass(frozen=True, slots=True)
class PeerPath:
    """Path of one peer.

    Parameters
    ----------
    time_s
        (N,) ascending.
    xyz_m
        (N, 3) in the observer's horizontal frame.
    covariance
        (N, 3, 3) m^2; zero if exact.
    """

    time_s: Array
    xyz_m: Array
    covariance: Array

    def interpolate_at(self, at_s: Array) -> Array:
        """Interpolate (N, 3) positions."""
        return np.column_stack([np.interp(at_s, self.time_s, axis) for axis in self.xyz_m.T])

    def nearest_covariance(self, at_s: Array) -> Array:
        """Return (N, 3, 3) covariances of the position at the nearest times."""
        return self.covariance[np.clip(np.searchsorted(self.time_s, at_s), 0, len(self.time_s) - 1)]

    def covers(self, at_s: Array) -> NDArray[np.bool_]:
        """Return (N,) whether the path has positions shortly before and after a time."""
        after = np.searchsorted(self.time_s, at_s)
        known = (after > 0) & (after < len(self.time_s))
        after = np.clip(after, 1, len(self.time_s) - 1)
        return np.asarray(known & (self.time_s[after] - self.time_s[after - 1] < MAX_GAP_S))


@dataclass(frozen=True, slots=True)
class CalibrationFlight:
    """Detections of one observer, its attitude and the paths of its peers.

    Parameters
    ----------
    image_s
        (K,) log times of the images.
    image
        (M,) image of each detection, ascending.
    uv
        (M, 2) pixels.
    attitude_s, attitude_rad
        (A,) and (A, 2) roll and pitch of the observer.
    peers
        Paths by name.
    """

    image_s: Array
    image: NDArray[np.int64]
    uv: Array
    attitude_s: Array
    attitude_rad: Array
    peers: Mapping[str, PeerPath]

    def smooth_attitude(self) -> "CalibrationFlight":
        """Return the flight with smoothed attitude, edges preserved.

        A plain window would round the edges. A drone tilts at once and comes back slowly, so its
        tilts would appear late, or early.
        """
        return replace(self, attitude_rad=_smooth_bilateral(self.attitude_rad))

    def thin_images(self, most: int) -> "CalibrationFlight":
        """Return the flight with a limited number of evenly spaced images."""
        step = -(-len(self.image_s) // max(most, 1))
        kept = self.image % step == 0
        return replace(
            self, image_s=self.image_s[::step], image=self.image[kept] // step, uv=self.uv[kept]
        )


def _smooth_bilateral(values: Array) -> Array:
    """Smooth (N, C) values by an iterated bilateral filter (Tomasi and Manduchi 1998).

    The noise level comes from the median of the second differences, which is robust to jumps.
    """
    if len(values) < 3:
        return values
    # The second difference of white noise has 1 + 4 + 1 times its variance.
    bends = np.median(np.abs(np.diff(values, n=2, axis=0)), axis=0)
    noise = np.maximum(SIGMA_OF_MEDIAN * bends / np.sqrt(6.0), 1e-9)[:, None]
    side = np.ceil(3 * SMOOTHING_STD_SAMPLES).astype(int)
    near = np.exp(-0.5 * (np.arange(-side, side + 1) / SMOOTHING_STD_SAMPLES) ** 2)
    around = _windows_around(values, side)
    smooth = median_filter(values, size=(3, 1), mode="nearest")
    for _ in range(SMOOTHING_ROUNDS):
        apart = (_windows_around(smooth, side) - smooth[:, :, None]) / (SIMILARITY_SIGMAS * noise)
        alike = near / (1 + apart**2) ** 2
        smooth = (alike * around).sum(axis=2) / alike.sum(axis=2)
    return np.asarray(smooth)


def _windows_around(values: Array, side: int) -> Array:
    """Return (N, C, 2 side + 1) windows around each of (N, C) values; the ends repeat."""
    padded = np.pad(values, ((side, side), (0, 0)), mode="edge")
    return sliding_window_view(padded, 2 * side + 1, axis=0)


@dataclass(frozen=True, slots=True)
class Matches:
    """Detections matched to their peers.

    Parameters
    ----------
    time_s
        (N,) log times of their images.
    uv
        (N, 2) pixels.
    view
        (N,) index of the view, one for each peer and flight.
    whiten
        (N, 2, 2) matrices that whiten pixel errors, if all errors were new in every image.
    expected
        Number of images, over all views, with a peer in the image.
    radius_px
        Largest distance of a match.
    """

    time_s: Array
    uv: Array
    view: NDArray[np.int64]
    whiten: Array
    expected: int
    radius_px: float


PeerView = tuple[CalibrationFlight, PeerPath]
"""One peer in one flight."""


def with_mount(camera: Camera, values: Array) -> Camera:
    """Return the camera with (4,) roll, pitch, yaw (radians) and delay (seconds)."""
    roll, pitch, yaw, delay_s = values.tolist()
    return replace(camera, mount_rad=(roll, pitch, yaw), delay_s=delay_s)


def predict_pixels(
    flight: CalibrationFlight, camera: Camera, peer: PeerPath, time_s: Array
) -> tuple[Array, Array]:
    """Predict (N, 2) pixels of a peer in images with log times; also (N, 3, 5) derivatives."""
    at_s = time_s - camera.delay_s
    xyz = peer.interpolate_at(at_s)
    roll, pitch = (np.interp(at_s, flight.attitude_s, a) for a in flight.attitude_rad.T)
    uv, _, jacobian = pixels_from_horizontal(xyz, roll, pitch, camera)
    return uv, jacobian


def match_detections(
    views: Sequence[PeerView], camera: Camera, radius_px: float, noise: Noise
) -> Matches:
    """Match every peer in every image to the nearest detection within a radius."""
    parts, count = [], 0
    for number, (flight, peer) in enumerate(views):
        uv, jacobian = predict_pixels(flight, camera, peer, flight.image_s)
        good = peer.covers(flight.image_s - camera.delay_s) & is_inside(
            uv, camera.width_px, camera.height_px
        )
        count += int(good.sum())
        apart_px = np.linalg.norm(flight.uv - uv[flight.image], axis=1)
        apart_px[~good[flight.image]] = np.inf
        order = np.lexsort((apart_px, flight.image))
        _, first = np.unique(flight.image[order], return_index=True)
        nearest = order[first]
        nearest = nearest[apart_px[nearest] <= radius_px]
        image = flight.image[nearest]
        time_s = flight.image_s[image]
        whiten = _whitening_matrices(
            jacobian[image, :2], peer.nearest_covariance(time_s - camera.delay_s), noise
        )
        parts.append((time_s, flight.uv[nearest], np.full(len(image), number), whiten))
    time_s, uv, view, whiten = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Matches(time_s, uv, view, whiten, count, radius_px)


def _whitening_matrices(jacobian: Array, covariance: Array, noise: Noise) -> Array:
    """Return (N, 2, 2) matrices that whiten pixel errors."""
    joint = np.zeros((len(jacobian), 5, 5))
    joint[:, :3, :3] = covariance
    joint[:, [3, 4], [3, 4]] = noise.attitude_std_rad**2
    # With the covariance C = L L^T of pixel errors e, L^-1 e has unit variance.
    spread = jacobian @ joint @ jacobian.swapaxes(1, 2) + noise.pixel_std_px**2 * np.eye(2)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(spread)))


def pixel_residuals(
    views: Sequence[PeerView], camera: Camera, matched: Matches, values: Array
) -> Array:
    """Return (N, 2) detections minus predictions, pixels."""
    out = np.empty_like(matched.uv)
    for number, (flight, peer) in enumerate(views):
        mine = matched.view == number
        uv, _ = predict_pixels(flight, with_mount(camera, values), peer, matched.time_s[mine])
        out[mine] = matched.uv[mine] - uv
    return np.nan_to_num(out)


def median_residual_px(
    views: Sequence[PeerView], camera: Camera, matched: Matches, values: Array
) -> float:
    """Return the median distance of detections from their predictions, pixels."""
    apart = pixel_residuals(views, camera, matched, values)
    return float(np.median(np.linalg.norm(apart, axis=1)))


def expected_median_px(matched: Matches) -> float:
    """Return the median distance of detections from their predictions by the assumed errors alone.

    The positions' covariances are among these errors.
    """
    half = np.linalg.inv(matched.whiten)
    root_px = np.sqrt((half**2).sum(axis=(1, 2)))  # of the covariance's trace
    return float(np.median(root_px) * np.sqrt(np.log(2)))  # the median of a circular Gaussian
