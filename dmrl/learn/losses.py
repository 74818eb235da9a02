"""Losses on a grid of cells: summed over cells, mean over images."""

from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

DepthLoss = Literal["squared", "log"]


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
