"""From which confidence a detection is to be believed, and what that costs where nobody is."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dmrl.learn.inference.detection_metrics import Scored

LEAST_LABELS = 10
"""Labels below which a threshold would hang on chance."""
LEAST_EMPTY = 20
"""Images without a robot below which a rate of false alarms would."""


@dataclass(frozen=True, slots=True)
class Alarms:
    """What a detector says of images without a robot.

    Parameters
    ----------
    empty_images
        Images whose labels say that no robot is in view.
    alarmed_images
        Those of them with a detection at or above the threshold.
    false_alarms
        Detections at or above the threshold in an empty image, on average; NaN without one.
    """

    empty_images: int
    alarmed_images: int
    false_alarms: float


def alarms(scored: Scored, threshold: float) -> Alarms:
    """Detections at or above a threshold where no robot is."""
    empty = without_label(scored)
    sure = scored.detections.image[scored.detections.confidence >= threshold]
    mine = sure[empty[sure]]
    count = int(empty.sum())
    return Alarms(count, len(np.unique(mine)), len(mine) / count if count else np.nan)


def without_label(scored: Scored) -> NDArray[np.bool_]:
    """(images,) which have no label."""
    empty = np.ones(scored.images, bool)
    empty[scored.labels.image] = False
    return empty


def best_threshold(scored: Scored, false_alarms: float = np.inf) -> float | None:
    """Confidence that gives the best F1, detections right within 16 px; None with few labels.

    Of the confidences at or above which an image without a label has at most so many detections,
    where `LEAST_EMPTY` images are without. Halfway between the last detection that pays and the
    next below it, so that the choice does not hang on one detection's last digits.

    Parameters
    ----------
    scored
        Matched labels and detections.
    false_alarms
        Detections of an image without a label, on average, at most.
    """
    right: NDArray[np.bool_] = scored.right_16_px >= 0
    if len(scored.labels) < LEAST_LABELS or not right.any():
        return None
    descending = np.argsort(-scored.detections.confidence, kind="stable")
    confidence = scored.detections.confidence[descending]
    true = np.cumsum(right[descending])
    f1 = 2 * true / (np.arange(1, len(true) + 1) + len(scored.labels))
    f1[~_quiet(scored, descending, false_alarms)] = -1.0
    best = int(np.argmax(f1))
    if f1[best] < 0:  # the surest of all is a false alarm, and one is too many
        return float((confidence[0] + 1) / 2)
    below = confidence[best + 1] if best + 1 < len(confidence) else 0.0
    return float((confidence[best] + below) / 2)


def _quiet(scored: Scored, order: NDArray[np.int64], false_alarms: float) -> NDArray[np.bool_]:
    """(D,) whether a threshold at a detection, surest first, keeps to the rate of alarms."""
    empty = without_label(scored)
    if empty.sum() < LEAST_EMPTY:
        return np.ones(len(order), bool)
    alarms = np.cumsum(empty[scored.detections.image[order]])
    return np.asarray(alarms <= false_alarms * empty.sum())
