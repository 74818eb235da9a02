"""Robust losses: for residuals with outliers, and for errors that are constant over a flight.

Every residual r has Cauchy's loss L log(1 + r^2 / L) with a limit L of its own: a square where
r^2 is small against L, a logarithm beyond. It is the likelihood of Student's t, up to factors.
"""

from dataclasses import dataclass

import numpy as np

from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.camera_residuals import LIMIT
from dmrl.estimation.solver.keyframes import Noise
from dmrl.estimation.solver.residuals import RANGE_ERROR, SIZE, Linear

MOTION = 25.0
"""Limit of the motion's residuals: five sigmas are no noise."""

SQUARE = 1e9
PRIOR: Array = np.array([2.0, SQUARE, 4.0, 4.0, *[SQUARE] * 6, 4.0])
"""Limits of what is constant, as in ``GLOBALS``. Offsets of ranges, biases of yaw rates and clocks
are mostly small, and at times not. A scale that may be anything would shrink the path away."""


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
        Of the first range error, per square metre.
    free
        (K,) of every range error, likewise.
    prior
        (G,) of what is constant.
    seen
        (I,) of what was seen in each image; None: nothing.
    """

    step: Array
    range: Array
    first: float
    free: Array
    prior: Array
    seen: Array | None = None


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
    total += noise.jump**2 * np.log1p(_first(linear, noise))
    total += noise.free_weight * np.log1p((linear.error_m / noise.free_m) ** 2).sum()
    total += (PRIOR * np.log1p((constants / noise.prior_std()) ** 2 / PRIOR)).sum()
    if linear.seen is not None:
        total += (linear.seen.share * LIMIT * np.log1p(linear.seen.squared / LIMIT)).sum()
    return float(total) / 2


def weights_of(linear: Linear, noise: Noise, constants: Array) -> Weights:
    """Weights with which squares have the losses' slopes."""
    step, ranges = limits(noise)
    looked = linear.seen
    return Weights(
        1 / (1 + linear.step**2 / step),
        1 / (1 + linear.range**2 / ranges),
        1 / (1 + _first(linear, noise)) / noise.range_error_std_m**2,
        noise.free_weight / (noise.free_m**2 + linear.error_m**2),
        1 / (1 + (constants / noise.prior_std()) ** 2 / PRIOR),
        None if looked is None else looked.share / (1 + looked.squared / LIMIT),
    )


def curvature_of(noise: Noise, constants: Array) -> Array:
    """(G,) information that the prior of what is constant holds of it, where that is.

    The weight says where the slope is that of a square. The loss itself is bent less: what is as
    far out as the prior is wide, the prior hardly holds.
    """
    return curved((constants / noise.prior_std()) ** 2 / PRIOR) * noise.prior_std() ** -2


def curved(out: Array) -> Array:
    """By how much the loss is bent where r^2 / L is that, against a square."""
    # Half of the second derivative of L log(1 + r^2 / L) is (1 - r^2 / L) / (1 + r^2 / L)^2.
    return np.asarray(np.maximum(1 - out, 0.0) / (1 + out) ** 2)


def _first(linear: Linear, noise: Noise) -> float:
    """The first range error's square against what may jump."""
    return float(linear.error_m[0] / (noise.jump * noise.range_error_std_m)) ** 2
