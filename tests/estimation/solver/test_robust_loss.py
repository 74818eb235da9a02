"""Robust losses: weight and curvature are derivatives of the cost."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from dmrl.estimation.flight.pairs import estimate_pairs
from dmrl.estimation.model.status import OK
from dmrl.estimation.solver.problem import NoiseModel
from dmrl.estimation.solver.robust_loss import Array, Cauchy, Gaussian, Loss

from ..flights import build_pair, simulate_flight


@dataclass(frozen=True, slots=True)
class Huber:
    """Huber loss: quadratic up to a residual s, linear beyond.

    Parameters
    ----------
    sigmas
        The residual s, in standard deviations.
    """

    sigmas: float

    def cost(self, square: Array) -> Array:
        """Return the losses."""
        size = np.sqrt(square)
        return np.where(size > self.sigmas, self.sigmas * (2 * size - self.sigmas), square)

    def weight(self, square: Array) -> Array:
        """Return the IRLS weights."""
        return np.asarray(np.minimum(1.0, self.sigmas / np.sqrt(np.maximum(square, 1e-12))))

    def curvature(self, square: Array) -> Array:
        """Return half the second derivatives, at least 0."""
        return np.asarray(square <= self.sigmas**2, float)


LOSSES = (Gaussian(), Cauchy(1.5), Cauchy(4.0), Huber(1.5))
RESIDUALS = np.array([-6.0, -1.0, -0.3, 0.2, 0.9, 1.4, 2.0, 7.0])


@pytest.mark.parametrize("loss", LOSSES)
def test_weight_and_curvature_are_derivatives_of_the_cost(loss: Loss) -> None:
    step = 1e-5
    high, low = (loss.cost((RESIDUALS + way * step) ** 2) for way in (1, -1))
    assert (high - low) / (4 * step) == pytest.approx(
        loss.weight(RESIDUALS**2) * RESIDUALS, rel=1e-6, abs=1e-8
    )
    step = 1e-3
    high, low, here = (loss.cost((RESIDUALS + way * step) ** 2) for way in (1, -1, 0))
    bend = (high - 2 * here + low) / (2 * step**2)
    assert loss.curvature(RESIDUALS**2) == pytest.approx(np.maximum(bend, 0), abs=1e-4)


@pytest.mark.parametrize("loss", LOSSES)
def test_small_residuals_have_full_weight(loss: Loss) -> None:
    small = np.array([0.0, 1e-8])
    assert loss.cost(small) == pytest.approx(small)
    assert loss.weight(small) == pytest.approx(1.0)
    assert loss.curvature(small) == pytest.approx(1.0)


def test_residual_at_the_cauchy_scale_has_half_weight() -> None:
    assert Cauchy(3.0).weight(np.array([9.0])) == pytest.approx(0.5)
    assert Huber(2.0).weight(np.array([16.0])) == pytest.approx(0.5)


@pytest.mark.heavy
def test_huber_loss_replaces_cauchy_by_argument() -> None:
    flight = simulate_flight("random", "calibrated", 1001, 40.0)
    noise = replace(NoiseModel(grade=0.63), range_loss=Huber(1.25), motion_loss=Huber(3.0))
    ((here, there),) = estimate_pairs([build_pair(flight)], noise=noise)
    assert (here.status == OK).mean() > 0.5
    assert (there.status == OK).mean() > 0.5
