"""Rates of a detector: peers that it finds, false alarms, and the evidence of a confidence.

Imports nothing heavy: the help of a command shows the defaults.
"""

from dataclasses import dataclass

import numpy as np

from dmrl.geometry.frames import Array

MAX_LOGIT = 5.0
"""Largest absolute logit of a confidence, 0.7 to 99.3 %. The calibration has no data beyond it."""


@dataclass(frozen=True, slots=True)
class DetectorRates:
    """Rates of all detections with at least ``min_confidence``.

    The defaults are those of dmrl-nano on eight rendered flights, see docs/tracking.md. They apply
    to recordings and models without rates of their own.

    Parameters
    ----------
    min_confidence
        Least confidence of a detection that counts, 0 to 1.
    distance_m, detected
        Increasing distances, and the share of the peers in view at each of them that is detected.
    false_per_image
        Mean number of false alarms in an image.
    slope, offset
        Log likelihood ratio of a confidence, between peers and false alarms: slope * logit +
        offset. The slope of a calibrated confidence is 1.
    """

    min_confidence: float = 0.05
    distance_m: tuple[float, ...] = (0.25, 0.75, 1.25, 1.75, 2.5)
    detected: tuple[float, ...] = (0.51, 0.79, 0.53, 0.35, 0.1)
    false_per_image: float = 0.78
    slope: float = 1.14
    offset: float = 0.71

    def log_ratio(self, confidence: Array) -> Array:
        """Return (N,) log likelihood ratios of (N,) confidences."""
        p = np.clip(confidence, 1e-9, 1 - 1e-9)
        logit = np.clip(np.log(p / (1 - p)), -MAX_LOGIT, MAX_LOGIT)
        return np.asarray(self.slope * logit + self.offset)

    def detected_share(self, distance_m: Array) -> Array:
        """Return (N,) shares of the peers detected at (N,) distances, interpolated."""
        return np.interp(distance_m, self.distance_m, self.detected)
