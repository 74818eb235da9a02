"""Robust losses for residuals with outliers and for the constants of a flight.

Every residual r has the Cauchy loss L log(1 + r^2 / L) with its own scale L: quadratic where r^2 is
small against L, logarithmic beyond. Up to factors, it is the negative log
likelihood of Student's t.
"""

from dataclasses import dataclass

import numpy as np

from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.camera_residuals import BEARING_LOSS_SCALE
from dmrl.estimation.solver.keyframes import NoiseModel
from dmrl.estimation.solver.residuals import RANGE_ERROR, STATE_SIZE, Linearization

MOTION_LOSS_SCALE = 25.0
"""Loss scale of the motion residuals. Five standard deviations are no noise."""

QUADRATIC_LOSS_SCALE = 1e9
"""Loss scale of a quadratic loss: practically infinite."""
PRIOR_LOSS_SCALES: Array = np.array(
    [2.0, QUADRATIC_LOSS_SCALE, 4.0, 4.0, *[QUADRATIC_LOSS_SCALE] * 6, 4.0]
)
"""Loss scales of the constants, in the order of ``GLOBALS``.

Offsets of ranges, biases of yaw rates and clock offsets are mostly small and sometimes large. The
scales keep a quadratic loss: a scale without a firm prior would shrink the path to nothing. No
record of how the values were chosen."""


@dataclass(frozen=True, slots=True)
class IrlsWeights:
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
    camera: Array | None = None


def loss_scales(noise: NoiseModel) -> tuple[Array, float]:
    """Return the loss scales of a step's residuals (6,) and of a range's."""
    step = np.full(STATE_SIZE, MOTION_LOSS_SCALE)
    step[RANGE_ERROR] = noise.range_step_sigmas**2
    return step, (noise.range_loss_scale_m / noise.range_std_m) ** 2


def total_cost(linear: Linearization, noise: NoiseModel, constants: Array) -> float:
    """Return half the sum of the losses."""
    step, ranges = loss_scales(noise)
    total = (step * np.log1p(linear.step**2 / step)).sum()
    total += ranges * np.log1p(linear.range**2 / ranges).sum()
    total += noise.range_step_sigmas**2 * np.log1p(_first_range_error_square(linear, noise))
    total += (
        noise.range_error_weight
        * np.log1p((linear.error_m / noise.range_error_loss_scale_m) ** 2).sum()
    )
    total += (
        PRIOR_LOSS_SCALES * np.log1p((constants / noise.prior_std()) ** 2 / PRIOR_LOSS_SCALES)
    ).sum()
    if linear.camera is not None:
        total += (
            linear.camera.weight
            * BEARING_LOSS_SCALE
            * np.log1p(linear.camera.squared_distance / BEARING_LOSS_SCALE)
        ).sum()
    return float(total) / 2


def irls_weights(linear: Linearization, noise: NoiseModel, constants: Array) -> IrlsWeights:
    """Return the IRLS weight of every residual: weighted squares have the slope of the losses."""
    step, ranges = loss_scales(noise)
    looked = linear.camera
    return IrlsWeights(
        1 / (1 + linear.step**2 / step),
        1 / (1 + linear.range**2 / ranges),
        1 / (1 + _first_range_error_square(linear, noise)) / noise.range_error_std_m**2,
        noise.range_error_weight / (noise.range_error_loss_scale_m**2 + linear.error_m**2),
        1 / (1 + (constants / noise.prior_std()) ** 2 / PRIOR_LOSS_SCALES),
        None
        if looked is None
        else looked.weight / (1 + looked.squared_distance / BEARING_LOSS_SCALE),
    )


def prior_curvature(noise: NoiseModel, constants: Array) -> Array:
    """Return (G,) information of the prior about the constants, from the curvature of its loss.

    The IRLS weight matches the slope of the loss. The curvature is smaller: the prior hardly
    constrains a constant that is as far out as the prior is wide.
    """
    return (
        loss_curvature((constants / noise.prior_std()) ** 2 / PRIOR_LOSS_SCALES)
        * noise.prior_std() ** -2
    )


def loss_curvature(out: Array) -> Array:
    """Return the curvature of the loss at r^2 / L, relative to a square."""
    # Half of the second derivative of L log(1 + r^2 / L) is (1 - r^2 / L) / (1 + r^2 / L)^2.
    return np.asarray(np.maximum(1 - out, 0.0) / (1 + out) ** 2)


def _first_range_error_square(linear: Linearization, noise: NoiseModel) -> float:
    """Return the square of the first range error, relative to the scale of a step."""
    return float(linear.error_m[0] / (noise.range_step_sigmas * noise.range_error_std_m)) ** 2
