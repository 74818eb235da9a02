"""What cameras saw of peers, flight by flight, and where they are expected. Arrays only."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from dmrl.geometry.frames import Array, Camera, inside, pixels_from_horizontal

LONGEST_GAP_S = 0.25
"""Positions are not interpolated over longer gaps."""
WIDTH, APART, TIMES = 2.0, 3.0, 3
"""Of the smoothing of attitude: standard deviation of its window in samples; how many standard
deviations of the noise values differ by that hardly count; rounds. At 100 Hz the noise moves a peer
in the image further from sample to sample than the flight does."""


@dataclass(frozen=True, slots=True)
class PeerPath:
    """Where one peer was.

    Parameters
    ----------
    time_s
        (N,) ascending.
    xyz_m
        (N, 3) in the observer's horizontal frame.
    covariance
        (N, 3, 3) m^2; zero where it is exact.
    """

    time_s: Array
    xyz_m: Array
    covariance: Array

    def at(self, at_s: Array) -> Array:
        """(N, 3) positions between those that are known."""
        return np.column_stack([np.interp(at_s, self.time_s, axis) for axis in self.xyz_m.T])

    def spread(self, at_s: Array) -> Array:
        """(N, 3, 3) covariance of the position at the nearest times."""
        return self.covariance[np.clip(np.searchsorted(self.time_s, at_s), 0, len(self.time_s) - 1)]

    def covers(self, at_s: Array) -> NDArray[np.bool_]:
        """(N,) whether the position is known shortly before and after a time."""
        after = np.searchsorted(self.time_s, at_s)
        known = (after > 0) & (after < len(self.time_s))
        after = np.clip(after, 1, len(self.time_s) - 1)
        return np.asarray(known & (self.time_s[after] - self.time_s[after - 1] < LONGEST_GAP_S))


@dataclass(frozen=True, slots=True)
class Flight:
    """What one observer saw, and where everything was.

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
        By name.
    """

    image_s: Array
    image: NDArray[np.int64]
    uv: Array
    attitude_s: Array
    attitude_rad: Array
    peers: Mapping[str, PeerPath]

    def smoothed(self) -> "Flight":
        """The flight with its attitude smoothed, over what changes at once too.

        A window alone would round that off: a drone tilts at once and comes back slowly, so its
        tilts would seem to be late, or early.
        """
        return replace(self, attitude_rad=_smoothed(self.attitude_rad))

    def thinned(self, most: int) -> "Flight":
        """The flight with at most so many of its images, evenly spread."""
        step = -(-len(self.image_s) // max(most, 1))
        kept = self.image % step == 0
        return replace(
            self,
            image_s=self.image_s[::step],
            image=self.image[kept] // step,
            uv=self.uv[kept],
        )


def _smoothed(values: Array) -> Array:
    """(N, C) values without their noise: a bilateral filter (Tomasi and Manduchi 1998), repeated.

    How large the noise is their second differences tell, whose median no jump moves.
    """
    if len(values) < 3:
        return values
    # Of white noise the second difference has 1 + 4 + 1 times the variance; 1.4826 turns the median
    # of absolute values into a standard deviation.
    bends = np.median(np.abs(np.diff(values, n=2, axis=0)), axis=0)
    noise = np.maximum(1.4826 * bends / np.sqrt(6.0), 1e-9)[:, None]
    side = np.ceil(3 * WIDTH).astype(int)
    near = np.exp(-0.5 * (np.arange(-side, side + 1) / WIDTH) ** 2)
    around = _around(values, side)
    smooth = median_filter(values, size=(3, 1), mode="nearest")
    for _ in range(TIMES):
        apart = (_around(smooth, side) - smooth[:, :, None]) / (APART * noise)
        alike = near / (1 + apart**2) ** 2
        smooth = (alike * around).sum(axis=2) / alike.sum(axis=2)
    return np.asarray(smooth)


def _around(values: Array, side: int) -> Array:
    """(N, C, 2 side + 1) values around each of (N, C); beyond an end stands the last one."""
    padded = np.pad(values, ((side, side), (0, 0)), mode="edge")
    return sliding_window_view(padded, 2 * side + 1, axis=0)


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations: of a detection in pixels, of roll and pitch in radians."""

    pixel_std_px: float = 4.0
    attitude_std_rad: float = 0.015


@dataclass(frozen=True, slots=True)
class Matched:
    """Detections with their peers.

    Parameters
    ----------
    time_s
        (N,) log times of their images.
    uv
        (N, 2) pixels.
    view
        (N,) number of the view, that is of peer and flight.
    whiten
        (N, 2, 2) matrices that turn pixel errors into ones of unit variance, if all errors were
        of single images.
    expected
        Images, of all views, in which a peer was expected.
    radius_px
        How far a detection could be from there.
    """

    time_s: Array
    uv: Array
    view: NDArray[np.int64]
    whiten: Array
    expected: int
    radius_px: float


View = tuple[Flight, PeerPath]
"""One peer in one flight."""


def mounted(camera: Camera, values: Array) -> Camera:
    """The camera with (4,) roll, pitch, yaw (radians) and delay (seconds) of its own."""
    roll, pitch, yaw, delay_s = values.tolist()
    return replace(camera, mount_rad=(roll, pitch, yaw), delay_s=delay_s)


def expected(flight: Flight, camera: Camera, peer: PeerPath, time_s: Array) -> tuple[Array, Array]:
    """(N, 2) pixels of a peer in images stamped so; (N, 3, 5) with the derivatives."""
    at_s = time_s - camera.delay_s
    xyz = peer.at(at_s)
    roll, pitch = (np.interp(at_s, flight.attitude_s, a) for a in flight.attitude_rad.T)
    uv, _, jacobian = pixels_from_horizontal(xyz, roll, pitch, camera)
    return uv, jacobian


def match(views: Sequence[View], camera: Camera, radius_px: float, noise: Noise) -> Matched:
    """The nearest detection of every peer in every image, if it is near."""
    parts, count = [], 0
    for number, (flight, peer) in enumerate(views):
        uv, jacobian = expected(flight, camera, peer, flight.image_s)
        good = peer.covers(flight.image_s - camera.delay_s) & inside(
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
        whiten = _whitening(jacobian[image, :2], peer.spread(time_s - camera.delay_s), noise)
        parts.append((time_s, flight.uv[nearest], np.full(len(image), number), whiten))
    time_s, uv, view, whiten = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Matched(time_s, uv, view, whiten, count, radius_px)


def _whitening(jacobian: Array, covariance: Array, noise: Noise) -> Array:
    """(N, 2, 2) matrices that turn pixel errors into ones of unit variance."""
    joint = np.zeros((len(jacobian), 5, 5))
    joint[:, :3, :3] = covariance
    joint[:, [3, 4], [3, 4]] = noise.attitude_std_rad**2
    # With the covariance C = L L^T of pixel errors e, L^-1 e has unit variance.
    spread = jacobian @ joint @ jacobian.swapaxes(1, 2) + noise.pixel_std_px**2 * np.eye(2)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(spread)))


def residual(views: Sequence[View], camera: Camera, matched: Matched, values: Array) -> Array:
    """(N, 2) detection minus expectation, pixels."""
    out = np.empty_like(matched.uv)
    for number, (flight, peer) in enumerate(views):
        mine = matched.view == number
        uv, _ = expected(flight, mounted(camera, values), peer, matched.time_s[mine])
        out[mine] = matched.uv[mine] - uv
    return np.nan_to_num(out)


def median_px(views: Sequence[View], camera: Camera, matched: Matched, values: Array) -> float:
    """Median distance of detections from where their peers are expected, pixels."""
    apart = residual(views, camera, matched, values)
    return float(np.median(np.linalg.norm(apart, axis=1)))
