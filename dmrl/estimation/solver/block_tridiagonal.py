"""Bordered block-tridiagonal normal equations: assembly, solution, marginals and elimination."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dtbtrs

from dmrl.estimation.model.pair import Array


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Normal equations of a flight: J^T W J and J^T W e.

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

    @classmethod
    def zeros(cls, keyframes: int, width: int, constants: int) -> "NormalEquations":
        """Return empty equations. Their keyframes are last in memory, as `add_rows` adds them."""
        return cls(
            np.zeros((width, width, keyframes)).transpose(2, 0, 1),
            np.zeros((width, width, keyframes - 1)).transpose(2, 0, 1),
            np.zeros((width, constants, keyframes)).transpose(2, 0, 1),
            np.zeros((constants, constants)),
            np.zeros((width, keyframes)).T,
            np.zeros(constants),
        )

    def add_rows(self, rows: Array, columns: list[int], border: list[int], steps: bool) -> None:
        """Add the products of weighted Jacobian rows, in place; `mirror` completes the diagonal.

        Parameters
        ----------
        rows
            (B, m, w) m rows of each keyframe or step: columns of the keyframe, of the next one if
            these are steps, of the constants, and the residual.
        columns, border
            Columns of a keyframe, and of the constants.
        steps
            Whether the rows depend on the next keyframe too.
        """
        size, edge = len(columns), np.array(border, int)
        corner = size * (1 + steps)
        # An operation on all keyframes is several times faster than one on each small block.
        by_column = np.ascontiguousarray(rows.T)
        parts = (slice(-1), slice(1, None)) if steps else (slice(None),)
        for first in range(corner):
            part, at = parts[first // size], columns[first % size]
            products = np.einsum("mk,wmk->wk", by_column[first], by_column[first:])
            for second, product in enumerate(products[: corner - first], first):
                other = columns[second % size]
                if first // size != second // size:
                    self.off_diagonal[:, at, other] += product
                    continue
                self.diagonal[part, min(at, other), max(at, other)] += product
            for constant, product in zip(border, products[corner - first : -1], strict=True):
                self.coupling[part, at, constant] += product
            self.gradient[part, at] += products[-1]
        flat = by_column[corner:].reshape(len(border) + 1, -1)
        rest = flat @ flat.T
        self.globals_block[np.ix_(edge, edge)] += rest[:-1, :-1]
        self.globals_gradient[edge] += rest[:-1, -1]

    def mirror(self) -> None:
        """Copy the upper triangle of every diagonal block to the lower one, in place."""
        for row in range(1, self.diagonal.shape[1]):
            self.diagonal[:, row, :row] = self.diagonal[:, :row, row]

    def select(self, states: Sequence[int], constants: Sequence[int]) -> "NormalEquations":
        """Return the equations of some columns of the keyframes and of the constants."""
        at, edge = np.array(states, int), np.array(constants, int)

        def take(blocks: Array, columns: NDArray[np.intp]) -> Array:
            # The keyframes are last in memory.
            found: Array = blocks.transpose(1, 2, 0)[np.ix_(at, columns)]
            return found.transpose(2, 0, 1)

        return NormalEquations(
            take(self.diagonal, at),
            take(self.off_diagonal, at),
            take(self.coupling, edge),
            self.globals_block[np.ix_(edge, edge)],
            self.gradient[:, at],
            self.globals_gradient[edge],
        )

    def damped(self, damping: float) -> "NormalEquations":
        """Return the equations with Marquardt damping of the keyframes, not of the constants."""
        eye = np.eye(self.diagonal.shape[1])
        return replace(self, diagonal=self.diagonal * (1 + damping * eye)) if damping else self


def to_upper_bands(diagonal: Array, above: Array) -> Array:
    """Return (2n, K n) upper bands of a matrix of (K, n, n) blocks, in the layout of SciPy."""
    size = diagonal.shape[1]
    out = np.zeros((len(diagonal), size, 2 * size))
    for column in range(size):
        first = size - 1 - column
        out[1:, column, first : first + size] = above[:, :, column]
        out[:, column, first + size :] = diagonal[:, : column + 1, column]
    # In the order of LAPACK, which then copies nothing.
    return out.reshape(-1, 2 * size).T


@dataclass(frozen=True, slots=True)
class Solved:
    """Solution of the normal equations.

    Parameters
    ----------
    state, constants
        (K, n) and (G,) Gauss-Newton steps.
    covariance
        (G, G) of the constants.
    log_det
        Log determinant of the whole matrix.
    eliminated
        Equations of the constants, without the keyframes.
    """

    state: Array
    constants: Array
    covariance: Array
    log_det: float
    eliminated: "Eliminated"

    def response(self) -> Array:
        """Return the (K, n, G) negated derivative of the keyframes by the constants."""
        return self.eliminated.substitute(self.eliminated.half[:, 1:]).reshape(
            *self.state.shape, len(self.constants)
        )


@dataclass(frozen=True, slots=True)
class Eliminated:
    """Equations of the constants, after the keyframes were eliminated.

    Parameters
    ----------
    factor
        Upper bands of the Cholesky factor U of the keyframes' matrix U^T U.
    half
        (K n, 1 + G) U^-T by the gradient and by the coupling.
    information, gradient
        (G, G) and (G,) Schur complement.
    """

    factor: Array
    half: Array
    information: Array
    gradient: Array

    def substitute(self, half: Array) -> Array:
        """Return U^-1 by (K n, m) columns."""
        solved, _ = dtbtrs(self.factor, half)
        return np.asarray(solved)

    def step_evidence(self, constants: Sequence[int]) -> float:
        """Return the gain of the step with some constants, less half of the log determinant."""
        at = np.array(constants, int)
        block, slope = self.information[np.ix_(at, at)], self.gradient[at]
        gain = (self.half[:, 0] ** 2).sum() + slope @ np.linalg.solve(block, slope)
        return float(gain - self.log_det() - np.linalg.slogdet(block)[1]) / 2

    def log_det(self) -> float:
        """Return the log determinant of the keyframes' matrix."""
        return float(2 * np.log(self.factor[-1]).sum())

    def whole_log_det(self) -> float:
        """Return the log determinant of the whole matrix."""
        return self.log_det() + float(np.linalg.slogdet(self.information)[1])


def solve_step(equations: NormalEquations) -> Solved:
    """Solve for the Gauss-Newton step and the terms of the covariance.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite.
    """
    left = eliminate_states(equations)
    covariance: Array = np.asarray(np.linalg.inv(left.information), float)
    constants = -covariance @ left.gradient
    state = -left.substitute(left.half @ np.concatenate([[1.0], constants])[:, None])
    state = state.reshape(equations.gradient.shape)
    return Solved(state, constants, covariance, left.whole_log_det(), left)


def eliminate_states(equations: NormalEquations) -> Eliminated:
    """Eliminate all keyframes from the equations.

    Only half of the substitution is needed for the Schur complement.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the keyframes' matrix is not positive definite.
    """
    size = len(equations.globals_block)
    factor = cholesky_banded(
        to_upper_bands(equations.diagonal, equations.off_diagonal),
        overwrite_ab=True,
        check_finite=False,
    )
    right = np.empty((size + 1, *equations.gradient.shape))
    right[0], right[1:] = equations.gradient, equations.coupling.transpose(2, 0, 1)
    half, _ = dtbtrs(factor, right.reshape(size + 1, -1).T, trans="T", overwrite_b=True)
    products = half[:, 1:].T @ half
    return Eliminated(
        factor,
        half,
        equations.globals_block - products[:, 1:],
        equations.globals_gradient - products[:, 0],
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
        left[k + 1] -= under[k] @ np.linalg.solve(left[k], right[k])
    return np.asarray(np.linalg.inv(left[:, 0] + left[::-1, 1] - diagonal))


def eliminate_before(equations: NormalEquations, keyframe: int) -> tuple[Array, Array]:
    """Eliminate the keyframes before one; return the information that they leave.

    Parameters
    ----------
    equations
        Normal equations of the keyframes before it and their steps alone: they are not in the
        information of the keyframe itself.
    keyframe
        Number of keyframes to eliminate.

    Returns
    -------
    information, vector : Array
        (n + G, n + G) and (n + G,) of the keyframe's states and the constants.
    """
    width, size = equations.diagonal.shape[1], len(equations.globals_block)
    factor = cholesky_banded(
        to_upper_bands(equations.diagonal[:keyframe], equations.off_diagonal[: keyframe - 1])
    )
    edge = np.zeros((keyframe, width, width + size))
    edge[-1, :, :width] = equations.off_diagonal[keyframe - 1]
    edge[..., width:] = equations.coupling[:keyframe]
    edge = edge.reshape(-1, width + size)
    solved = cho_solve_banded((factor, False), edge)
    information = np.zeros((width + size, width + size))
    information[:width, :width] = equations.diagonal[keyframe]
    information[:width, width:] = equations.coupling[keyframe]
    information[width:, :width] = equations.coupling[keyframe].T
    information[width:, width:] = equations.globals_block
    vector = np.concatenate([equations.gradient[keyframe], equations.globals_gradient])
    return (
        information - edge.T @ solved,
        vector - solved.T @ equations.gradient[:keyframe].ravel(),
    )
