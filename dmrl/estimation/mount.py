"""Mount, delay and errors of positions in one solve: what camera_pose ends with. Arrays only.

Positions that were estimated are off for seconds, and partly for a whole flight: a bias of the
ranges, of a height sensor. Taken as errors of single images, hundreds of detections would promise
a mount to a hundredth of a degree. So the error of every peer's path is solved for as well, as a
part that stays and one that fades (a first-order Gauss-Markov process), both as large as the
covariance of the positions says; the standard errors of mount and delay are what is left.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import (
    block_diag,
    csc_array,
    csr_array,
    diags_array,
    eye_array,
    hstack,
    kron,
)
from scipy.sparse.linalg import splu

from dmrl.estimation.camera_views import Matched, Noise, View, expected, mounted, residual
from dmrl.geometry.frames import Array, Camera

STAYS, FADES = np.array([0.5, 0.5, 1.0]), np.array([1.0, 1.0])
"""Variance of the part of an error that stays, along x, y and z, and of the one that fades, along x
and y, by the covariance of the position. Of simulated flights with calibrated and realistic sensors
a bias of the ranges stays and a bearing fades; a height's error is its sensor's bias."""
TURNS = 0.15
"""Variance of a turn of the whole path, of that of a bearing."""
NEAREST_M = 0.1
FADES_S = 2.5
"""Correlation time of the rest."""
KNOT_S = 1.0
"""Between its values are interpolated."""
CAUCHY = 2.4
"""Residuals beyond so many standard deviations count less: 95 % efficient if all are Gaussian."""
STEPS = np.array([1e-3, 1e-3, 1e-3, 5e-3])
"""Of the numeric derivatives: radians and seconds."""
ROUNDS, SETTLED = 30, 1e-4
LARGEST = np.array([0.35, 0.35, 0.35, 0.5])
"""Mount and delay that are believed: radians and seconds."""


@dataclass(frozen=True, slots=True)
class Mount:
    """What detections say of a camera.

    Parameters
    ----------
    values
        (4,) roll, pitch, yaw of the mount, radians, and the delay, seconds.
    covariance
        (4, 4) of these.
    cost
        Negative logarithm of the likelihood there, to a constant: of the detections that were
        matched, of those that were missed, and of the errors of the paths.
    """

    values: Array
    covariance: Array
    cost: float


@dataclass(frozen=True, slots=True)
class _Path:
    """Detections of one peer in one flight, and the errors of its path.

    ``errors`` (2 N, E) turns the errors' normalised values into pixels, u and v of a detection
    below each other; ``prior`` (E, E) is their information: unit variance, fading. Both sparse:
    a flight of an hour has thousands of errors, and a detection sees eight.
    """

    rows: NDArray[np.intp]
    errors: csr_array
    prior: csr_array


def solve(
    views: Sequence[View],
    camera: Camera,
    matched: Matched,
    start: Array,
    noise: Noise,
) -> Mount:
    """Mount, delay and the errors of all paths of the greatest likelihood.

    Parameters
    ----------
    views
        Peers in flights.
    camera
        Intrinsics.
    matched
        Detections with their peers.
    start
        (4,) mount and delay to start from.
    noise
        Of a detection, and of attitude.

    Returns
    -------
    Mount
        Iterated, reweighted least squares with Cauchy's weights; the errors of each path leave
        the normal equations by the Schur complement, as they touch no other path.
    """
    paths = [
        _path(view, number, camera, matched, start)
        for number, view in enumerate(views)
        if (matched.view == number).any()
    ]
    spread_px = np.hypot(noise.pixel_std_px, noise.attitude_std_rad * camera.fx_px)
    values = np.clip(start, -0.99 * LARGEST, 0.99 * LARGEST)
    errors = [np.zeros(path.prior.shape[0]) for path in paths]
    information = np.eye(4)
    for _ in range(ROUNDS):
        apart = residual(views, camera, matched, values)
        slopes = slopes_of(views, camera, matched, values)
        information, score = np.zeros((4, 4)), np.zeros(4)
        halves = []
        for path, error in zip(paths, errors, strict=True):
            half = _normal(path, error, apart[path.rows], slopes[path.rows], spread_px)
            halves.append(half)
            information += half.information
            score += half.score
        step = np.asarray(np.linalg.solve(information, score), np.float64)
        errors = [e + h.follow(step) for e, h in zip(errors, halves, strict=True)]
        moved = np.clip(values + step, -LARGEST, LARGEST)
        settled = np.abs(moved - values).max() < SETTLED
        values = moved
        if settled:
            break
    apart = residual(views, camera, matched, values)
    cost = sum(
        _cost(path, error, apart[path.rows], spread_px)
        for path, error in zip(paths, errors, strict=True)
    )
    missed = matched.expected - len(matched.time_s)
    cost += missed * _charge(np.array([(matched.radius_px / spread_px) ** 2]))
    return Mount(values, np.asarray(np.linalg.inv(information)), float(cost))


def _charge(square: Array) -> float:
    """Cauchy's loss of squared, normalised residuals, summed."""
    return float(0.5 * CAUCHY**2 * np.log1p(square / CAUCHY**2).sum())


def _cost(path: "_Path", error: Array, apart: Array, spread_px: float) -> float:
    left = apart.ravel() - path.errors @ error
    square = (left.reshape(-1, 2) ** 2).sum(axis=1) / spread_px**2
    return _charge(square) + 0.5 * float(error @ path.prior @ error)


@dataclass(frozen=True, slots=True)
class _Half:
    """Normal equations of one path, its errors eliminated.

    ``own`` (E,) is the step of the errors if mount and delay stay, ``cross`` (E, 4) what a step of
    those adds.
    """

    information: Array
    score: Array
    own: Array
    cross: Array

    def follow(self, step: Array) -> Array:
        """(E,) step of the errors, given the step of mount and delay."""
        return np.asarray(self.own - self.cross @ step)


def _normal(path: _Path, error: Array, apart: Array, slopes: Array, spread_px: float) -> _Half:
    left = apart.ravel() - path.errors @ error
    far = (left.reshape(-1, 2) ** 2).sum(axis=1) / (CAUCHY * spread_px) ** 2
    root = np.repeat(1.0 / (spread_px * np.sqrt(1.0 + far)), 2)
    errors = csr_array(path.errors.multiply(root[:, None]))
    slopes, rest = root[:, None] * slopes.reshape(len(root), -1), root * left
    cross = errors.T @ slopes
    pull = errors.T @ rest - path.prior @ error
    solved = splu(csc_array(errors.T @ errors + path.prior)).solve(np.column_stack([pull, cross]))
    own, across = solved[:, 0], solved[:, 1:]
    information = slopes.T @ slopes - cross.T @ across
    return _Half(information, slopes.T @ rest - cross.T @ own, own, across)


def _path(view: View, number: int, camera: Camera, matched: Matched, start: Array) -> _Path:
    """How the errors of one peer's path show in the image."""
    flight, peer = view
    rows = np.flatnonzero(matched.view == number)
    time_s = matched.time_s[rows]
    at_s = time_s - start[3]
    _, jacobian = expected(flight, mounted(camera, start), peer, time_s)
    spread = peer.spread(at_s) + 1e-12 * np.eye(3)
    shown = jacobian[:, :2, :3] @ np.linalg.cholesky(spread)
    turn = jacobian[:, :2, :3] @ _turn(peer.at(at_s), spread)[..., None]
    knots = np.arange(time_s[0] - KNOT_S, time_s[-1] + 2 * KNOT_S, KNOT_S)
    after = np.searchsorted(knots, time_s)
    share = (time_s - knots[after - 1]) / KNOT_S
    here = np.arange(len(rows))
    hats = csr_array(
        (np.r_[1 - share, share], (np.r_[here, here], np.r_[after - 1, after])),
        shape=(len(rows), len(knots)),
    )
    # Rows u and v of each detection below each other, as the residuals lie.
    both = kron(hats, np.ones((2, 1)), format="csr")
    fading = [
        both.multiply((shown[:, :, axis] * np.sqrt(FADES[axis])).reshape(-1, 1)) for axis in (0, 1)
    ]
    lasting = np.concatenate([shown * np.sqrt(STAYS), turn], axis=2).reshape(2 * len(rows), -1)
    chain = _chain(len(knots))
    return _Path(
        rows,
        csr_array(hstack([csr_array(lasting), *fading])),
        csr_array(block_diag([eye_array(lasting.shape[1]), chain, chain])),
    )


def _turn(xyz_m: Array, spread: Array) -> Array:
    """(N, 3) shift of positions by a turn about the observer of one standard deviation, metres.

    Headings drift together: as if the whole path were turned, by `TURNS` of the variance that the
    positions' covariance gives a bearing.
    """
    level = np.linalg.norm(xyz_m[:, :2], axis=1, keepdims=True)
    across = np.column_stack([-xyz_m[:, 1], xyz_m[:, 0], np.zeros(len(xyz_m))])
    beside = across / np.maximum(level, NEAREST_M)
    spread_m = np.sqrt(np.einsum("ni,nij,nj->n", beside, spread, beside))
    bearing_rad = np.median(spread_m / np.maximum(level[:, 0], NEAREST_M))
    return np.asarray(across * (np.sqrt(TURNS) * bearing_rad))


def _chain(count: int) -> csr_array:
    """(count, count) information of a Gauss-Markov process of unit variance, knot by knot."""
    keeps = np.exp(-KNOT_S / FADES_S)
    middle = np.full(count, 1 + keeps**2)
    middle[[0, -1]] = 1.0
    beside = np.full(count - 1, -keeps)
    bands = diags_array([beside, middle, beside], offsets=[-1, 0, 1])
    return csr_array(bands / (1 - keeps**2))


def slopes_of(views: Sequence[View], camera: Camera, matched: Matched, values: Array) -> Array:
    """(N, 2, 4) derivatives of the expected pixel by roll, pitch, yaw and delay."""
    sides = [
        residual(views, camera, matched, values - step)
        - residual(views, camera, matched, values + step)
        for step in np.diag(STEPS)
    ]
    return np.asarray(np.stack(sides, axis=2) / (2 * STEPS))
