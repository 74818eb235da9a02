"""Rates of a detector on labelled images, for the model's card and the tracker. NumPy only."""

from typing import Any

import numpy as np

from dmrl.learn.inference.detection_metrics import DEPTH_BANDS_M, ScoredDetections
from dmrl.learn.inference.matching import Array

MIN_RATE_CONFIDENCE = 0.05
"""Least confidence of a detection that counts. At lower ones dmrl-nano's detections near a peer are
off by twice as many pixels: most are false alarms that happen to be near."""
MIN_DETECTIONS = 30
"""Minimum number of correct detections, and of wrong ones; with fewer, the rates are random."""
FARTHEST_M = 2.5
"""Distance that stands for the last band of depth, which has no end, metres."""
MAX_LOGIT = 5.0
"""Largest absolute logit of a confidence in the fit, as in the tracker."""
NEWTON_STEPS, NEWTON_TOLERANCE, NEWTON_RIDGE = 50, 1e-9, 1e-6
"""Newton's method: most steps, tolerance of loss and step, and diagonal added to the Hessian."""


def measure_rates(scored: ScoredDetections) -> dict[str, Any] | None:
    """Measure how often a detector finds peers and errs, and what its confidence is worth.

    Parameters
    ----------
    scored
        Matched detections of images that the network was not trained on. A detection is correct
        within 16 px of a label.

    Returns
    -------
    dict or None
        The fields of a DetectorRates message. None with fewer than `MIN_DETECTIONS` correct or
        wrong detections, or if confidence is no evidence for a peer.
    """
    counts = scored.detections.confidence >= MIN_RATE_CONFIDENCE
    label = scored.right_16_px[counts]
    right = label >= 0
    true, false = int(right.sum()), int((~right).sum())
    if min(true, false) < MIN_DETECTIONS:
        return None
    p = np.clip(scored.detections.confidence[counts], 1e-9, 1 - 1e-9)
    logit = np.clip(np.log(p / (1 - p)), -MAX_LOGIT, MAX_LOGIT)
    rows = np.column_stack([logit, np.ones(len(logit))])
    slope, odds = fit_logistic(rows, right.astype(float)).tolist()
    if slope <= 0:
        return None
    found = np.zeros(len(scored.labels), bool)
    found[label[right]] = True
    distance_m, detected = _share_by_distance(scored.labels.depth_m, found)
    return {
        "min_confidence": MIN_RATE_CONFIDENCE,
        "distance_m": distance_m,
        "detected": detected,
        "false_per_image": false / scored.images,
        "slope": slope,
        # The fit gives the odds of these images, of which true / false are those before a look.
        "offset": odds - float(np.log(true / false)),
    }


def _share_by_distance(depth_m: Array, found: Array) -> tuple[list[float], list[float]]:
    """Return the middles of the depth bands with labels, and the shares found there.

    Half a label found and half a label missed are added to each (Jeffreys), so that no share is 0
    or 1.
    """
    middles, shares = [], []
    for low_m, high_m in DEPTH_BANDS_M[1:]:
        mine = (depth_m >= low_m) & (depth_m < high_m)
        if mine.any():
            middles.append((low_m + high_m) / 2 if np.isfinite(high_m) else FARTHEST_M)
            shares.append(float((found[mine].sum() + 0.5) / (mine.sum() + 1)))
    return middles, shares


def fit_logistic(rows: Array, right: Array, counts: Array | float = 1.0) -> Array:
    """Fit a logistic regression of (N,) labels on (N, K) rows; return (K,) weights.

    Newton's method with step halving, so that the loss never increases. ``counts`` (N,) says how
    often each row counts.
    """

    def loss(weights: Array) -> float:
        odds = rows @ weights
        return float((counts * (np.logaddexp(0, odds) - right * odds)).sum())

    found, before = np.zeros(rows.shape[1]), np.inf
    for _ in range(NEWTON_STEPS):
        said = 1 / (1 + np.exp(-np.clip(rows @ found, -50, 50)))
        bend = (rows.T * (counts * said * (1 - said))) @ rows + NEWTON_RIDGE * np.eye(len(found))
        step = np.linalg.solve(bend, rows.T @ (counts * (said - right)))
        while loss(found - step) > loss(found) and np.abs(step).max() > NEWTON_TOLERANCE:
            step = step / 2
        found = found - step
        if before - (before := loss(found)) < NEWTON_TOLERANCE:
            break
    return found
