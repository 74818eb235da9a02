"""Losses on a grid of cells: summed over cells, mean over images."""

import math
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, one_hot

DepthLoss = Literal["squared", "log"]
LEAST_LOG_SPREAD = math.log(0.01)
"""A spread below this is taken for it: a hundredth of the depth."""


def confidence_loss(
    logit: Tensor, confidence: Tensor, weight: Tensor | None = None, *, focus: float = 2.0
) -> Tensor:
    """Focal cross entropy |c - p|^focus * BCE(p, c); the paper's with a focus of 2.

    Parameters
    ----------
    logit
        (N, rows, cols) confidence logits; p is their sigmoid.
    confidence
        (N, rows, cols) labels c, 0 to 1.
    weight
        (N, rows, cols) factor of each cell. None: 1.
    focus
        How much cells that are nearly right are left alone. 0: plain cross entropy.
    """
    entropy = binary_cross_entropy_with_logits(logit, confidence, weight, reduction="none")
    if focus:
        entropy = (confidence - logit.sigmoid()).abs().pow(focus) * entropy
    return entropy.sum(dim=(1, 2)).mean()


def depth_loss(
    log_depth: Tensor, depth_m: Tensor, weight: Tensor, kind: DepthLoss = "squared"
) -> Tensor:
    """Depth error in cells with a robot.

    Parameters
    ----------
    log_depth
        (N, rows, cols) predicted natural log of the depth in metres.
    depth_m
        (N, rows, cols) labels, metres; any value where ``weight`` is 0.
    weight
        (N, rows, cols) factor of each cell.
    kind
        "squared": squared error, m^2, as in the paper. "log": absolute error of the
        logarithm, that is, of the share.
    """
    # Masked first: a far-off log depth in an empty cell must not give inf * 0.
    there = weight > 0
    if kind == "log":
        wanted = torch.where(there, depth_m, 1.0).log()
        error = (log_depth * there - wanted).abs()
    else:
        error = ((log_depth * there).exp() - depth_m).square()
    return (weight * error).sum(dim=(1, 2)).mean()


def offset_loss(predicted: Tensor, offset: Tensor, weight: Tensor) -> Tensor:
    """Absolute error of the offset in cells with a robot, cells.

    Parameters
    ----------
    predicted, offset
        (N, 2, rows, cols), cells.
    weight
        (N, rows, cols) factor of each cell.
    """
    return (weight[:, None] * (predicted - offset).abs()).sum(dim=(1, 2, 3)).mean()


def spread_loss(log_spread: Tensor, log_depth: Tensor, depth_m: Tensor, weight: Tensor) -> Tensor:
    """How badly the spread fits the error of log depth: -log of a Laplace density (less log 2).

    The depth does not learn from it: a network that also says how sure it is sees as well as one
    that does not.

    Parameters
    ----------
    log_spread, log_depth
        (N, rows, cols) predicted: log of the scale b of the error, and log of the depth, metres.
    depth_m
        (N, rows, cols) labels, metres; any value where ``weight`` is 0.
    weight
        (N, rows, cols) factor of each cell.
    """
    there = weight > 0
    error = (log_depth.detach() - torch.where(there, depth_m, 1.0).log()).abs() * there
    # Without a floor, a depth that is met exactly is worth infinitely much.
    log_b = log_spread.clamp(min=LEAST_LOG_SPREAD)
    return (weight * (error * (-log_b).exp() + log_b)).sum(dim=(1, 2)).mean()


def class_loss(logits: Tensor, class_id: Tensor, weight: Tensor) -> Tensor:
    """Cross entropy of every class in cells with a robot (paper eq. 8).

    Parameters
    ----------
    logits
        (N, classes, rows, cols).
    class_id
        (N, rows, cols) labels; -1 where it is not known.
    weight
        (N, rows, cols) factor of each cell.
    """
    known = class_id >= 0
    wanted = one_hot(class_id.clamp(min=0), logits.shape[1]).movedim(3, 1).to(logits.dtype)
    entropy = binary_cross_entropy_with_logits(logits, wanted, reduction="none").sum(dim=1)
    return (weight * known * entropy).sum(dim=(1, 2)).mean()
