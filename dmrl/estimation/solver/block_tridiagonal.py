"""Bordered block-tridiagonal normal equations: assembly, solution and marginal covariances."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded

from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.camera_residuals import CameraMeasurements, CameraResiduals
from dmrl.estimation.solver.residuals import RANGE_STATES, Linearization
from dmrl.estimation.solver.robust_loss import IrlsWeights


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Normal equations of a flight: J^T J and J^T e.

    Parameters
    ----------
    diagonal
        (K, n, n) blocks of the keyframes.
    off_diagonal
        (K - 1, n, n) blocks between each keyframe and the next.
    coupling
        (K, n, G) blocks between keyframes and constants.
    globals_block
        (G, G) block of the constants.
    gradient, globals_gradient
        (K, n) and (G,) right-hand sides.
    """

    diagonal: Array
    off_diagonal: Array
    coupling: Array
    globals_block: Array
    gradient: Array
    globals_gradient: Array


def assemble(
    linear: Linearization, range_key: NDArray[np.intp], weights: IrlsWeights, prior: Array
) -> NormalEquations:
    """Assemble the normal equations without the prior of the constants.

    Parameters
    ----------
    linear
        Residuals and Jacobians.
    range_key
        (R,) keyframe of each range.
    weights
        Weights of the squared residuals.
    prior
        (n,) information added to every keyframe. A tiny value keeps the system positive definite.
    """
    steps, ranges, width = linear.steps, linear.ranges, len(prior)
    size = steps.shape[2] - 2 * width - 1
    diagonal = np.zeros((len(steps) + 1, width, width)) + np.diag(prior)
    border, gradient = np.zeros((*diagonal.shape[:2], size)), np.zeros(diagonal.shape[:2])
    rooted = steps * np.sqrt(weights.step)[..., None]
    products = rooted[..., : 2 * width].swapaxes(1, 2) @ rooted
    for keyframes, rows in ((slice(-1), slice(width)), (slice(1, None), slice(width, 2 * width))):
        diagonal[keyframes] += products[:, rows, rows]
        border[keyframes] += products[:, rows, 2 * width : -1]
        gradient[keyframes] += products[:, rows, -1]

    weighted = ranges * weights.range[:, None]
    keys, sums = _sum_by_keyframe(range_key, weighted[:, :4, None] * ranges[:, None, :])
    states = np.array(RANGE_STATES)
    diagonal[np.ix_(keys, states, states)] += sums[..., :4]
    border[np.ix_(keys, states, np.arange(2))] += sums[..., 4:6]
    gradient[np.ix_(keys, states)] += sums[..., 6]
    flat = rooted.reshape(-1, steps.shape[2])[:, 2 * width :]
    rest = flat.T @ flat
    shared = [0, 1, -1]  # bias and scale of the ranges, and the residual
    rest[np.ix_(shared, shared)] += weighted[:, 4:].T @ ranges[:, 4:]
    above = products[:, :width, width : 2 * width]
    return NormalEquations(diagonal, above, border, rest[:-1, :-1], gradient, rest[:-1, -1])


def add_camera(
    equations: NormalEquations,
    camera: CameraMeasurements,
    residuals: CameraResiduals,
    weight: Array,
) -> None:
    """Add the camera residuals to normal equations, in place.

    Parameters
    ----------
    equations
        Normal equations of a flight's ranges and motions.
    camera
        Measurements of I images, each between two keyframes.
    residuals
        Rows of the images.
    weight
        (I,) weights of their squares.
    """
    products = residuals.rows[..., :3].swapaxes(1, 2) @ (residuals.rows * weight[:, None, None])
    after = camera.fraction[:, None, None]
    for key, part in ((camera.keyframe, 1 - after), (camera.keyframe + 1, after)):
        np.add.at(equations.diagonal[:, :3, :3], key, part**2 * products[..., :3])
        np.add.at(equations.gradient[:, :3], key, part[..., 0] * products[..., 3])
    np.add.at(
        equations.off_diagonal[:, :3, :3], camera.keyframe, (1 - after) * after * products[..., :3]
    )


def _sum_by_keyframe(key: NDArray[np.intp], parts: Array) -> tuple[NDArray[np.intp], Array]:
    """Return the distinct keyframes and the sum of the parts of each. Keyframes must be sorted."""
    first = np.flatnonzero(np.diff(key, prepend=-1))
    return key[first], np.add.reduceat(parts, first, axis=0) if len(key) else parts


def to_upper_bands(diagonal: Array, above: Array) -> Array:
    """Return (2n, K n) upper bands of a matrix of (K, n, n) blocks, in the layout of SciPy."""
    size = diagonal.shape[1]
    width = 2 * size - 1
    out = np.zeros((width + 1, len(diagonal), size))
    for row in range(size):
        for column in range(row, size):
            out[width + row - column, :, column] = diagonal[:, row, column]
        for column in range(size):
            out[width + row - column - size, 1:, column] = above[:, row, column]
    return out.reshape(width + 1, -1)


def log_det(equations: NormalEquations) -> float:
    """Return the log determinant of the whole matrix, coupling and constants included.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite.
    """
    size = len(equations.globals_block)
    factor = cholesky_banded(to_upper_bands(equations.diagonal, equations.off_diagonal))
    border = equations.coupling.reshape(-1, size)
    solved = cho_solve_banded((factor, False), border)
    rest = np.linalg.slogdet(equations.globals_block - border.T @ solved)[1]
    return float(2 * np.log(factor[-1]).sum() + rest)


def solve_step(equations: NormalEquations) -> tuple[Array, Array, Array, Array]:
    """Solve for the Gauss-Newton step and the terms of the covariance.

    Returns
    -------
    state : Array
        (K, n) change of the keyframes.
    constants : Array
        (G,) change of the constants.
    response : Array
        (K, n, G) negated derivative of the keyframes by the constants.
    covariance : Array
        (G, G) of the constants.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite.
    """
    size, width = len(equations.globals_block), equations.diagonal.shape[1]
    factor = cholesky_banded(to_upper_bands(equations.diagonal, equations.off_diagonal))
    right = np.concatenate([equations.gradient[..., None], equations.coupling], axis=2)
    solved = cho_solve_banded((factor, False), right.reshape(-1, size + 1))
    border = equations.coupling.reshape(-1, size)
    covariance = np.linalg.inv(equations.globals_block - border.T @ solved[:, 1:])
    constants = -covariance @ (equations.globals_gradient - border.T @ solved[:, 0])
    state = -solved[:, 0] - solved[:, 1:] @ constants
    return (
        state.reshape(-1, width),
        constants,
        solved[:, 1:].reshape(-1, width, size),
        covariance,
    )


def marginal_covariances(diagonal: Array, above: Array) -> Array:
    """Return (K, ..., n, n) diagonal blocks of the inverse of a block-tridiagonal matrix.

    The matrix is eliminated from both ends, for many matrices at once.

    Parameters
    ----------
    diagonal
        (K, ..., n, n).
    above
        (K - 1, ..., n, n).
    """
    # The backward elimination is a forward elimination of the reversed matrix.
    left = np.stack([diagonal, diagonal[::-1]], axis=1)
    right = np.stack([above, above[::-1].swapaxes(-1, -2)], axis=1)
    under = right.swapaxes(-1, -2)
    for k in range(len(above)):
        left[k + 1] -= under[k] @ np.linalg.inv(left[k]) @ right[k]
    return np.asarray(np.linalg.inv(left[:, 0] + left[::-1, 1] - diagonal))
