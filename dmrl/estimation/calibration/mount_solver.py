"""Solve for mount, delay and position errors together, the last step of `extrinsics`. Arrays only.

Errors of estimated positions and of the attitude last for seconds, and partly for a whole flight.
Treated as errors of single images, hundreds of detections would promise a mount to a hundredth of a
degree. So the error of every path is a state too: a constant part and a decaying one (a first-order
Gauss-Markov process), both as large as the covariance of the positions, and a tilt of every flight.
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

from dmrl.estimation.calibration.noise import Noise
from dmrl.estimation.calibration.observations import (
    Matched,
    View,
    expected,
    mounted,
    residual,
)
from dmrl.geometry.frames import Array, Camera

STAYS = np.array([0.6, 0.2, 0.3])
"""Variance of the constant part along the line of sight, across it and up, relative to the
position's. Simulated labelled flights, half calibrated, half realistic, gave 0.6, 0.2 and 0.2; a
height's error is its sensor's bias."""
FADES, FADES_S = 0.55, 3.5
"""Relative variance of the decaying part, across the line of sight, and its correlation time,
seconds. The same flights gave 0.55 and 3 to 4 s, and none along the line of sight."""
LEVEL = 0.5
"""Share of the attitude's standard deviation that is a constant tilt of a flight. No record of how
the value was chosen."""
NEAREST_M = 0.1
"""Smallest horizontal distance of a peer, metres, against a division by zero."""
TURNS = 0.016
"""Variance of a rotation of the whole path, relative to that of a bearing. No record of how the
value was chosen."""
KNOT_S = 0.2
"""Spacing of the values of the decaying part, seconds. No record of how the value was chosen."""
CAUCHY = 2.4
"""Scale of the Cauchy loss in standard deviations: 95 % efficient if all errors are Gaussian."""
MEDIAN = 2 * np.log(2.0)
"""Median squared length of a 2D Gaussian vector, relative to the variance of either axis."""
STEPS = np.array([1e-3, 1e-3, 1e-3, 5e-3])
"""Steps of the numeric derivatives: radians and seconds."""
NOTHING = 1e-6
"""Information about a fixed delay, 1/s^2: practically none."""
ROUNDS, SETTLED = 30, 1e-4
"""Largest number of iterations, and largest change, radians or seconds, that ends them. No record
of how the values were chosen."""
LARGEST = np.array([0.35, 0.35, 0.35, 0.5])
"""Bounds of mount and delay: radians and seconds. No record of how the values were chosen."""


@dataclass(frozen=True, slots=True)
class Mount:
    """Estimate of mount and delay from detections.

    Parameters
    ----------
    values
        (4,) roll, pitch, yaw of the mount, radians, and the delay, seconds.
    covariance
        (4, 4) of these.
    cost
        Negative log likelihood, up to a constant, of matched and missed detections and of path
        errors.
    spread_px
        Standard deviation of single detections, in u and in v, from the residuals.
    """

    values: Array
    covariance: Array
    cost: float
    spread_px: float


@dataclass(frozen=True, slots=True)
class _Path:
    """Detections of one peer in one flight, and the errors of its path, sparse.

    ``errors`` (2 N, E) maps the normalized errors to pixels, u and v of a detection below each
    other. ``level`` (2 N, 2) does so for the flight's errors of roll and pitch. ``prior`` (E, E) is
    the information of the errors: unit variance, decaying.
    """

    flight: int
    rows: NDArray[np.intp]
    errors: csr_array
    level: Array
    prior: csr_array


@dataclass(slots=True)
class _Errors:
    """Nuisance states beside mount and delay: of each path, and (F, 2) tilts of the flights."""

    paths: list[Array]
    levels: Array


def solve(
    views: Sequence[View],
    camera: Camera,
    matched: Matched,
    start: Array,
    noise: Noise,
    spread_px: float,
    *,
    held: bool = False,
) -> Mount:
    """Solve for mount, delay and path errors by iteratively reweighted least squares.

    The Schur complement eliminates the errors of each path, then of each flight.

    Parameters
    ----------
    views
        Peers in flights.
    camera
        Intrinsics.
    matched
        Detections with their peers.
    start
        (4,) initial mount and delay.
    noise
        Noise of the attitude.
    spread_px
        Standard deviation of a single detection.
    fix_delay
        Whether the delay keeps its value.
    """
    paths = _paths(views, camera, matched, start)
    flights = 1 + max(path.flight for path in paths)
    level = 1 / (LEVEL * noise.attitude_std_rad) ** 2
    values = np.clip(start, -0.99 * LARGEST, 0.99 * LARGEST)
    errors = _Errors([np.zeros(path.prior.shape[0]) for path in paths], np.zeros((flights, 2)))
    information = np.eye(4)
    for _ in range(ROUNDS):
        apart = residual(views, camera, matched, values)
        slopes = slopes_of(views, camera, matched, values)
        if held:
            slopes[:, :, 3] = 0.0
        information, step = _step(paths, errors, level, apart, slopes, spread_px)
        moved = np.clip(values + step, -LARGEST, LARGEST)
        settled = np.abs(moved - values).max() < SETTLED
        values = moved
        if settled:
            break
    left = _left(paths, errors, residual(views, camera, matched, values))
    square = (left**2).sum(axis=1)
    cost = _charge(square / spread_px**2) + 0.5 * level * float((errors.levels**2).sum())
    cost += sum(
        0.5 * float(e @ path.prior @ e) for path, e in zip(paths, errors.paths, strict=True)
    )
    missed = matched.expected - len(matched.time_s)
    cost += missed * _charge(np.array([(matched.radius_px / spread_px) ** 2]))
    found_px = float(np.sqrt(np.median(square) / MEDIAN))
    return Mount(values, np.asarray(np.linalg.inv(information)), float(cost), found_px)


def _charge(square: Array) -> float:
    """Return the summed Cauchy loss of squared, normalized residuals."""
    return float(0.5 * CAUCHY**2 * np.log1p(square / CAUCHY**2).sum())


def _left(paths: Sequence[_Path], errors: _Errors, apart: Array) -> Array:
    """Return (N, 2) residuals of all detections without the part of the path errors, pixels."""
    out = apart.copy()
    for path, error in zip(paths, errors.paths, strict=True):
        explained = path.errors @ error + path.level @ errors.levels[path.flight]
        out[path.rows] -= explained.reshape(-1, 2)
    return out


def _step(
    paths: Sequence[_Path],
    errors: _Errors,
    level: float,
    apart: Array,
    slopes: Array,
    spread_px: float,
) -> tuple[Array, Array]:
    """Return information (4, 4) and step (4,) of mount and delay; update ``errors`` in place."""
    left = _left(paths, errors, apart)
    halves = [
        _normal(path, error, left[path.rows], slopes[path.rows], spread_px)
        for path, error in zip(paths, errors.paths, strict=True)
    ]
    # A fixed delay has no derivative; this term keeps the matrix regular.
    information, score, rests = np.diag([0.0, 0.0, 0.0, NOTHING]), np.zeros(4), []
    for flight, held in enumerate(errors.levels):
        mine = [half for path, half in zip(paths, halves, strict=True) if path.flight == flight]
        joint = sum((half.information for half in mine), np.zeros((6, 6)))
        pull = sum((half.score for half in mine), np.zeros(6))
        joint[[4, 5], [4, 5]] += level
        pull[4:] -= level * held
        rest = np.linalg.solve(joint[4:, 4:], np.column_stack([pull[4:], joint[4:, :4]]))
        information += joint[:4, :4] - joint[:4, 4:] @ rest[:, 1:]
        score += pull[:4] - joint[:4, 4:] @ rest[:, 0]
        rests.append(rest)
    step = np.asarray(np.linalg.solve(information, score), np.float64)
    levels = np.stack([rest[:, 0] - rest[:, 1:] @ step for rest in rests])
    for k, (path, half) in enumerate(zip(paths, halves, strict=True)):
        errors.paths[k] = errors.paths[k] + half.follow(np.r_[step, levels[path.flight]])
    errors.levels = errors.levels + levels
    return information, step


@dataclass(frozen=True, slots=True)
class _Half:
    """Normal equations of one path in mount, delay and tilt, with its errors eliminated.

    ``own`` (E,) is the step of the errors at fixed mount, delay and tilt. ``cross`` (E, 6) is the
    negated derivative of that step by them.
    """

    information: Array
    score: Array
    own: Array
    cross: Array

    def follow(self, step: Array) -> Array:
        """Return (E,) the step of the errors, given the step of mount, delay and tilt."""
        return np.asarray(self.own - self.cross @ step)


def _normal(path: _Path, error: Array, left: Array, slopes: Array, spread_px: float) -> _Half:
    """Build the reduced normal equations of one path."""
    # The Cauchy weight 1 / (1 + r^2 / c^2), as its root on either side of the normal equations.
    far = (left**2).sum(axis=1) / (CAUCHY * spread_px) ** 2
    root = np.repeat(1.0 / (spread_px * np.sqrt(1.0 + far)), 2)
    errors = csr_array(path.errors.multiply(root[:, None]))
    slopes = root[:, None] * np.hstack([slopes.reshape(len(root), -1), path.level])
    rest = root * left.ravel()
    cross = errors.T @ slopes
    pull = errors.T @ rest - path.prior @ error
    solved = splu(csc_array(errors.T @ errors + path.prior)).solve(np.column_stack([pull, cross]))
    own, across = solved[:, 0], solved[:, 1:]
    return _Half(slopes.T @ slopes - cross.T @ across, slopes.T @ rest - cross.T @ own, own, across)


def _paths(views: Sequence[View], camera: Camera, matched: Matched, start: Array) -> list[_Path]:
    """Linearize the errors of each peer's path at its detections."""
    flights = {id(flight): k for k, (flight, _) in enumerate(views)}
    seen = [number for number in range(len(views)) if (matched.view == number).any()]
    order = list(dict.fromkeys(flights[id(views[number][0])] for number in seen))
    return [
        _path(views[n], order.index(flights[id(views[n][0])]), n, camera, matched, start)
        for n in seen
    ]


def _path(
    view: View, flight: int, number: int, camera: Camera, matched: Matched, start: Array
) -> _Path:
    """Linearize the errors of one peer's path."""
    rows = np.flatnonzero(matched.view == number)
    time_s = matched.time_s[rows]
    at_s = time_s - start[3]
    _, jacobian = expected(view[0], mounted(camera, start), view[1], time_s)
    jacobian = np.nan_to_num(jacobian[:, :2])
    axes, turn = _axes(view[1].at(at_s), view[1].spread(at_s))
    shown = jacobian[:, :, :3] @ axes
    knots = np.arange(time_s[0] - KNOT_S, time_s[-1] + 2 * KNOT_S, KNOT_S)
    after = np.searchsorted(knots, time_s)
    share = (time_s - knots[after - 1]) / KNOT_S
    here = np.arange(len(rows))
    hats = csr_array(
        (np.r_[1 - share, share], (np.r_[here, here], np.r_[after - 1, after])),
        shape=(len(rows), len(knots)),
    )
    # Rows u and v of each detection below each other, in the order of the residuals.
    fading = kron(hats, np.ones((2, 1)), format="csr").multiply(
        (shown[:, :, 1] * np.sqrt(FADES)).reshape(-1, 1)
    )
    turned = shown[:, :, 1:2] * turn[:, None, None]
    lasting = np.concatenate([shown * np.sqrt(STAYS), turned], axis=2).reshape(2 * len(rows), -1)
    return _Path(
        flight,
        rows,
        csr_array(hstack([csr_array(lasting), fading])),
        jacobian[:, :, 3:].reshape(2 * len(rows), -1),
        csr_array(block_diag([eye_array(lasting.shape[1]), _chain(len(knots))])),
    )


def _axes(xyz_m: Array, spread: Array) -> tuple[Array, Array]:
    """Return the standard deviations along, across and above the line of sight, and of a rotation.

    (N, 3, 3) in metres; (N,) the effect of a unit rotation of the whole path, relative to that
    across.
    """
    level = np.maximum(np.linalg.norm(xyz_m[:, :2], axis=1), NEAREST_M)
    x, y, none = xyz_m[:, 0] / level, xyz_m[:, 1] / level, np.zeros(len(xyz_m))
    axes = np.stack([x, -y, none, y, x, none, none, none, none + 1], axis=1).reshape(-1, 3, 3)
    std_m = np.sqrt(np.einsum("nia,nij,nja->na", axes, spread, axes) + 1e-12)
    turn_rad = np.sqrt(TURNS) * np.median(std_m[:, 1] / level)
    return axes * std_m[:, None, :], turn_rad * level / std_m[:, 1]


def _chain(count: int) -> csr_array:
    """Return the (count, count) information of a Gauss-Markov process of unit variance."""
    # x_k = keeps x_(k-1) + noise of variance 1 - keeps^2. A knot depends on its two neighbours
    # only, so the inverse of the covariance is tridiagonal; the ends have one neighbour.
    keeps = np.exp(-KNOT_S / FADES_S)
    middle = np.full(count, 1 + keeps**2)
    middle[[0, -1]] = 1.0
    beside = np.full(count - 1, -keeps)
    bands = diags_array([beside, middle, beside], offsets=[-1, 0, 1])
    return csr_array(bands / (1 - keeps**2))


def slopes_of(views: Sequence[View], camera: Camera, matched: Matched, values: Array) -> Array:
    """Return (N, 2, 4) derivatives of the predicted pixel by roll, pitch, yaw and delay."""
    # A residual is detection minus prediction, so its derivative is the prediction's, negated.
    sides = [
        residual(views, camera, matched, values - step)
        - residual(views, camera, matched, values + step)
        for step in np.diag(STEPS)
    ]
    return np.asarray(np.stack(sides, axis=2) / (2 * STEPS))
