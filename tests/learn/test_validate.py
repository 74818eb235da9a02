import numpy as np
import pytest

from dmrl.learn.batches import FIELDS, Examples
from dmrl.learn.matching import Points
from dmrl.learn.metrics import score
from dmrl.learn.network import build
from dmrl.learn.settings import FitSettings
from dmrl.learn.validate import WATCHED, best_threshold, labels, validation_figures


def points(image: list[int], u_px: list[float], confidence: list[float]) -> Points:
    u = np.array(u_px)
    return Points(np.array(image), u, np.full(len(u), 50.0), np.ones(len(u)), np.array(confidence))


def test_the_threshold_lies_below_the_last_detection_that_pays() -> None:
    truth = points(list(range(12)), [50.0] * 12, [1.0] * 12)
    # Ten right ones, then a wrong one, then a right one, then wrong ones.
    confidence = [0.9] * 10 + [0.6, 0.5, 0.3, 0.2]
    found = points([*range(12), 11, 11], [50.0] * 10 + [200.0, 50.0, 200.0, 250.0], confidence)
    assert best_threshold(score(12, truth, found)) == pytest.approx(0.4)


def test_few_labels_or_nothing_right_give_no_threshold() -> None:
    few = points([0, 1], [50.0, 50.0], [1.0, 1.0])
    assert best_threshold(score(2, few, few)) is None
    many = points(list(range(12)), [50.0] * 12, [1.0] * 12)
    far = points(list(range(12)), [250.0] * 12, [0.9] * 12)
    assert best_threshold(score(12, many, far)) is None


def test_figures_are_of_robots_inside_the_images() -> None:
    robots = np.full((3, 2, len(FIELDS)), np.nan, np.float32)
    robots[0, 0, :6] = (20, 10, 1, 0, 0, 0)
    robots[0, 1, :6] = (-5, 10, 1, 0, 0, 0)
    robots[2, 1, :6] = (30, 31.5, 1, 0, 0, 0)
    examples = Examples([np.zeros((3, 32, 48, 3), np.uint8)], robots)
    assert labels(examples).image.tolist() == [0, 2]
    assert labels(examples).u_px.tolist() == [20.0, 30.0]
    found = validation_figures(build("dmrl-nano").eval(), examples, FitSettings())
    assert found.keys() == {"validation_loss", *(f"validation_{name}" for name in WATCHED)}
    assert np.isfinite(list(found.values())).all()
