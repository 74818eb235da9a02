"""Losses that forgive: their weights are their slopes."""

import numpy as np
import pytest

from dmrl.estimation.solver.keyframes import GLOBALS, NoiseModel
from dmrl.estimation.solver.residuals import RANGE_ERROR, STATE_SIZE, Linearization
from dmrl.estimation.solver.robust_loss import (
    MOTION_LOSS_SCALE,
    PRIOR_LOSS_SCALES,
    irls_weights,
    loss_scales,
    prior_curvature,
    total_cost,
)

NOISE = NoiseModel(range_step_sigmas=0.7, range_loss_scale_m=0.3, range_std_m=0.1)
STEPS, RANGES = 3, 4


def linear(residuals: np.ndarray) -> tuple[Linearization, np.ndarray]:
    """A flight of these residuals, one after the other: steps, ranges, the first error, constants;
    and of errors of ranges that are not small."""
    steps = np.zeros((STEPS, STATE_SIZE, 2))
    ranges = np.zeros((RANGES, 2))
    end = STEPS * STATE_SIZE
    steps[..., -1] = residuals[:end].reshape(STEPS, STATE_SIZE)
    ranges[:, -1] = residuals[end : end + RANGES]
    constants = residuals[end + RANGES + 1 :] * NOISE.prior_std()
    error_m = np.linspace(0.0, 0.2, STEPS + 1)
    error_m[0] = residuals[end + RANGES] * NOISE.range_error_std_m
    return Linearization(steps, ranges, error_m), constants


def test_a_weight_times_its_residual_is_the_slope_of_the_cost() -> None:
    count = STEPS * STATE_SIZE + RANGES + 1 + len(GLOBALS)
    at = np.random.default_rng(0).normal(0, 3, count)
    found, constants = linear(at)
    weights = irls_weights(found, NOISE, constants)
    first = (weights.first + weights.free[0]) * NOISE.range_error_std_m**2
    every = np.concatenate([weights.step.ravel(), weights.range, [first], weights.prior])
    for k, step in enumerate(1e-6 * np.eye(count)):
        ahead, behind = (linear(at + sign * step) for sign in (1, -1))
        slope = (
            total_cost(ahead[0], NOISE, ahead[1]) - total_cost(behind[0], NOISE, behind[1])
        ) / 2e-6
        assert slope == pytest.approx(every[k] * at[k], rel=1e-4, abs=1e-6)


def test_a_residual_at_its_limit_counts_half_and_small_ones_in_full() -> None:
    step, ranges = loss_scales(NOISE)
    assert step.tolist() == [MOTION_LOSS_SCALE] * RANGE_ERROR + [NOISE.range_step_sigmas**2]
    assert ranges == pytest.approx(9.0)  # 0.3 m of 0.1 m
    size = STEPS * STATE_SIZE
    limit = np.concatenate(
        [np.tile(step, STEPS), [ranges] * RANGES, [NOISE.range_step_sigmas**2], PRIOR_LOSS_SCALES]
    )
    for share, weight in ((1.0, 0.5), (0.01, 1 / 1.0001), (3.0, 0.1)):
        weights = irls_weights(*_at(share * np.sqrt(limit)))
        assert weights.step == pytest.approx(np.full((STEPS, STATE_SIZE), weight))
        assert weights.range == pytest.approx(np.full(RANGES, weight))
        assert weights.first * NOISE.range_error_std_m**2 == pytest.approx(weight)
        assert weights.prior == pytest.approx(np.full(len(GLOBALS), weight))
    assert size == weights.step.size


def test_an_error_of_a_range_is_held_against_none_and_a_long_detour_hardly() -> None:
    found, constants = linear(np.zeros(STEPS * STATE_SIZE + RANGES + 1 + len(GLOBALS)))
    for error_m, weight in (
        (0.0, 1.0),
        (NOISE.range_error_loss_scale_m, 0.5),
        (3 * NOISE.range_error_loss_scale_m, 0.1),
    ):
        found.error_m[:] = error_m
        free = (
            irls_weights(found, NOISE, constants).free
            * NOISE.range_error_loss_scale_m**2
            / NOISE.range_error_weight
        )
        assert free == pytest.approx(np.full(STEPS + 1, weight))


def _at(residuals: np.ndarray) -> tuple[Linearization, NoiseModel, np.ndarray]:
    found, constants = linear(residuals)
    return found, NOISE, constants


@pytest.mark.parametrize("out", [0.0, 0.3, 0.9, 1.1, 3.0])
def test_what_the_prior_holds_is_the_curvature_of_the_cost_and_never_negative(out: float) -> None:
    count = STEPS * STATE_SIZE + RANGES + 1 + len(GLOBALS)
    at = np.zeros(count)
    at[-len(GLOBALS) :] = out * np.sqrt(np.minimum(PRIOR_LOSS_SCALES, 4.0))
    found, constants = linear(at)
    held = prior_curvature(NOISE, constants)
    for k, step in enumerate(1e-3 * np.diag(NOISE.prior_std())):
        costs = [total_cost(found, NOISE, constants + sign * step) for sign in (-1, 0, 1)]
        bend = (costs[0] - 2 * costs[1] + costs[2]) / (1e-3 * NOISE.prior_std()[k]) ** 2
        assert held[k] == pytest.approx(
            max(bend, 0.0), rel=1e-3, abs=1e-3 * NOISE.prior_std()[k] ** -2
        )
