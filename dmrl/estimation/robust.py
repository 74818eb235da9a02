"""Robust losses: for residuals with outliers, and for errors that are constant over a flight.

Every residual r has Cauchy's loss L log(1 + r^2 / L) with a limit L of its own: a square where
r^2 is small against L, a logarithm beyond. It is the likelihood of Student's t, up to factors.
"""

from dataclasses import dataclass

import numpy as np

from dmrl.estimation.linear import RANGE_ERROR, SIZE, Linear
from dmrl.estimation.pair import Array
from dmrl.estimation.problem import Noise

MOTION = 25.0
"""Limit of the motion's residuals: five sigmas are no noise."""

SQUARE = 1e9
PRIOR: Array = np.array([SQUARE, SQUARE, 4.0, 4.0, *[SQUARE] * 6, 4.0])
"""Limits of what is constant, as in ``GLOBALS``. Biases of yaw rates and clocks are mostly small,
and at times not at all. A scale that may be anything would shrink the path away."""


@dataclass(frozen=True, slots=True)
class Weights:
    """By how much each squared residual counts.

    Parameters
    ----------
    step
        (K - 1, 6) of the steps.
    range
        (R,) of the ranges.
    first
        Of the first range error.
    prior
        (G,) of what is constant.
    """

    step: Array
    range: Array
    first: float
    prior: Array


def limits(noise: Noise) -> tuple[Array, float]:
    """Limits of a step's residuals (6,), and of a range's."""
    step = np.full(SIZE, MOTION)
    step[RANGE_ERROR] = noise.jump**2
    return step, (noise.cauchy_m / noise.range_std_m) ** 2


def cost_of(linear: Linear, noise: Noise, constants: Array) -> float:
    """Half the sum of the losses."""
    step, ranges = limits(noise)
    total = (step * np.log1p(linear.step**2 / step)).sum()
    total += ranges * np.log1p(linear.range**2 / ranges).sum()
    total += noise.jump**2 * np.log1p((linear.first / noise.jump) ** 2)
    total += (PRIOR * np.log1p((constants / noise.prior_std()) ** 2 / PRIOR)).sum()
    return float(total) / 2


def weights_of(linear: Linear, noise: Noise, constants: Array) -> Weights:
    """Weights with which squares have the losses' slopes."""
    step, ranges = limits(noise)
    return Weights(
        1 / (1 + linear.step**2 / step),
        1 / (1 + linear.range**2 / ranges),
        float(1 / (1 + (linear.first / noise.jump) ** 2)),
        1 / (1 + (constants / noise.prior_std()) ** 2 / PRIOR),
    )
