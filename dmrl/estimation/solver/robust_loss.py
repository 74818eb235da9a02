"""Robust losses as objects. A residual's loss is a function of its whitened square.

Each loss equals the square for small residuals. The solver needs the loss, its slope (the IRLS
weight) and its curvature, so a new loss is one class with three methods.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dmrl.estimation.model.pair import Array


class Loss(Protocol):
    """Loss of whitened squared residuals, any shape."""

    def cost(self, square: Array) -> Array:
        """Return the losses; equal to the squares where those are small."""

    def weight(self, square: Array) -> Array:
        """Return the derivatives of the losses by the squares: the IRLS weights."""

    def curvature(self, square: Array) -> Array:
        """Return half the second derivatives by the residuals, at least 0."""


@dataclass(frozen=True, slots=True)
class Gaussian:
    """The square itself."""

    def cost(self, square: Array) -> Array:
        """Return the squares."""
        return square

    def weight(self, square: Array) -> Array:
        """Return ones."""
        return np.ones_like(square)

    def curvature(self, square: Array) -> Array:
        """Return ones."""
        return np.ones_like(square)


@dataclass(frozen=True, slots=True)
class Cauchy:
    """s^2 log(1 + r^2 / s^2), the loss that equals that of Student's t with nu = s^2 - 1.

    The likelihood is exp(-cost / 2) = (1 + r^2 / s^2)^(-s^2 / 2): Student's t with nu = s^2 - 1
    degrees of freedom, scaled by s / sqrt(nu). For s = 1.25, nu is 0.56. For s of 1 or less it
    cannot be normalized: it is a weight, not a probability.

    Parameters
    ----------
    sigmas
        Residual s with half its weight, in standard deviations.
    """

    sigmas: float

    def cost(self, square: Array) -> Array:
        """Return the losses."""
        return np.asarray(self.sigmas**2 * np.log1p(square / self.sigmas**2))

    def weight(self, square: Array) -> Array:
        """Return the IRLS weights."""
        return np.asarray(1 / (1 + square / self.sigmas**2))

    def curvature(self, square: Array) -> Array:
        """Return half the second derivatives, at least 0."""
        out = square / self.sigmas**2
        return np.asarray(np.maximum(1 - out, 0.0) / (1 + out) ** 2)
