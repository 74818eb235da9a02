"""Calibration of confidences to the share of right detections."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dmrl.learn.inference.confidence_calibration import (
    MIN_CONFIDENCE,
    MIN_DETECTIONS,
    PlattScaling,
    apply_calibration,
    fit_calibration,
)
from dmrl.learn.inference.detection_metrics import (
    MetricCurves,
    ScoredDetections,
    compute_curves,
    score_detections,
)
from dmrl.learn.inference.detector_rates import fit_logistic
from dmrl.learn.inference.matching import Points
from dmrl.learn.networks.architectures import build_network


def draw_scored(slope: float, offset: float, count: int = 4000) -> ScoredDetections:
    """Draw a detection an image, right with the probability of logit slope * logit + offset."""
    rng = np.random.default_rng(3)
    logits = rng.uniform(-3.5, 2, count)
    right = rng.random(count) < 1 / (1 + np.exp(-slope * logits - offset))
    image, u = np.arange(count), np.full(count, 50.0)
    truth = Points(image, np.where(right, u, 150.0), u, np.ones(count), np.ones(count))
    return score_detections(
        count, truth, Points(image, u, u, np.ones(count), 1 / (1 + np.exp(-logits)))
    )


def compute_calibration_error(found: MetricCurves) -> float:
    """Return the mean gap between confidence and the share of right detections, over bins."""
    gap = np.abs(found.bin_confidence - found.bin_right)
    return float(np.nansum(gap * found.bin_count) / found.bin_count.sum())


def test_slope_and_offset_of_the_simulation_are_recovered() -> None:
    found = fit_calibration(draw_scored(2.5, 1.0))
    assert found is not None
    assert found == pytest.approx((2.5, 1.0), abs=0.2)


def test_calibrated_confidence_equals_the_share_of_right_detections() -> None:
    before = draw_scored(2.5, 1.0)
    found = fit_calibration(before)
    assert found is not None
    old = before.detections.confidence
    new = 1 / (1 + np.exp(-found.slope * np.log(old / (1 - old)) - found.offset))
    after = score_detections(
        before.images, before.labels, replace(before.detections, confidence=new)
    )
    gaps = [compute_calibration_error(compute_curves(one)) for one in (before, after)]
    assert gaps[0] > 0.1
    assert gaps[1] < 0.03


def test_every_source_counts_the_same_whatever_its_size() -> None:
    large, small = draw_scored(2.5, 1.0, count=8000), draw_scored(2.5, -1.0, count=1000)
    first = np.array([0, large.images])
    labels, found = (
        Points.concatenate([getattr(large, name), getattr(small, name)], first)
        for name in ("labels", "detections")
    )
    both = score_detections(large.images + small.images, labels, found)
    group = np.repeat([0, 1], [large.images, small.images])
    alone, shared = fit_calibration(both), fit_calibration(both, group)
    assert alone is not None
    assert shared is not None
    assert alone.offset > 0.6
    assert shared.offset == pytest.approx(0, abs=0.2)


def test_calibration_needs_enough_data_and_positive_slope() -> None:
    assert fit_calibration(draw_scored(2.5, 1.0, count=40)) is None
    assert fit_calibration(draw_scored(-1.0, 0.0)) is None


def test_calibration_changes_only_the_confidence_of_the_last_layer() -> None:
    network = build_network("dmrl-nano", seed=1).eval()
    images = torch.rand(2, 3, 64, 96)
    with torch.inference_mode():
        before = network(images).clone()
        assert apply_calibration(network, PlattScaling(1.5, -0.25))
        after = network(images)
    row = network.channels.index("confidence")
    torch.testing.assert_close(after[:, row], before[:, row] * 1.5 - 0.25)
    others = [k for k in range(len(network.channels)) if k != row]
    torch.testing.assert_close(after[:, others], before[:, others])


def test_network_with_another_last_layer_is_not_calibrated() -> None:
    network = build_network("locanet")
    network.head = torch.nn.Identity()  # type: ignore[assignment]
    assert not apply_calibration(network, PlattScaling(2.0, 0.0))


def score_points(confidence: list[float], right: list[bool]) -> ScoredDetections:
    """Return one detection an image with its confidence, right or 100 px off."""
    image, u = np.arange(len(right)), np.full(len(right), 50.0)
    truth = Points(image, np.where(right, u, 150.0), u, np.ones(len(u)), np.ones(len(u)))
    return score_detections(
        len(u), truth, Points(image, u, u, np.ones(len(u)), np.array(confidence))
    )


def test_thirty_right_and_wrong_detections_are_needed_above_the_minimum_confidence() -> None:
    for right, wrong, known in (
        (MIN_DETECTIONS, MIN_DETECTIONS, True),
        (MIN_DETECTIONS - 1, 99, False),
        (99, 29, False),
    ):
        # Three in four detections of high confidence are right, one in four of low confidence.
        sure = [True] * (right * 3 // 4) + [False] * (wrong // 4)
        weak = [True] * (right - right * 3 // 4) + [False] * (wrong - wrong // 4)
        confidence = [0.8] * len(sure) + [0.3] * len(weak)
        assert (fit_calibration(score_points(confidence, sure + weak)) is not None) == known
        below = [MIN_CONFIDENCE - 1e-3] * 200
        faint = score_points(confidence + below, sure + weak + [False] * 200)
        assert fit_calibration(faint) == fit_calibration(score_points(confidence, sure + weak))


def test_two_confidence_levels_are_calibrated_to_their_precision() -> None:
    confidence = [0.8] * 100 + [0.3] * 100
    right = [True] * 90 + [False] * 10 + [True] * 40 + [False] * 60
    found = fit_calibration(score_points(confidence, right))
    assert found is not None
    said = [found.slope * np.log(p / (1 - p)) + found.offset for p in (0.8, 0.3)]
    assert said == pytest.approx([np.log(9), np.log(2 / 3)], abs=1e-3)


@pytest.mark.parametrize(
    ("slope", "known"), [(0.15, False), (0.25, True), (9.5, True), (11, False)]
)
def test_calibration_rejects_slopes_that_are_too_flat_or_steep(slope: float, known: bool) -> None:
    logit, share = 0.2, 1 / (1 + np.exp(-0.2 * slope))
    count = 20_000
    right = [True] * round(share * count) + [False] * round((1 - share) * count)
    mirrored = [not one for one in right]
    confidence = [1 / (1 + np.exp(-logit))] * len(right) + [1 / (1 + np.exp(logit))] * len(right)
    found = fit_calibration(score_points(confidence, right + mirrored))
    assert (found is not None) == known
    assert found is None or found == pytest.approx((slope, 0.0), abs=0.05)


def test_logistic_fit_has_zero_likelihood_gradient() -> None:
    rng = np.random.default_rng(0)
    rows = np.column_stack([rng.normal(size=500), np.ones(500)])
    right = (rng.random(500) < 1 / (1 + np.exp(-3 * rows[:, 0] + 1))).astype(float)
    said = 1 / (1 + np.exp(-rows @ fit_logistic(rows, right)))
    assert rows.T @ (said - right) == pytest.approx(np.zeros(2), abs=1e-4)
