"""Losses on a grid of cells, summed over cells and averaged over images.

To add a loss, write a function, a weight in `LossSettings`, and a row of `TERMS`.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, one_hot

from dmrl.learn.data.targets import MIN_PRESENCE, Targets
from dmrl.learn.networks.architectures import CLASS_PREFIX, SPREAD_CHANNEL
from dmrl.learn.training.consistency import compare

DepthLoss = Literal["squared", "log"]
OutputChannels = Mapping[str, Tensor]
"""Output of a network: (N, rows, cols) by channel name."""
MIN_LOG_SPREAD = math.log(0.01)
"""Lower bound of the predicted log spread: a hundredth of the depth."""


@dataclass(frozen=True, slots=True)
class LossSettings:
    """Weights and kinds of the losses; base class of `TrainConfig`.

    Parameters
    ----------
    confidence_weight
        Weight of the confidence loss.
    focus
        Exponent of the focal confidence loss. 0: plain cross entropy.
    depth_weight
        Weight of the depth loss.
    depth_loss
        "log": absolute error of the log depth. "squared": squared error in m^2, as published.
    offset_weight
        Weight of the sub-cell offset loss, for networks with these channels.
    spread_weight
        Weight of the loss of the depth uncertainty channel. 0: no such channel.
    class_weight
        Weight of the class loss.
    consistency_weight
        Weight of the consistency loss of images without labels (dmrl train --unlabelled).
    classes
        Classes of robots, each a pattern of peer names: ["cf2", "cf[3-9]"] defines two. Empty: the
        network does not classify.
    """

    confidence_weight: float = 1.0
    focus: float = 2.0
    depth_weight: float = 1.0
    depth_loss: DepthLoss = "log"
    offset_weight: float = 0.5
    spread_weight: float = 0.0
    class_weight: float = 1.0
    consistency_weight: float = 3.0
    classes: tuple[str, ...] = ()


def confidence_loss(
    logit: Tensor, confidence: Tensor, weight: Tensor | None = None, *, focus: float = 2.0
) -> Tensor:
    """Compute the focal cross entropy |c - p|^focus * BCE(p, c); with focus 2, that of the paper.

    Parameters
    ----------
    logit
        (N, rows, cols) confidence logits; p is their sigmoid.
    confidence
        (N, rows, cols) targets c, 0 to 1.
    weight
        (N, rows, cols) weight of each cell. None: 1.
    focus
        Focal exponent: how strongly cells with a small error are down-weighted. 0: plain cross
        entropy.
    """
    entropy = binary_cross_entropy_with_logits(logit, confidence, weight, reduction="none")
    if focus:
        entropy = (confidence - logit.sigmoid()).abs().pow(focus) * entropy
    return entropy.sum(dim=(1, 2)).mean()


def depth_loss(
    log_depth: Tensor, depth_m: Tensor, weight: Tensor, kind: DepthLoss = "squared"
) -> Tensor:
    """Compute the depth error in cells with a robot.

    Parameters
    ----------
    log_depth
        (N, rows, cols) predicted natural log of the depth in metres.
    depth_m
        (N, rows, cols) targets, metres; any value where ``weight`` is 0.
    weight
        (N, rows, cols) weight of each cell.
    kind
        "squared": squared error, m^2, as in the paper. "log": absolute error of the log depth, that
        is, the relative error.
    """
    # Mask first: an extreme log depth in an empty cell must not give inf * 0.
    there = weight > 0
    if kind == "log":
        wanted = torch.where(there, depth_m, 1.0).log()
        error = (log_depth * there - wanted).abs()
    else:
        error = ((log_depth * there).exp() - depth_m).square()
    return (weight * error).sum(dim=(1, 2)).mean()


def offset_loss(predicted: Tensor, offset: Tensor, weight: Tensor) -> Tensor:
    """Compute the absolute error of the sub-cell offset in cells with a robot, in cells.

    Parameters
    ----------
    predicted, offset
        (N, 2, rows, cols), cells.
    weight
        (N, rows, cols) weight of each cell.
    """
    return (weight[:, None] * (predicted - offset).abs()).sum(dim=(1, 2, 3)).mean()


def compute_spread_loss(
    log_spread: Tensor, log_depth: Tensor, depth_m: Tensor, weight: Tensor
) -> Tensor:
    """Compute the negative log likelihood of the log depth error under a Laplace density.

    The constant log 2 is left out. The depth gets no gradient from it: detection is then as good as
    without an uncertainty channel.

    Parameters
    ----------
    log_spread, log_depth
        (N, rows, cols) predictions: log of the scale b of the error, and log of the depth, metres.
    depth_m
        (N, rows, cols) targets, metres; any value where ``weight`` is 0.
    weight
        (N, rows, cols) weight of each cell.
    """
    there = weight > 0
    error = (log_depth.detach() - torch.where(there, depth_m, 1.0).log()).abs() * there
    # Without a lower bound, an exact depth would have an infinitely good loss.
    log_b = log_spread.clamp(min=MIN_LOG_SPREAD)
    return (weight * (error * (-log_b).exp() + log_b)).sum(dim=(1, 2)).mean()


def class_loss(logits: Tensor, class_id: Tensor, weight: Tensor) -> Tensor:
    """Compute the cross entropy of every class in cells with a robot (paper eq. 8).

    Parameters
    ----------
    logits
        (N, classes, rows, cols).
    class_id
        (N, rows, cols) targets; -1 where the class is unknown.
    weight
        (N, rows, cols) weight of each cell.
    """
    known = class_id >= 0
    wanted = one_hot(class_id.clamp(min=0), logits.shape[1]).movedim(3, 1).to(logits.dtype)
    entropy = binary_cross_entropy_with_logits(logits, wanted, reduction="none").sum(dim=1)
    return (weight * known * entropy).sum(dim=(1, 2)).mean()


@dataclass(frozen=True, slots=True)
class LossTerm:
    """One term of the loss.

    Parameters
    ----------
    name
        Name in histories and curves.
    weight
        Field of `LossSettings` with its weight.
    channels
        Channels that it requires; the term is 0 for a network that lacks any of them.
    compute
        Function of outputs, targets and settings that returns the unweighted loss, a scalar.
    """

    name: str
    weight: str
    channels: tuple[str, ...]
    compute: Callable[[OutputChannels, Targets, LossSettings], Tensor]


def _confidence_term(out: OutputChannels, wanted: Targets, settings: LossSettings) -> Tensor:
    weight = wanted.confidence_weight
    return confidence_loss(out["confidence"], wanted.confidence, weight, focus=settings.focus)


def _depth_term(out: OutputChannels, wanted: Targets, settings: LossSettings) -> Tensor:
    return depth_loss(out["log_depth"], wanted.depth_m, wanted.weight, settings.depth_loss)


def _offset_term(out: OutputChannels, wanted: Targets, settings: LossSettings) -> Tensor:
    both = torch.stack((out["offset_u"], out["offset_v"]), dim=1)
    return offset_loss(both, wanted.offset, wanted.offset_weight)


def _compute_spread_term(out: OutputChannels, wanted: Targets, settings: LossSettings) -> Tensor:
    return compute_spread_loss(out[SPREAD_CHANNEL], out["log_depth"], wanted.depth_m, wanted.weight)


def _class_term(out: OutputChannels, wanted: Targets, settings: LossSettings) -> Tensor:
    logits = torch.stack([out[name] for name in out if name.startswith(CLASS_PREFIX)], dim=1)
    return class_loss(logits, wanted.class_id, wanted.weight)


def _consistency_term(out: OutputChannels, wanted: Targets, settings: LossSettings) -> Tensor:
    """Compare pairs of images without labels; see `consistency`."""
    logit, log_depth = out["confidence"], out["log_depth"]
    if wanted.poses is None:
        return logit.new_zeros(())
    offset = wanted.offset
    if "offset_u" in out:
        offset = torch.stack((out["offset_u"], out["offset_v"]), dim=1)
    with torch.no_grad():
        sure = logit.sigmoid()
        probability, support, depth_m = compare(sure, log_depth, offset, wanted.poses)
        weight = sure * support * (support >= MIN_PRESENCE)
    found = confidence_loss(logit, probability, focus=0.0)
    return found + depth_loss(log_depth, depth_m, weight, settings.depth_loss)


TERMS = (
    LossTerm("confidence_loss", "confidence_weight", ("confidence",), _confidence_term),
    LossTerm("depth_loss", "depth_weight", ("log_depth",), _depth_term),
    LossTerm("offset_loss", "offset_weight", ("offset_u", "offset_v"), _offset_term),
    LossTerm("spread_loss", "spread_weight", (SPREAD_CHANNEL, "log_depth"), _compute_spread_term),
    LossTerm("class_loss", "class_weight", (f"{CLASS_PREFIX}0",), _class_term),
    LossTerm(
        "consistency_loss", "consistency_weight", ("confidence", "log_depth"), _consistency_term
    ),
)
"""All terms of the loss; training minimises their weighted sum."""


def compute_loss_terms(out: OutputChannels, wanted: Targets, settings: LossSettings) -> Tensor:
    """Return every weighted term, in the order of ``TERMS``; 0 if its channels are missing."""
    none = out["confidence"].new_zeros(())
    parts = [
        term.compute(out, wanted, settings) if out.keys() >= set(term.channels) else none
        for term in TERMS
    ]
    factors = none.new_tensor([getattr(settings, term.weight) for term in TERMS])
    return torch.stack(parts) * factors
