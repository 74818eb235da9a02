"""Confidence that is a probability: of detections of 0.7, seven in ten are right.

What a network is trained on is a hill about every robot, not a chance, so its confidence only
ranks. Platt's logistic regression (Platt 1999, Guo et al. 2017) of right or wrong on the logit is
a slope and an offset, and these are carried by the weights of the last layer: exports, int8 and C
say the same without knowing of it.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from dmrl.learn.inference.detection_metrics import Scored
from dmrl.learn.inference.matching import Array
from dmrl.learn.networks.architectures import Network

LEAST = 30
"""Right and wrong detections, of each, below which nothing is fitted."""
FAINTEST = 0.02
"""Confidence below which detections say nothing of those that anybody would believe."""
STEPS, CLOSE, RIDGE = 50, 1e-9, 1e-6
SLOPES = (0.2, 10.0)
"""Beyond these a fit is of too little, or of a network that knows nothing."""


class Calibration(NamedTuple):
    """What a logit is multiplied by, and what is added then."""

    slope: float
    offset: float


def calibration(scored: Scored) -> Calibration | None:
    """Slope and offset that make confidences of detections the share of them that is right.

    Right within 16 px. None where there are too few detections to tell, or a higher confidence
    is no better.

    Parameters
    ----------
    scored
        Of images that the network did not learn from.
    """
    confidence = scored.detections.confidence
    seen = confidence >= FAINTEST
    right = (scored.right_16_px >= 0)[seen].astype(np.float64)
    if min(right.sum(), len(right) - right.sum()) < LEAST:
        return None
    p = np.clip(confidence[seen], 1e-7, 1 - 1e-7)
    rows = np.column_stack([np.log(p / (1 - p)), np.ones(len(p))])
    slope, offset = _fitted(rows, right).tolist()
    return Calibration(slope, offset) if SLOPES[0] <= slope <= SLOPES[1] else None


def _fitted(rows: Array, right: Array) -> Array:
    """(K,) weights of (N, K) rows that make (N,) right likeliest: Newton's steps, never uphill."""

    def loss(weights: Array) -> float:
        odds = rows @ weights
        return float((np.logaddexp(0, odds) - right * odds).sum())

    found, before = np.zeros(rows.shape[1]), np.inf
    for _ in range(STEPS):
        said = 1 / (1 + np.exp(-np.clip(rows @ found, -50, 50)))
        bend = (rows.T * (said * (1 - said))) @ rows + RIDGE * np.eye(len(found))
        step = np.linalg.solve(bend, rows.T @ (said - right))
        while loss(found - step) > loss(found) and np.abs(step).max() > CLOSE:
            step = step / 2
        found = found - step
        if before - (before := loss(found)) < CLOSE:
            break
    return found


def calibrate(network: Network, found: Calibration) -> bool:
    """Write a calibration into the last layer, ``head``; False for a network without one.

    Parameters
    ----------
    network
        Changed in place.
    found
        Of this network.
    """
    head = getattr(network, "head", None)
    if not isinstance(head, nn.Conv2d) or head.bias is None:
        return False
    row = network.channels.index("confidence")
    with torch.no_grad():
        head.weight[row] *= found.slope
        head.bias[row] = head.bias[row] * found.slope + found.offset
    return True
