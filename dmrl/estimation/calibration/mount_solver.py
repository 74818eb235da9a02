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
from scipy.sparse import block_diag, csc_array, csr_array, diags_array, eye_array, hstack, kron
from scipy.sparse.linalg import splu

from dmrl.estimation.calibration.noise import Noise
from dmrl.estimation.calibration.observations import (
    Matches,
    PeerView,
    pixel_residuals,
    predict_pixels,
    with_mount,
)
from dmrl.geometry.frames import Array, Camera

CONSTANT_SHARE = np.array([0.6, 0.2, 0.3])
"""Variance of the constant part along the line of sight, across it and up, relative to the
position's. Simulated labelled flights, half calibrated, half realistic, gave 0.6, 0.2 and 0.2; a
height's error is its sensor's bias."""
DECAYING_SHARE, DECAY_S = 0.55, 3.5
"""Relative variance of the decaying part, across the line of sight, and its correlation time,
seconds. The same flights gave 0.55 and 3 to 4 s, and none along the line of sight."""
CONSTANT_TILT_SHARE = 0.5
"""Share of the attitude's standard deviation that is a constant tilt of a flight. No record of how
the value was chosen."""
MIN_DISTANCE_M = 0.1
"""Smallest horizontal distance of a peer, metres, against a division by zero."""
ROTATION_SHARE = 0.016
"""Variance of a rotation of the whole path, relative to that of a bearing. No record of how the
value was chosen."""
KNOT_SPACING_S = 0.2
"""Spacing of the values of the decaying part, seconds. No record of how the value was chosen."""
CAUCHY_SIGMAS = 2.4
"""Scale of the Cauchy loss in standard deviations: 95 % efficient if all errors are Gaussian."""
MEDIAN_SQUARED_NORM = 2 * np.log(2.0)
"""Median squared length of a 2D Gaussian vector, relative to the variance of either axis."""
DERIVATIVE_STEPS = np.array([1e-3, 1e-3, 1e-3, 5e-3])
"""Steps of the numeric derivatives: radians and seconds."""
WEAK_INFORMATION = 1e-6
"""Information about a fixed delay, 1/s^2: practically none."""
MAX_ROUNDS, TOLERANCE = 30, 1e-4
"""Largest number of iterations, and largest change, radians or seconds, that ends them. No record
of how the values were chosen."""
MAX_VALUES = np.array([0.35, 0.35, 0.35, 0.5])
"""Bounds of mount and delay: radians and seconds. No record of how the values were chosen."""


@dataclass(frozen=True, slots=True)
class MountEstimate:
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
class _PathErrors:
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


def solve_mount(
    views: Sequence[PeerView],
    camera: Camera,
    matched: Matches,
    start: Array,
    noise: Noise,
    spread_px: float,
    *,
    fix_delay: bool = False,
) -> MountEstimate:
    """Solve for mount, delay and path errors by iteratively reweighted least squares.

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
    paths = _linearize_paths(views, camera, matched, start)
    shown, prior = _stack_errors(paths, 1 / (CONSTANT_TILT_SHARE * noise.attitude_std_rad) ** 2)
    values = np.clip(start, -0.99 * MAX_VALUES, 0.99 * MAX_VALUES)
    errors, covariance = np.zeros(len(prior.diagonal())), np.eye(4)
    for _ in range(MAX_ROUNDS):
        left = pixel_residuals(views, camera, matched, values).ravel() - shown @ errors
        slopes = pixel_jacobian(views, camera, matched, values)
        if fix_delay:
            slopes[:, :, 3] = 0.0
        design = csr_array(hstack([csr_array(slopes.reshape(-1, 4)), shown]))
        covariance, step = _solve_step(design, prior, errors, left, spread_px)
        errors = errors + step[4:]
        moved = np.clip(values + step[:4], -MAX_VALUES, MAX_VALUES)
        settled = np.abs(moved - values).max() < TOLERANCE
        values = moved
        if settled:
            break
    left = pixel_residuals(views, camera, matched, values).ravel() - shown @ errors
    square = (left.reshape(-1, 2) ** 2).sum(axis=1)
    cost = _cauchy_cost(square / spread_px**2) + 0.5 * float(errors @ prior @ errors)
    missed = matched.expected - len(matched.time_s)
    cost += missed * _cauchy_cost(np.array([(matched.radius_px / spread_px) ** 2]))
    found_px = float(np.sqrt(np.median(square) / MEDIAN_SQUARED_NORM))
    return MountEstimate(values, covariance, float(cost), found_px)


def _cauchy_cost(square: Array) -> float:
    """Return the summed Cauchy loss of squared, normalized residuals."""
    return float(0.5 * CAUCHY_SIGMAS**2 * np.log1p(square / CAUCHY_SIGMAS**2).sum())


def _stack_errors(paths: Sequence[_PathErrors], level: float) -> tuple[csr_array, csr_array]:
    """Stack the errors of all paths, then the tilts of the flights, (2 N, E) and (E, E).

    Parameters
    ----------
    paths
        Paths, in the order of their detections.
    level
        Information of a tilt.
    """
    flights = 1 + max(path.flight for path in paths)
    tilts = [np.kron(np.eye(flights)[path.flight], path.level) for path in paths]
    shown = hstack([block_diag([path.errors for path in paths]), csr_array(np.concatenate(tilts))])
    prior = block_diag([*(path.prior for path in paths), level * eye_array(2 * flights)])
    return csr_array(shown), csr_array(prior)


def _solve_step(
    design: csr_array, prior: csr_array, errors: Array, left: Array, spread_px: float
) -> tuple[Array, Array]:
    """Return the covariance (4, 4) of mount and delay, and the step (4 + E,) of all unknowns.

    Parameters
    ----------
    design
        (2 N, 4 + E) derivatives of the pixels.
    prior, errors
        Information and present values of the errors.
    left
        (2 N,) residuals, pixels.
    spread_px
        Standard deviation of a single detection.
    """
    # The Cauchy weight 1 / (1 + r^2 / c^2), as its root on either side of the normal equations.
    far = (left.reshape(-1, 2) ** 2).sum(axis=1) / (CAUCHY_SIGMAS * spread_px) ** 2
    root = np.repeat(1.0 / (spread_px * np.sqrt(1.0 + far)), 2)
    design = csr_array(design.multiply(root[:, None]))
    # A fixed delay has no derivative; this term keeps the matrix regular.
    weak = diags_array([0.0, 0.0, 0.0, WEAK_INFORMATION])
    normal = design.T @ design + block_diag([weak, prior])
    score = design.T @ (root * left)
    score[4:] -= prior @ errors
    solved = splu(csc_array(normal)).solve(np.column_stack([score, np.eye(len(score), 4)]))
    return solved[:4, 1:], solved[:, 0]


def _linearize_paths(
    views: Sequence[PeerView], camera: Camera, matched: Matches, start: Array
) -> list[_PathErrors]:
    """Linearize the errors of each peer's path at its detections."""
    flights = {id(flight): k for k, (flight, _) in enumerate(views)}
    seen = [number for number in range(len(views)) if (matched.view == number).any()]
    order = list(dict.fromkeys(flights[id(views[number][0])] for number in seen))
    return [
        _linearize_path(views[n], order.index(flights[id(views[n][0])]), n, camera, matched, start)
        for n in seen
    ]


def _linearize_path(
    view: PeerView, flight: int, number: int, camera: Camera, matched: Matches, start: Array
) -> _PathErrors:
    """Linearize the errors of one peer's path."""
    rows = np.flatnonzero(matched.view == number)
    time_s = matched.time_s[rows]
    at_s = time_s - start[3]
    _, jacobian = predict_pixels(view[0], with_mount(camera, start), view[1], time_s)
    jacobian = np.nan_to_num(jacobian[:, :2])
    axes, turn = _error_axes(view[1].interpolate_at(at_s), view[1].nearest_covariance(at_s))
    shown = jacobian[:, :, :3] @ axes
    knots = np.arange(time_s[0] - KNOT_SPACING_S, time_s[-1] + 2 * KNOT_SPACING_S, KNOT_SPACING_S)
    after = np.searchsorted(knots, time_s)
    share = (time_s - knots[after - 1]) / KNOT_SPACING_S
    here = np.arange(len(rows))
    hats = csr_array(
        (np.r_[1 - share, share], (np.r_[here, here], np.r_[after - 1, after])),
        shape=(len(rows), len(knots)),
    )
    # Rows u and v of each detection below each other, in the order of the residuals.
    fading = kron(hats, np.ones((2, 1)), format="csr").multiply(
        (shown[:, :, 1] * np.sqrt(DECAYING_SHARE)).reshape(-1, 1)
    )
    turned = shown[:, :, 1:2] * turn[:, None, None]
    lasting = np.concatenate([shown * np.sqrt(CONSTANT_SHARE), turned], axis=2).reshape(
        2 * len(rows), -1
    )
    return _PathErrors(
        flight,
        rows,
        csr_array(hstack([csr_array(lasting), fading])),
        jacobian[:, :, 3:].reshape(2 * len(rows), -1),
        csr_array(block_diag([eye_array(lasting.shape[1]), _markov_information(len(knots))])),
    )


def _error_axes(xyz_m: Array, spread: Array) -> tuple[Array, Array]:
    """Return the standard deviations along, across and above the line of sight, and of a rotation.

    (N, 3, 3) in metres; (N,) the effect of a unit rotation of the whole path, relative to that
    across.
    """
    level = np.maximum(np.linalg.norm(xyz_m[:, :2], axis=1), MIN_DISTANCE_M)
    x, y, none = xyz_m[:, 0] / level, xyz_m[:, 1] / level, np.zeros(len(xyz_m))
    axes = np.stack([x, -y, none, y, x, none, none, none, none + 1], axis=1).reshape(-1, 3, 3)
    std_m = np.sqrt(np.einsum("nia,nij,nja->na", axes, spread, axes) + 1e-12)
    turn_rad = np.sqrt(ROTATION_SHARE) * np.median(std_m[:, 1] / level)
    return axes * std_m[:, None, :], turn_rad * level / std_m[:, 1]


def _markov_information(count: int) -> csr_array:
    """Return the (count, count) information of a Gauss-Markov process of unit variance."""
    # x_k = keeps x_(k-1) + noise of variance 1 - keeps^2. A knot depends on its two neighbours
    # only, so the inverse of the covariance is tridiagonal; the ends have one neighbour.
    keeps = np.exp(-KNOT_SPACING_S / DECAY_S)
    middle = np.full(count, 1 + keeps**2)
    middle[[0, -1]] = 1.0
    beside = np.full(count - 1, -keeps)
    bands = diags_array([beside, middle, beside], offsets=[-1, 0, 1])
    return csr_array(bands / (1 - keeps**2))


def pixel_jacobian(
    views: Sequence[PeerView], camera: Camera, matched: Matches, values: Array
) -> Array:
    """Return (N, 2, 4) derivatives of the predicted pixel by roll, pitch, yaw and delay."""
    # A residual is detection minus prediction, so its derivative is the prediction's, negated.
    sides = [
        pixel_residuals(views, camera, matched, values - step)
        - pixel_residuals(views, camera, matched, values + step)
        for step in np.diag(DERIVATIVE_STEPS)
    ]
    return np.asarray(np.stack(sides, axis=2) / (2 * DERIVATIVE_STEPS))
