"""Robust losses for residuals with outliers and for the constants of a flight.

Every residual r has the Cauchy loss L log(1 + r^2 / L) with its own scale L: quadratic where r^2 is
small against L, logarithmic beyond. It is the log likelihood of Student's t, up to factors.
"""

from dataclasses import dataclass

import numpy as np

from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.camera_residuals import LIMIT
from dmrl.estimation.solver.keyframes import Noise
from dmrl.estimation.solver.residuals import RANGE_ERROR, SIZE, Linear

MOTION = 25.0
"""Loss scale of the motion residuals. Five standard deviations are no noise."""

SQUARE = 1e9
"""Loss scale of a quadratic loss: practically infinite."""
PRIOR: Array = np.array([2.0, SQUARE, 4.0, 4.0, *[SQUARE] * 6, 4.0])
"""Loss scales of the constants, in the order of ``GLOBALS``.

Offsets of ranges, biases of yaw rates and clock offsets are mostly small and sometimes large. The
scales keep a quadratic loss: a scale without a firm prior would shrink the path to nothing. No
record of how the values were chosen."""


@dataclass(frozen=True, slots=True)
class Weights:
    """IRLS weights of the squared residuals.

    Parameters
    ----------
    step
        (K - 1, 6) of the steps.
    range
        (R,) of the ranges.
    first
        Of the first range error, per square metre.
    free
        (K,) of the pull of every range error to zero, per square metre.
    prior
        (G,) of the constants.
    camera
        (I,) of the images. None: no images.
    """

    step: Array
    range: Array
    first: float
    free: Array
    prior: Array
    seen: Array | None = None


def limits(noise: Noise) -> tuple[Array, float]:
    """Return the loss scales of a step's residuals (6,) and of a range's."""
    step = np.full(SIZE, MOTION)
    step[RANGE_ERROR] = noise.jump**2
    return step, (noise.cauchy_m / noise.range_std_m) ** 2


def cost_of(linear: Linear, noise: Noise, constants: Array) -> float:
    """Return half the sum of the losses."""
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
    """Return the IRLS weight of every residual: weighted squares have the slope of the losses."""
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
    """Return (G,) information of the prior about the constants, from the curvature of its loss.

    The IRLS weight matches the slope of the loss. The curvature is smaller: the prior hardly
    constrains a constant that is as far out as the prior is wide.
    """
    return curved((constants / noise.prior_std()) ** 2 / PRIOR) * noise.prior_std() ** -2


def curved(out: Array) -> Array:
    """Return the curvature of the loss at r^2 / L, relative to a square."""
    # Half of the second derivative of L log(1 + r^2 / L) is (1 - r^2 / L) / (1 + r^2 / L)^2.
    return np.asarray(np.maximum(1 - out, 0.0) / (1 + out) ** 2)


def _first(linear: Linear, noise: Noise) -> float:
    """Return the square of the first range error, relative to the scale of a step."""
    return float(linear.error_m[0] / (noise.jump * noise.range_error_std_m)) ** 2
