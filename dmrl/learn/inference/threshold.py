"""Selection of the confidence threshold, and the false alarms that it causes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dmrl.learn.inference.detection_metrics import ScoredDetections

MIN_LABELS = 10
"""Minimum number of labels; with fewer, the threshold would be random."""
MIN_EMPTY_IMAGES = 20
"""Minimum number of images without a robot; with fewer, the false alarm rate would be random."""


@dataclass(frozen=True, slots=True)
class FalseAlarms:
    """False alarms of a detector in images without a robot.

    Parameters
    ----------
    empty_images
        Number of images labelled as containing no robot.
    alarmed_images
        Number of those with a detection at or above the threshold.
    false_alarms
        Mean number of detections at or above the threshold in an empty image; NaN without any.
    """

    empty_images: int
    alarmed_images: int
    false_alarms: float


def count_false_alarms(scored: ScoredDetections, threshold: float) -> FalseAlarms:
    """Count detections at or above a threshold in images without a robot."""
    empty = find_unlabelled_images(scored)
    sure = scored.detections.image[scored.detections.confidence >= threshold]
    mine = sure[empty[sure]]
    count = int(empty.sum())
    return FalseAlarms(count, len(np.unique(mine)), len(mine) / count if count else np.nan)


def find_unlabelled_images(scored: ScoredDetections) -> NDArray[np.bool_]:
    """Return (images,) whether each image has no label."""
    empty = np.ones(scored.images, bool)
    empty[scored.labels.image] = False
    return empty


def select_threshold(scored: ScoredDetections, false_alarms: float = np.inf) -> float | None:
    """Return the threshold with the best F1, detections correct within 16 px; None with few labels.

    If at least `MIN_EMPTY_IMAGES` images have no label, only thresholds with an acceptable rate of
    false alarms are candidates. The result lies halfway between the last useful detection and the
    next less confident one, so that it does not depend on the last digits of one detection.

    Parameters
    ----------
    scored
        Matched labels and detections.
    false_alarms
        Largest mean number of detections in an image without a label.
    """
    right: NDArray[np.bool_] = scored.right_16_px >= 0
    if len(scored.labels) < MIN_LABELS or not right.any():
        return None
    descending = np.argsort(-scored.detections.confidence, kind="stable")
    confidence = scored.detections.confidence[descending]
    true = np.cumsum(right[descending])
    f1 = 2 * true / (np.arange(1, len(true) + 1) + len(scored.labels))
    f1[~_meets_alarm_rate(scored, descending, false_alarms)] = -1.0
    best = int(np.argmax(f1))
    if f1[best] < 0:  # the most confident detection is a false alarm, and the limit allows none
        return float((confidence[0] + 1) / 2)
    below = confidence[best + 1] if best + 1 < len(confidence) else 0.0
    return float((confidence[best] + below) / 2)


def _meets_alarm_rate(
    scored: ScoredDetections, order: NDArray[np.int64], false_alarms: float
) -> NDArray[np.bool_]:
    """Return (D,) whether a threshold at each detection in ``order`` meets the false alarm rate."""
    empty = find_unlabelled_images(scored)
    if empty.sum() < MIN_EMPTY_IMAGES:
        return np.ones(len(order), bool)
    alarms = np.cumsum(empty[scored.detections.image[order]])
    return np.asarray(alarms <= false_alarms * empty.sum())
