"""Confidence calibration by Platt scaling: of detections with confidence 0.7, 70 % are correct.

A network is trained on a peak around every robot, not on probabilities, so its confidence only
ranks detections. Platt's logistic regression of correctness on the logit (Platt 1999, Guo et al.
2017) gives a slope and an offset. The weights of the last layer absorb both, so ONNX, int8 and C
exports need no change.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from dmrl.learn.inference.detection_metrics import ScoredDetections
from dmrl.learn.inference.detector_rates import fit_logistic
from dmrl.learn.inference.matching import Index
from dmrl.learn.networks.architectures import Network

MIN_DETECTIONS = 30
"""Minimum number of correct detections, and of wrong ones, for a fit."""
MIN_CONFIDENCE = 0.02
"""Lower bound of the confidence of detections in the fit; fainter ones are irrelevant in use."""
SLOPE_RANGE = (0.2, 10.0)
"""Accepted slopes. Others come from too few detections or an uninformative confidence."""


class PlattScaling(NamedTuple):
    """Slope and offset of the confidence logit: slope * logit + offset."""

    slope: float
    offset: float


def fit_calibration(scored: ScoredDetections, group: Index | None = None) -> PlattScaling | None:
    """Fit the slope and offset that make each confidence the fraction of correct detections.

    A detection is correct within 16 px of a label.

    Parameters
    ----------
    scored
        Matched detections of images that the network was not trained on.
    group
        (images,) number of the source of each image: renders, composites, real frames. Each source
        counts the same, however many detections it has. None: one source.

    Returns
    -------
    PlattScaling or None
        None if there are too few detections, or the slope is outside `SLOPE_RANGE`.
    """
    confidence = scored.detections.confidence
    seen = confidence >= MIN_CONFIDENCE
    right = (scored.right_16_px >= 0)[seen].astype(np.float64)
    if min(right.sum(), len(right) - right.sum()) < MIN_DETECTIONS:
        return None
    p = np.clip(confidence[seen], 1e-7, 1 - 1e-7)
    rows = np.column_stack([np.log(p / (1 - p)), np.ones(len(p))])
    sources = np.zeros(len(p), np.int64) if group is None else group[scored.detections.image[seen]]
    weight = 1 / np.bincount(sources)[sources]
    slope, offset = fit_logistic(rows, right, weight * len(p) / weight.sum()).tolist()
    return PlattScaling(slope, offset) if SLOPE_RANGE[0] <= slope <= SLOPE_RANGE[1] else None


def apply_calibration(network: Network, found: PlattScaling) -> bool:
    """Write a calibration into the last layer, ``head``; return False if the network has none.

    Parameters
    ----------
    network
        Network, changed in place.
    found
        Calibration of this network.
    """
    head = getattr(network, "head", None)
    if not isinstance(head, nn.Conv2d) or head.bias is None:
        return False
    row = network.channels.index("confidence")
    with torch.no_grad():
        head.weight[row] *= found.slope
        head.bias[row] = head.bias[row] * found.slope + found.offset
    return True
