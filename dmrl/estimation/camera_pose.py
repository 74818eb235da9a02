"""How a camera is mounted, and how late its images are stamped, from a flight. Arrays only.

The network says where a peer is in the image; ranges and odometry say where it is in the
horizontal frame. What is left between the two, over a whole flight, is the mount's rotation and
the clock's offset: the bias that Li et al. saw in their labels and left there. Both come by
maximum likelihood, every label with its own covariance, outliers tamed by Cauchy's loss.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from dmrl.geometry.frames import Array, Camera, inside, pixels_from_horizontal

RADII_PX = (60.0, 40.0, 25.0)
"""How far a detection may be from where its peer is expected, round by round."""
LARGEST_RAD, LARGEST_S = 0.35, 0.5
STEP = 1e-3
"""Of the numeric derivatives: radians and seconds."""
LONGEST_GAP_S = 0.25
"""Positions are not interpolated over longer gaps."""
LEAST_FLIGHTS, PARTS = 3, 10
"""Flights that are left out in turn, for the standard errors; stretches, where they are fewer."""
LEAST = 50
"""Fewest matched detections that are worth a calibration."""


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


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations: of a detection in pixels, of roll and pitch in radians."""

    pixel_std_px: float = 4.0
    attitude_std_rad: float = 0.015


@dataclass(frozen=True, slots=True)
class Calibration:
    """The camera, and how well it is known.

    Parameters
    ----------
    camera
        With its mount and delay.
    mount_std_rad
        (3,) standard errors of roll, pitch and yaw, by the jackknife over flights or, where they
        are fewer than three, stretches of them: errors of positions last for seconds, and partly
        for a flight, so a count of images would promise too much.
    delay_std_s
        Of the delay.
    matched
        How many detections were used.
    before_px, after_px
        Median distance of those from where their peers were expected.
    """

    camera: Camera
    mount_std_rad: tuple[float, float, float]
    delay_std_s: float
    matched: int
    before_px: float
    after_px: float


@dataclass(frozen=True, slots=True)
class _Matched:
    """Detections with their peers: when, where in the image, in which view, their weight."""

    time_s: Array
    uv: Array
    view: NDArray[np.int64]
    whiten: Array

    def select(self, keep: NDArray[np.bool_]) -> "_Matched":
        return _Matched(self.time_s[keep], self.uv[keep], self.view[keep], self.whiten[keep])


View = tuple[Flight, PeerPath]
"""One peer in one flight."""


def calibrate(flights: Sequence[Flight], camera: Camera, noise: Noise) -> Calibration | None:
    """The mount's rotation and the delay; None where too few detections fit.

    Parameters
    ----------
    flights
        Detections, attitude, and positions of the peers.
    camera
        Intrinsics, and the mount and delay to start from.
    noise
        Of detections and attitude.
    """
    views = [(flight, peer) for flight in flights for peer in flight.peers.values()]
    if not views:
        return None
    start = np.array([*camera.mount_rad, camera.delay_s])
    found, matched = start, None
    for radius_px in RADII_PX:
        matched = _match(views, _camera(camera, found), radius_px, noise)
        if len(matched.time_s) < LEAST:
            return None
        found = _solve(views, camera, matched, found)
    assert matched is not None
    parts = _parts(views, matched)
    rest = [matched.select(parts != k) for k in np.unique(parts)]
    without = [_solve(views, camera, part, found) for part in rest]
    spread = np.sqrt((len(without) - 1) * np.var(without, axis=0))
    return Calibration(
        _camera(camera, found),
        (float(spread[0]), float(spread[1]), float(spread[2])),
        float(spread[3]),
        len(matched.time_s),
        _median_px(views, camera, matched, start),
        _median_px(views, camera, matched, found),
    )


def _parts(views: Sequence[View], matched: _Matched) -> NDArray[np.int64]:
    """(N,) number of the stretch that is left out together with a detection.

    Whole flights where there are several: what biases the positions of one, such as the flow's
    scale, does not change within it.
    """
    flights = list({id(flight): flight for flight, _ in views})
    if len(flights) >= LEAST_FLIGHTS:
        return np.array([flights.index(id(flight)) for flight, _ in views])[matched.view]
    order = np.argsort(np.argsort(matched.time_s, kind="stable"), kind="stable")
    return np.asarray(order * PARTS // max(len(order), 1))


def _camera(camera: Camera, values: Array) -> Camera:
    roll, pitch, yaw, delay_s = values.tolist()
    return replace(camera, mount_rad=(roll, pitch, yaw), delay_s=delay_s)


def _expected(flight: Flight, camera: Camera, peer: PeerPath, time_s: Array) -> tuple[Array, Array]:
    """(N, 2) pixels of a peer in images stamped so; (N, 3, 5) with the derivatives."""
    at_s = time_s - camera.delay_s
    xyz = np.column_stack([np.interp(at_s, peer.time_s, axis) for axis in peer.xyz_m.T])
    roll, pitch = (np.interp(at_s, flight.attitude_s, a) for a in flight.attitude_rad.T)
    uv, _, jacobian = pixels_from_horizontal(xyz, roll, pitch, camera)
    return uv, jacobian


def _match(views: Sequence[View], camera: Camera, radius_px: float, noise: Noise) -> _Matched:
    """The nearest detection of every peer in every image, if it is near."""
    parts = []
    for number, (flight, peer) in enumerate(views):
        uv, jacobian = _expected(flight, camera, peer, flight.image_s)
        good = _covered(peer, flight.image_s - camera.delay_s) & inside(
            uv, camera.width_px, camera.height_px
        )
        apart_px = np.linalg.norm(flight.uv - uv[flight.image], axis=1)
        apart_px[~good[flight.image]] = np.inf
        order = np.lexsort((apart_px, flight.image))
        _, first = np.unique(flight.image[order], return_index=True)
        nearest = order[first]
        nearest = nearest[apart_px[nearest] <= radius_px]
        image = flight.image[nearest]
        time_s = flight.image_s[image]
        whiten = _whitening(jacobian[image, :2], _spread(peer, time_s - camera.delay_s), noise)
        parts.append((time_s, flight.uv[nearest], np.full(len(image), number), whiten))
    return _Matched(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _covered(peer: PeerPath, at_s: Array) -> NDArray[np.bool_]:
    """(N,) whether the peer's position is known shortly before and after a time."""
    after = np.searchsorted(peer.time_s, at_s)
    known = (after > 0) & (after < len(peer.time_s))
    after = np.clip(after, 1, len(peer.time_s) - 1)
    return np.asarray(known & (peer.time_s[after] - peer.time_s[after - 1] < LONGEST_GAP_S))


def _spread(peer: PeerPath, at_s: Array) -> Array:
    """(N, 3, 3) covariance of the peer's position at the nearest times."""
    return peer.covariance[np.clip(np.searchsorted(peer.time_s, at_s), 0, len(peer.time_s) - 1)]


def _whitening(jacobian: Array, covariance: Array, noise: Noise) -> Array:
    """(N, 2, 2) matrices that turn pixel errors into ones of unit variance."""
    joint = np.zeros((len(jacobian), 5, 5))
    joint[:, :3, :3] = covariance
    joint[:, [3, 4], [3, 4]] = noise.attitude_std_rad**2
    spread = jacobian @ joint @ jacobian.swapaxes(1, 2) + noise.pixel_std_px**2 * np.eye(2)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(spread)))


def _residual(views: Sequence[View], camera: Camera, matched: _Matched, values: Array) -> Array:
    """(N, 2) detection minus expectation, pixels."""
    out = np.empty_like(matched.uv)
    for number, (flight, peer) in enumerate(views):
        mine = matched.view == number
        uv, _ = _expected(flight, _camera(camera, values), peer, matched.time_s[mine])
        out[mine] = matched.uv[mine] - uv
    return np.nan_to_num(out)


def _solve(views: Sequence[View], camera: Camera, matched: _Matched, start: Array) -> Array:
    """(4,) roll, pitch, yaw (rad) and delay (s) of the greatest likelihood."""

    def white(values: Array) -> Array:
        apart = _residual(views, camera, matched, values)
        return np.asarray((matched.whiten @ apart[..., None]).ravel())

    def slopes(values: Array) -> Array:
        steps = STEP * np.eye(4)
        sides = [(white(values + step), white(values - step)) for step in steps]
        return np.column_stack([(ahead - behind) / (2 * STEP) for ahead, behind in sides])

    limit = np.array([LARGEST_RAD] * 3 + [LARGEST_S])
    start = np.clip(start, -0.99 * limit, 0.99 * limit)
    found = least_squares(white, start, slopes, bounds=(-limit, limit), loss="cauchy")
    return np.asarray(found.x)


def _median_px(views: Sequence[View], camera: Camera, matched: _Matched, values: Array) -> float:
    apart = _residual(views, camera, matched, values)
    return float(np.median(np.linalg.norm(apart, axis=1)))
