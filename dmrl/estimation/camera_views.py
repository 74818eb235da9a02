"""What cameras saw of peers, flight by flight, and where they are expected. Arrays only."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from dmrl.geometry.frames import Array, Camera, inside, pixels_from_horizontal

LONGEST_GAP_S = 0.25
"""Positions are not interpolated over longer gaps."""
WIDTHS, FINER = (0.8, 1.2, 2.0, 3.0, 5.0), 4
"""Standard deviations, in samples, of the windows that attitude may be smoothed over, and the steps
that a sample is cut into. At 100 Hz its noise moves a peer in the image further from sample to
sample than the flight does. Without a window, or on samples alone, there is less of it between two
samples than on one, and a delay settles where there is least."""


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
        """The flight with its attitude smoothed: by the window that best foretells a sample.

        One as wide as the noise asks for would round off what is quick: a drone tilts at once and
        comes back slowly, so that its tilts would seem to be late, or early.
        """
        step_s = max(float(np.median(np.diff(self.attitude_s))), 1e-3)
        fine_s = np.arange(self.attitude_s[0], self.attitude_s[-1], step_s / FINER)
        ways = [_foretold(self.attitude_s, self.attitude_rad, fine_s, width) for width in WIDTHS]
        return replace(self, attitude_s=fine_s, attitude_rad=min(ways, key=lambda way: way[0])[1])

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


def _foretold(time_s: Array, values: Array, fine_s: Array, width: float) -> tuple[float, Array]:
    """How badly (N, C) values, smoothed, foretell one that is left out; and them smoothed."""
    fine = np.column_stack([np.interp(fine_s, time_s, value) for value in values.T])
    smooth = gaussian_filter1d(fine, width * FINER, axis=0, mode="nearest")
    apart = values - np.column_stack([np.interp(time_s, fine_s, value) for value in smooth.T])
    middle = round(6 * width + 1) * FINER
    alone = np.maximum(0.0, 1 - np.abs(np.arange(-middle, middle + 1)) / FINER)
    own = gaussian_filter1d(alone, width * FINER)[middle]
    return float(np.mean(apart**2)) / (1 - own) ** 2, smooth


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
