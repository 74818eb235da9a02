from dataclasses import replace

import numpy as np
import pytest
import torch

from dmrl.learn.calibrate import Calibration, calibrate, calibration
from dmrl.learn.matching import Points
from dmrl.learn.metrics import Curves, Scored, curves, score
from dmrl.learn.network import build


def scored(slope: float, offset: float, count: int = 4000) -> Scored:
    """Detections whose chance to be right is that of their logit times slope plus offset."""
    rng = np.random.default_rng(3)
    logits = rng.uniform(-3.5, 2, count)
    right = rng.random(count) < 1 / (1 + np.exp(-slope * logits - offset))
    image, u = np.arange(count), np.full(count, 50.0)
    truth = Points(image, np.where(right, u, 150.0), u, np.ones(count), np.ones(count))
    return score(count, truth, Points(image, u, u, np.ones(count), 1 / (1 + np.exp(-logits))))


def expected_error(found: Curves) -> float:
    """Of confidence against the share that is right, over all detections."""
    gap = np.abs(found.bin_confidence - found.bin_right)
    return float(np.nansum(gap * found.bin_count) / found.bin_count.sum())


def test_the_slope_and_offset_are_found() -> None:
    found = calibration(scored(2.5, 1.0))
    assert found is not None
    assert found == pytest.approx((2.5, 1.0), abs=0.2)


def test_confidence_is_the_share_that_is_right_afterwards() -> None:
    before = scored(2.5, 1.0)
    found = calibration(before)
    assert found is not None
    old = before.detections.confidence
    new = 1 / (1 + np.exp(-found.slope * np.log(old / (1 - old)) - found.offset))
    after = score(before.images, before.labels, replace(before.detections, confidence=new))
    gaps = [expected_error(curves(one)) for one in (before, after)]
    assert gaps[0] > 0.1
    assert gaps[1] < 0.03


def test_too_little_to_tell_or_no_sense_in_it_is_no_calibration() -> None:
    assert calibration(scored(2.5, 1.0, count=40)) is None
    assert calibration(scored(-1.0, 0.0)) is None


def test_the_last_layer_carries_it_and_nothing_else_changes() -> None:
    network = build("dmrl-nano", seed=1).eval()
    images = torch.rand(2, 3, 64, 96)
    with torch.inference_mode():
        before = network(images).clone()
        assert calibrate(network, Calibration(1.5, -0.25))
        after = network(images)
    row = network.channels.index("confidence")
    torch.testing.assert_close(after[:, row], before[:, row] * 1.5 - 0.25)
    others = [k for k in range(len(network.channels)) if k != row]
    torch.testing.assert_close(after[:, others], before[:, others])


def test_a_network_with_another_last_layer_is_left_as_it_is() -> None:
    network = build("locanet")
    network.head = torch.nn.Identity()  # type: ignore[assignment]
    assert not calibrate(network, Calibration(2.0, 0.0))
