"""Block-tridiagonal normal equations with a border of globals: solve, and invert in part."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded

from dmrl.estimation.linear import Linear
from dmrl.estimation.pair import Array


@dataclass(frozen=True, slots=True)
class Normal:
    """J^T J of a flight, and J^T e.

    Parameters
    ----------
    diagonal
        (K, n, n) blocks of the keyframes.
    above
        (K - 1, n, n) blocks between a keyframe and the next.
    border
        (K, n, G) blocks between keyframes and globals.
    corner
        (G, G).
    gradient, corner_gradient
        (K, n), (G,).
    """

    diagonal: Array
    above: Array
    border: Array
    corner: Array
    gradient: Array
    corner_gradient: Array


def normal(
    linear: Linear, range_key: NDArray[np.intp], range_weight: Array, prior: Array
) -> Normal:
    """Normal equations without the globals' prior.

    Parameters
    ----------
    linear
        Residuals and Jacobians.
    range_key
        (R,) keyframe of each range.
    range_weight
        (R,) weight of each squared range residual.
    prior
        (n,) information on every keyframe; tiny, so that there is always a solution.
    """
    start, end, across = linear.step_by_start, linear.step_by_end, linear.step_by_globals
    keyframes, size = len(start) + 1, across.shape[2]
    width = start.shape[1]
    diagonal = np.zeros((keyframes, width, width)) + np.diag(prior)
    border, gradient = np.zeros((keyframes, width, size)), np.zeros((keyframes, width))
    start_t, end_t = start.swapaxes(1, 2), end.swapaxes(1, 2)
    step = linear.step[..., None]
    diagonal[:-1] += start_t @ start
    diagonal[1:] += end_t @ end
    border[:-1] += start_t @ across
    border[1:] += end_t @ across
    gradient[:-1] += (start_t @ step)[..., 0]
    gradient[1:] += (end_t @ step)[..., 0]

    weighted = linear.range_by_state * range_weight[:, None]
    _add(diagonal, range_key, weighted[:, :, None] * linear.range_by_state[:, None, :])
    _add(border, range_key, weighted[:, :, None] * linear.range_by_globals[:, None, :])
    _add(gradient, range_key, weighted * linear.range[:, None])
    weighted_globals = linear.range_by_globals * range_weight[:, None]
    flat = across.reshape(-1, size)
    corner = flat.T @ flat + weighted_globals.T @ linear.range_by_globals
    corner_gradient = flat.T @ linear.step.reshape(-1) + weighted_globals.T @ linear.range
    return Normal(diagonal, start_t @ end, border, corner, gradient, corner_gradient)


def _add(total: Array, key: NDArray[np.intp], parts: Array) -> None:
    """Sum parts by key, which never goes back, into the total."""
    if not len(key):
        return
    first = np.flatnonzero(np.diff(key, prepend=-1))
    total[key[first]] += np.add.reduceat(parts, first, axis=0)


def bands(diagonal: Array, above: Array) -> Array:
    """(2n, K n) upper bands of a matrix of (K, n, n) blocks, as SciPy wants them."""
    size = diagonal.shape[1]
    width = 2 * size - 1
    out = np.zeros((width + 1, len(diagonal), size))
    for row in range(size):
        for column in range(row, size):
            out[width + row - column, :, column] = diagonal[:, row, column]
        for column in range(size):
            out[width + row - column - size, 1:, column] = above[:, row, column]
    return out.reshape(width + 1, -1)


def log_determinant(equations: Normal) -> float:
    """Logarithm of the determinant of the whole matrix, border and corner included.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the equations are not positive definite.
    """
    size = len(equations.corner)
    factor = cholesky_banded(bands(equations.diagonal, equations.above))
    border = equations.border.reshape(-1, size)
    solved = cho_solve_banded((factor, False), border)
    rest = np.linalg.slogdet(equations.corner - border.T @ solved)[1]
    return float(2 * np.log(factor[-1]).sum() + rest)


def solve(equations: Normal) -> tuple[Array, Array, Array, Array]:
    """The Gauss-Newton step, and what the covariance needs.

    Returns
    -------
    state : Array
        (K, n) change of the keyframes.
    constants : Array
        (G,) change of the globals.
    response : Array
        (K, n, G) change of the keyframes per change of the globals, negated.
    covariance : Array
        (G, G) of the globals.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the equations are not positive definite.
    """
    size, width = len(equations.corner), equations.diagonal.shape[1]
    factor = cholesky_banded(bands(equations.diagonal, equations.above))
    right = np.concatenate([equations.gradient[..., None], equations.border], axis=2)
    solved = cho_solve_banded((factor, False), right.reshape(-1, size + 1))
    border = equations.border.reshape(-1, size)
    covariance = np.linalg.inv(equations.corner - border.T @ solved[:, 1:])
    constants = -covariance @ (equations.corner_gradient - border.T @ solved[:, 0])
    state = -solved[:, 0] - solved[:, 1:] @ constants
    return (
        state.reshape(-1, width),
        constants,
        solved[:, 1:].reshape(-1, width, size),
        covariance,
    )


def block_inverse(diagonal: Array, above: Array) -> Array:
    """(K, ..., n, n) diagonal blocks of the inverse of a block-tridiagonal matrix.

    By elimination from both ends, for many matrices at once.

    Parameters
    ----------
    diagonal
        (K, ..., n, n).
    above
        (K - 1, ..., n, n).
    """
    forward, backward = diagonal.copy(), diagonal.copy()
    below = above.swapaxes(-1, -2)
    for k in range(len(above)):
        forward[k + 1] -= below[k] @ np.linalg.inv(forward[k]) @ above[k]
    for k in range(len(above) - 1, -1, -1):
        backward[k] -= above[k] @ np.linalg.inv(backward[k + 1]) @ below[k]
    return np.asarray(np.linalg.inv(forward + backward - diagonal))
