"""Prior factors: of constants, of chains that evolve, and carried from the window before."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.block_tridiagonal import NormalEquations
from dmrl.estimation.solver.layout import Layout
from dmrl.estimation.solver.robust_loss import Loss
from dmrl.estimation.solver.unknowns import Unknown

WEAK_INFORMATION = 1e-3
"""Information added to every state, in inverse squares of its unit. It is practically none and
keeps the equations positive definite."""


ANCHOR_INFORMATION = 1e6
"""Information on the first robot's first pose, which defines the frame of the flight."""


@dataclass(frozen=True)
class Chain:
    """Evolution of one state over the flight, and the pull of each value to zero.

    Parameters
    ----------
    row, column
        The unknown, and its column.
    value
        (K,) values.
    kept, std
        (S,) share of a value that a step keeps, and standard deviation of the step.
    start_std
        Standard deviation of the first value.
    """

    row: Unknown
    column: int
    value: Array
    kept: Array
    std: Array
    start_std: float

    @cached_property
    def residual(self) -> Array:
        """(K,) whitened first value and steps."""
        steps = (self.value[1:] - self.kept * self.value[:-1]) / self.std
        return np.concatenate([self.value[:1] / self.start_std, steps])

    @property
    def log_std(self) -> float:
        """Sum of the logarithms of the standard deviations."""
        known = np.isfinite(self.start_std)  # else the window before knows the first value
        return float(np.log(self.std).sum()) + (float(np.log(self.start_std)) if known else 0.0)

    def cost(self) -> float:
        """Return half the sum of the losses."""
        return float(self.row.loss.cost(self.residual**2).sum()) / 2 + self.pull()

    def pull(self) -> float:
        """Return the cost of the pull to zero."""
        if not self.row.pull_weight:
            return 0.0
        square = (self.value / self.row.pull_std) ** 2
        return self.row.pull_weight * float(np.log1p(square).sum()) / 2

    def add_to(self, equations: NormalEquations) -> None:
        """Add the weighted rows to the normal equations."""
        at, residual = self.column, self.residual
        weight = self.row.loss.weight(residual**2)
        weight_start, weight = weight[0] / self.start_std**2, weight[1:] / self.std**2
        diagonal, gradient = equations.diagonal[:, at, at], equations.gradient[:, at]
        if self.row.pull_weight:
            pull = self.row.pull_weight / (self.row.pull_std**2 + self.value**2)
            diagonal += pull
            gradient += pull * self.value
        diagonal[0] += weight_start
        gradient[0] += weight_start * self.value[0]
        diagonal[1:] += weight
        diagonal[:-1] += weight * self.kept**2
        equations.off_diagonal[:, at, at] -= weight * self.kept
        step = weight * self.std * residual[1:]
        gradient[1:] += step
        gradient[:-1] -= self.kept * step


@dataclass(frozen=True, slots=True)
class ConstantPrior:
    """Priors of the constants: (G,) values, standard deviations and losses."""

    value: Array
    std: Array
    losses: tuple[Loss, ...]

    def _each(self, method: str) -> Array:
        square = (self.value / self.std) ** 2
        return np.array(
            [getattr(one, method)(s) for one, s in zip(self.losses, square, strict=True)], float
        )

    def cost(self) -> float:
        """Return half the sum of the losses."""
        return float(self._each("cost").sum()) / 2

    def add_to(self, equations: NormalEquations) -> None:
        """Add the weighted priors to the normal equations."""
        information = self.information()
        equations.globals_block[...] += np.diag(information)
        equations.globals_gradient[...] += information * self.value

    def information(self) -> Array:
        """Return (G,) information from the IRLS weights."""
        return np.asarray(self._each("weight") / self.std**2)

    def curvature(self) -> Array:
        """Return (G,) information from the curvature of the losses.

        The IRLS weight matches the slope of a loss. The curvature is smaller: the prior hardly
        constrains a constant that is as far out as the prior is wide.
        """
        return np.asarray(self._each("curvature") / self.std**2)


@dataclass(frozen=True, slots=True)
class Carried:
    """Information about the first keyframe and the constants from before the flight begins.

    Parameters
    ----------
    layout
        Columns of the unknowns.
    mean, information, vector
        As in `CarriedPrior`.
    """

    layout: Layout
    mean: Array
    information: Array
    vector: Array

    def convert(self, layout: Layout) -> "Carried":
        """Return the information about the unknowns of another layout.

        Nothing is known of those that only it has. Those that it lacks are eliminated, so that
        error models with other unknowns are compared under the same information.
        """
        if layout == self.layout:
            return self
        mine, wanted = self.layout.subjects(), layout.subjects()
        kept = [mine[subject] for subject in wanted if subject in mine]
        gone = [at for subject, at in mine.items() if subject not in wanted]
        between = self.information[np.ix_(kept, gone)]
        share = between @ np.linalg.pinv(self.information[np.ix_(gone, gone)], hermitian=True)
        at = [column for subject, column in wanted.items() if subject in mine]
        mean, vector = np.zeros(len(wanted)), np.zeros(len(wanted))
        information = np.zeros((len(wanted), len(wanted)))
        mean[at], vector[at] = self.mean[kept], self.vector[kept] - share @ self.vector[gone]
        information[np.ix_(at, at)] = self.information[np.ix_(kept, kept)] - share @ between.T
        return Carried(layout, mean, information, vector)

    def to_factor(self, value: Array, loss: Loss) -> "CarriedPrior":
        """Return the factor at (n + G,) values. A heading may differ by whole turns."""
        heading, full_turn = np.arange(2, 3 * self.layout.robots, 3), 2 * np.pi
        value = value.copy()
        apart = value[heading] - self.mean[heading]
        value[heading] -= full_turn * np.round(apart / full_turn)
        return CarriedPrior(self.mean, self.information, self.vector, value, loss)


@dataclass(frozen=True, slots=True)
class CarriedPrior:
    """Information of the flight before the first keyframe, about its states and the constants.

    Parameters
    ----------
    mean
        (n + G,) values at which the information was linearized.
    information, vector
        (n + G, n + G) and (n + G,) its normal equations there.
    value
        (n + G,) present values.
    loss
        Loss of the squared Mahalanobis distance from the carried optimum.
    """

    mean: Array
    information: Array
    vector: Array
    value: Array
    loss: Loss

    def _squares(self) -> tuple[Array, float]:
        off = self.value - self.mean
        slope = self.information @ off + self.vector
        best = np.linalg.lstsq(self.information, -self.vector, rcond=None)[0]
        apart = off - best
        return slope, max(float(apart @ self.information @ apart), 0.0)

    def cost(self) -> float:
        """Return half the loss."""
        return float(self.loss.cost(np.array(self._squares()[1]))) / 2

    def add_to(self, equations: NormalEquations) -> None:
        """Add the information to the normal equations."""
        slope, square = self._squares()
        weight, width = float(self.loss.weight(np.array(square))), equations.diagonal.shape[1]
        equations.diagonal[0] += weight * self.information[:width, :width]
        equations.coupling[0] += weight * self.information[:width, width:]
        equations.globals_block[...] += weight * self.information[width:, width:]
        equations.gradient[0] += weight * slope[:width]
        equations.globals_gradient[...] += weight * slope[width:]
