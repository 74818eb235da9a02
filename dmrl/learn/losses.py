"""The loss of the paper, on a grid of cells."""

from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits


def confidence_loss(logit: Tensor, confidence: Tensor) -> Tensor:
    """Focal cross entropy: (c - p)^2 * BCE(p, c), summed over cells, mean over images.

    Parameters
    ----------
    logit
        (N, rows, cols) confidence logits; p is their sigmoid.
    confidence
        (N, rows, cols) labels c, 0 to 1.
    """
    focus = (confidence - logit.sigmoid()).square()
    entropy = binary_cross_entropy_with_logits(logit, confidence, reduction="none")
    return (focus * entropy).sum(dim=(1, 2)).mean()


def depth_loss(log_depth: Tensor, depth_m: Tensor, confidence: Tensor) -> Tensor:
    """Squared depth error in cells with a robot, m^2, summed over cells, mean over images.

    Parameters
    ----------
    log_depth
        (N, rows, cols) predicted natural log of the depth in metres.
    depth_m
        (N, rows, cols) labels, metres; any value where ``confidence`` is 0.
    confidence
        (N, rows, cols) labels, the weight of each cell.
    """
    # Masked before exp: a far-off log depth in an empty cell must not give inf * 0.
    predicted_m = (log_depth * (confidence > 0)).exp()
    return (confidence * (predicted_m - depth_m).square()).sum(dim=(1, 2)).mean()
