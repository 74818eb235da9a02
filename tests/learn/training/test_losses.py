"""Loss terms, compared with the publication and with cases computed by hand."""

import math
from dataclasses import asdict, fields, replace

import numpy as np
import pytest
import torch

from dmrl.learn.data.targets import build_targets
from dmrl.learn.networks.architectures import build_network, unbind_channels
from dmrl.learn.training.config import TrainConfig
from dmrl.learn.training.losses import (
    TERMS,
    DepthLoss,
    LossSettings,
    class_loss,
    compute_loss_terms,
    compute_spread_loss,
    confidence_loss,
    depth_loss,
    offset_loss,
)


def test_confidence_loss_is_the_published_sum_over_cells() -> None:
    logit = torch.tensor([[[0.0, 2.0]], [[-1.0, -1.0]]])
    label = torch.tensor([[[1.0, 0.0]], [[0.0, 0.0]]])

    def cell(x: float, c: float) -> float:
        p = 1 / (1 + math.exp(-x))
        return (c - p) ** 2 * -(c * math.log(p) + (1 - c) * math.log(1 - p))

    wanted = (cell(0.0, 1) + cell(2.0, 0) + 2 * cell(-1.0, 0)) / 2
    assert float(confidence_loss(logit, label)) == pytest.approx(wanted, rel=1e-6)


def test_depth_loss_counts_cells_with_a_robot_only() -> None:
    log_depth = torch.tensor([[[math.log(1.5), 0.3]], [[0.0, 0.0]]])
    depth_m = torch.tensor([[[1.0, 0.0]], [[0.0, 0.0]]])
    confidence = torch.tensor([[[1.0, 0.0]], [[0.0, 0.0]]])
    assert float(depth_loss(log_depth, depth_m, confidence)) == pytest.approx(0.25 / 2)


def test_log_depth_in_an_empty_cell_has_no_gradient() -> None:
    log_depth = torch.full((1, 1, 1), 1000.0, requires_grad=True)
    loss = depth_loss(log_depth, torch.zeros(1, 1, 1), torch.zeros(1, 1, 1))
    loss.backward()  # type: ignore[no-untyped-call]
    assert float(loss.detach()) == 0
    assert log_depth.grad is not None
    assert float(log_depth.grad.abs().max()) == 0


@pytest.mark.parametrize("kind", ["squared", "log"])
def test_unknown_depth_has_no_gradient(kind: DepthLoss) -> None:
    log_depth = torch.zeros(1, 1, 2, requires_grad=True)
    depth_m = torch.tensor([[[math.e, 0.0]]])
    depth_loss(log_depth, depth_m, torch.tensor([[[1.0, 0.0]]]), kind).backward()  # type: ignore[no-untyped-call]
    assert log_depth.grad is not None
    assert log_depth.grad[0, 0, 1] == 0
    assert log_depth.grad[0, 0, 0] == pytest.approx(-1 if kind == "log" else 2 - 2 * math.e)


def test_confidence_loss_without_focus_is_weighted_cross_entropy() -> None:
    logit, label = torch.tensor([[[0.5, -2.0]]]), torch.tensor([[[0.7, 0.0]]])
    p = logit.sigmoid()
    entropy = -(label * p.log() + (1 - label) * (1 - p).log())
    torch.testing.assert_close(confidence_loss(logit, label, focus=0.0), entropy.sum())
    half = torch.tensor([[[0.5, 1.0]]])
    torch.testing.assert_close(
        confidence_loss(logit, label, half, focus=0.0), (half * entropy).sum()
    )


def test_offset_loss_sums_both_axes_in_cells_with_robots() -> None:
    predicted = torch.tensor([[[[0.5, 9.0]], [[0.0, 9.0]]]])
    wanted = torch.tensor([[[[0.1, 0.0]], [[-0.3, 0.0]]]])
    weight = torch.tensor([[[0.5, 0.0]]])
    assert float(offset_loss(predicted, wanted, weight)) == pytest.approx(0.35)


def test_spread_loss_is_minimal_at_the_mean_error_without_depth_gradient() -> None:
    errors = torch.tensor([0.1, 0.3, 0.2, 0.4])
    log_depth = errors.reshape(1, 1, 4).requires_grad_()
    log_b = torch.linspace(-4, 0, 401)
    loss = [
        float(
            compute_spread_loss(
                b.expand(1, 1, 4), log_depth, torch.ones(1, 1, 4), torch.ones(1, 1, 4)
            )
        )
        for b in log_b
    ]
    assert float(log_b[int(np.argmin(loss))].exp()) == pytest.approx(0.25, rel=0.01)
    spread = torch.zeros(1, 1, 4, requires_grad=True)
    compute_spread_loss(spread, log_depth, torch.ones(1, 1, 4), torch.ones(1, 1, 4)).backward()  # type: ignore[no-untyped-call]
    assert log_depth.grad is None
    assert spread.grad is not None
    assert (spread.grad > 0).all()


def test_class_loss_is_the_published_one_in_cells_of_known_class() -> None:
    logits = torch.tensor([[[[1.0, 5.0, 2.0]], [[-1.0, 5.0, 2.0]]]])
    class_id = torch.tensor([[[0, -1, 1]]])
    weight = torch.tensor([[[0.5, 1.0, 0.0]]])
    p = 1 / (1 + math.exp(-1))
    assert float(class_loss(logits, class_id, weight)) == pytest.approx(-0.5 * 2 * math.log(p))


WEIGHTS = [field.name for field in fields(TrainConfig) if field.name.endswith("_weight")]


def test_each_loss_weight_belongs_to_one_term() -> None:
    assert sorted(WEIGHTS) == sorted(term.weight for term in TERMS)
    assert len({term.name for term in TERMS}) == len(TERMS)


@pytest.mark.parametrize("key", WEIGHTS)
def test_every_weight_changes_the_loss_by_its_own_term(key: str) -> None:
    settings = TrainConfig(classes=("a", "b"), spread_weight=1.0)
    network = build_network("dmrl-nano", extra=settings.extra_channels).eval()
    robots = torch.tensor([[[20.0, 12.0, 1.5, 1.0, 1.0, 0.1, 15.0, 8.0, 25.0, 16.0, 1.0]]])
    wanted = build_targets(robots.repeat(2, 1, 1), (4, 5), sigma_cells=0.7)
    # The poses are of two images of a camera at rest, with its lens in cells.
    wanted = wanted._replace(poses=torch.tensor([[0.0] * 7 + [5.0, 5.0, 2.5, 2.0, 0.0]] * 2))
    with torch.no_grad():
        out = unbind_channels(network.channels, network(torch.ones(2, 3, 32, 40)))
    before = compute_loss_terms(out, wanted, settings)
    after = compute_loss_terms(out, wanted, replace(settings, **{key: 3 * getattr(settings, key)}))
    own = next(k for k, term in enumerate(TERMS) if term.weight == key)
    assert float(before[own]) != 0
    factors = torch.ones(len(TERMS))
    factors[own] = 3.0
    torch.testing.assert_close(after, before * factors)


def test_a_loss_term_is_zero_for_a_network_without_its_channels() -> None:
    network = build_network("locanet").eval()
    wanted = build_targets(torch.full((1, 1, 11), math.nan), (4, 5), sigma_cells=0.7)
    with torch.no_grad():
        out = unbind_channels(network.channels, network(torch.ones(1, 3, 32, 40)))
    parts = dict(
        zip(
            (term.name for term in TERMS),
            compute_loss_terms(out, wanted, LossSettings()),
            strict=True,
        )
    )
    assert {name for name, part in parts.items() if not part} >= {"offset_loss", "class_loss"}
    assert parts["confidence_loss"] > 0


def test_predicted_spread_is_clamped_at_one_hundredth() -> None:
    one = torch.ones(1, 1, 1)
    low, least = (compute_spread_loss(x * one, 0 * one, one, one) for x in (-20.0, math.log(0.01)))
    assert float(low) == float(least) == pytest.approx(math.log(0.01))


@pytest.mark.parametrize("focus", [0.5, 1.0, 3.0])
def test_the_focus_is_the_exponent_of_the_error(focus: float) -> None:
    logit, label = torch.tensor([[[0.5]]]), torch.tensor([[[0.9]]])
    wrong = abs(0.9 - 1 / (1 + math.exp(-0.5)))
    plain = float(confidence_loss(logit, label, focus=0.0))
    assert float(confidence_loss(logit, label, focus=focus)) == pytest.approx(plain * wrong**focus)


def test_default_loss_settings_are_documented_values() -> None:
    assert asdict(LossSettings()) == {
        "confidence_weight": 1.0,
        "focus": 2.0,
        "depth_weight": 1.0,
        "depth_loss": "log",
        "offset_weight": 0.5,
        "spread_weight": 0.0,
        "class_weight": 1.0,
        "consistency_weight": 3.0,
        "classes": (),
    }
