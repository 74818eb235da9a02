"""The confidence threshold, false alarms and validation metrics."""

import numpy as np
import pytest

from dmrl.learn.data.batches import ROBOT_FIELDS, ExampleSet
from dmrl.learn.inference.detection_metrics import score_detections
from dmrl.learn.inference.matching import Points
from dmrl.learn.inference.threshold import count_false_alarms, select_threshold
from dmrl.learn.networks.architectures import build_network
from dmrl.learn.training.config import TrainConfig
from dmrl.learn.training.validation import VALIDATION_METRICS, select_visible_labels, validate


def build_points(image: list[int], u_px: list[float], confidence: list[float]) -> Points:
    """Return points at v = 50 px and a depth of 1 m."""
    u = np.array(u_px)
    return Points(np.array(image), u, np.full(len(u), 50.0), np.ones(len(u)), np.array(confidence))


def test_threshold_is_set_by_the_detection_that_maximizes_f_score() -> None:
    truth = build_points(list(range(12)), [50.0] * 12, [1.0] * 12)
    # By confidence there are ten right detections, a wrong, a right and two wrong ones.
    confidence = [0.9] * 10 + [0.6, 0.5, 0.3, 0.2]
    found = build_points(
        [*range(12), 11, 11], [50.0] * 10 + [200.0, 50.0, 200.0, 250.0], confidence
    )
    assert select_threshold(score_detections(12, truth, found)) == pytest.approx(0.4)


def test_the_threshold_limits_the_rate_of_false_alarms() -> None:
    truth = build_points(list(range(12)), [50.0] * 12, [1.0] * 12)
    # Three of 40 images without a robot have a detection, of confidence 0.7, 0.55 and 0.45.
    confidence = [0.9] * 8 + [0.6, 0.5, 0.4, 0.3] + [0.7, 0.55, 0.45]
    found = build_points([*range(12), 20, 30, 40], [50.0] * 12 + [80.0] * 3, confidence)
    scored = score_detections(52, truth, found)
    assert select_threshold(scored) == pytest.approx(0.15)
    assert select_threshold(scored, false_alarms=0.05) == pytest.approx(0.475)  # two of 40 images
    assert select_threshold(scored, false_alarms=0.0) == pytest.approx(0.8)
    # Nineteen empty images are too few to measure a rate of one in twenty.
    few = score_detections(
        31, truth, build_points([*range(12), 20], [50.0] * 12 + [80.0], confidence[:13])
    )
    assert select_threshold(few, false_alarms=0.0) == pytest.approx(0.15)


def test_the_threshold_excludes_a_false_alarm_surer_than_all_detections() -> None:
    truth = build_points(list(range(12)), [50.0] * 12, [1.0] * 12)
    found = build_points([*range(12), 20], [50.0] * 12 + [80.0], [0.9] * 12 + [0.96])
    assert select_threshold(score_detections(40, truth, found), false_alarms=0.01) == pytest.approx(
        0.98
    )


def test_false_alarms_are_counted_in_empty_images() -> None:
    truth = build_points([0], [50.0], [1.0])
    found = build_points(
        [0, 0, 1, 1, 2], [50.0, 150.0, 60.0, 90.0, 60.0], [0.9, 0.8, 0.7, 0.6, 0.2]
    )
    scored = score_detections(5, truth, found)
    at_half = count_false_alarms(scored, 0.5)
    assert (at_half.empty_images, at_half.alarmed_images, at_half.false_alarms) == (4, 1, 0.5)
    assert count_false_alarms(scored, 0.1).alarmed_images == 2
    assert np.isnan(count_false_alarms(score_detections(1, truth, truth), 0.5).false_alarms)


def test_few_labels_or_no_right_detections_give_no_threshold() -> None:
    few = build_points([0, 1], [50.0, 50.0], [1.0, 1.0])
    assert select_threshold(score_detections(2, few, few)) is None
    many = build_points(list(range(12)), [50.0] * 12, [1.0] * 12)
    far = build_points(list(range(12)), [250.0] * 12, [0.9] * 12)
    assert select_threshold(score_detections(12, many, far)) is None


@pytest.mark.heavy
def test_validation_counts_only_robots_inside_the_images() -> None:
    robots = np.full((3, 2, len(ROBOT_FIELDS)), np.nan, np.float32)
    robots[0, 0, :6] = (20, 10, 1, 0, 0, 0)
    robots[0, 1, :6] = (-5, 10, 1, 0, 0, 0)
    robots[2, 1, :6] = (30, 31.5, 1, 0, 0, 0)
    examples = ExampleSet([np.zeros((3, 32, 48, 3), np.uint8)], robots)
    assert select_visible_labels(examples).image.tolist() == [0, 2]
    assert select_visible_labels(examples).u_px.tolist() == [20.0, 30.0]
    found = validate(build_network("dmrl-nano").eval(), examples, TrainConfig())
    assert found.keys() == {
        "validation_loss",
        *(f"validation_{name}" for name in VALIDATION_METRICS),
    }
    assert np.isfinite(list(found.values())).all()


def test_ten_labels_are_enough_for_a_threshold() -> None:
    for count, known in ((9, False), (10, True)):
        truth = build_points(list(range(count)), [50.0] * count, [1.0] * count)
        found = select_threshold(score_detections(count, truth, truth))
        assert (found is not None) == known
        assert found is None or found == 0.5  # It is halfway from the last confidence, 1, to 0.


def test_false_alarm_rate_needs_twenty_empty_images() -> None:
    truth = build_points(list(range(12)), [50.0] * 12, [1.0] * 12)
    found = build_points([*range(12), 12], [50.0] * 12 + [80.0], [0.9] * 12 + [0.8])
    for images, threshold in ((12 + 19, 0.85), (12 + 20, 0.85)):
        assert select_threshold(score_detections(images, truth, found), 0.0) == pytest.approx(
            threshold
        )
    # The false alarm is now surer than every detection, and only 20 images can measure its rate.
    sure = build_points([*range(12), 12], [50.0] * 12 + [80.0], [0.9] * 12 + [0.94])
    for images, threshold in ((12 + 19, 0.45), (12 + 20, 0.97)):
        assert select_threshold(score_detections(images, truth, sure), 0.0) == pytest.approx(
            threshold
        )
    # One alarm in 20 images meets a rate of one in twenty.
    assert select_threshold(score_detections(32, truth, sure), 0.05) == pytest.approx(0.45)


def test_upper_and_left_image_edges_are_inside() -> None:
    robots = np.full((8, 1, len(ROBOT_FIELDS)), np.nan, np.float32)
    at = [(0, 10), (20, 0), (48, 10), (20, 32), (47.9, 31.9), (-0.1, 10), (20, -0.1)]
    for row, (u, v) in zip(robots, at, strict=False):
        row[0, :3] = u, v, 2.0
    found = select_visible_labels(ExampleSet([np.zeros((8, 32, 48, 3), np.uint8)], robots))
    assert found.image.tolist() == [0, 1, 4]
    assert found.depth_m.tolist() == [2, 2, 2] and found.confidence.tolist() == [1, 1, 1]
    assert found.v_px.tolist() == pytest.approx([10, 0, 31.9])


def test_a_detection_at_the_threshold_is_a_false_alarm() -> None:
    truth, found = build_points([0], [50.0], [1.0]), build_points([1, 2], [60.0, 60.0], [0.5, 0.49])
    assert count_false_alarms(score_detections(3, truth, found), 0.5).alarmed_images == 1


def test_a_right_detection_may_be_off_by_twice_the_sigma_of_its_label() -> None:
    truth, found = (
        build_points([0, 1], [50.0] * 2, [1.0] * 2),
        build_points([0, 1], [75.0] * 2, [0.9] * 2),
    )
    scored = score_detections(2, truth, found, np.array([0.0, 10.0]))
    assert scored.right_16_px.tolist() == [-1, 1]
