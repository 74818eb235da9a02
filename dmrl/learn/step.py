"""One step of a training: losses of a batch, optimizer, and the average of the weights."""

from copy import deepcopy

import torch
from torch import Tensor

from dmrl.learn.batches import Batch
from dmrl.learn.group import Group
from dmrl.learn.losses import confidence_loss, depth_loss, offset_loss
from dmrl.learn.network import SUB_CELL, Network, to_input
from dmrl.learn.settings import FitSettings
from dmrl.learn.targets import targets

ADAM_EPSILON = 1e-7  # Keras' default, with which the paper trained
ALONE = Group()
LOSSES = ("confidence_loss", "depth_loss", "offset_loss")


def losses(network: Network, batch: Batch, settings: FitSettings) -> Tensor:
    """(3,) weighted confidence, depth and offset loss of a batch."""
    device = next(network.parameters()).device
    images, robots = (t.to(device, non_blocking=True) for t in batch)
    half = settings.precision == "bfloat16"
    with torch.autocast(device.type, torch.bfloat16, enabled=half):
        out = network(to_input(images))
    out = out.float()
    wanted = targets(
        robots,
        (out.shape[2], out.shape[3]),
        sigma_cells=settings.target_sigma_cells,
        stride_px=network.stride_px,
        label_noise=settings.label_noise,
    )
    confidence = confidence_loss(
        out[:, 1], wanted.confidence, wanted.confidence_weight, focus=settings.focus
    )
    depth = depth_loss(out[:, 0], wanted.depth_m, wanted.weight, settings.depth_loss)
    offset = out.new_zeros(())
    if network.channels == SUB_CELL:
        offset = offset_loss(out[:, 2:4], wanted.offset, wanted.offset_weight)
    weights = (settings.confidence_weight, settings.depth_weight, settings.offset_weight)
    parts: Tensor = torch.stack((confidence, depth, offset)) * out.new_tensor(weights)
    return parts


def new_optimizer(network: Network, settings: FitSettings) -> torch.optim.Optimizer:
    """Adam as published; with a weight decay, AdamW that leaves biases and norms alone."""
    if not settings.weight_decay:
        return torch.optim.Adam(network.parameters(), eps=ADAM_EPSILON)
    kernels = [p for p in network.parameters() if p.ndim > 1]
    others = [p for p in network.parameters() if p.ndim == 1]
    groups = [
        {"params": kernels, "weight_decay": settings.weight_decay},
        {"params": others, "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, eps=ADAM_EPSILON)


def train_step(
    network: Network,
    optimizer: torch.optim.Optimizer,
    batch: Batch,
    settings: FitSettings,
    learning_rate: float,
    group: Group = ALONE,
    share: float = 1.0,
) -> Tensor:
    """(3,) losses of a batch, after one step of the optimizer on their sum.

    Parameters
    ----------
    network, optimizer
        Changed in place.
    batch
        Images and robots; this process' part of the batch.
    settings
        The recipe.
    learning_rate
        Of this step.
    group
        The processes that train together.
    share
        Share of the whole batch that ``batch`` is. 0: of ``batch`` nothing is learnt.
    """
    for parameters in optimizer.param_groups:
        parameters["lr"] = learning_rate
    parts = losses(network, batch, settings)
    optimizer.zero_grad(set_to_none=True)
    parts.sum().backward()  # type: ignore[no-untyped-call]
    parts = group.average(network, parts.detach(), share)
    optimizer.step()
    return parts


class Average:
    """The mean of the weights over the last steps: steadier than the weights of any one.

    Young averages forget faster, so that the first weights do not linger.
    """

    def __init__(self, network: Network, steps: int) -> None:
        self.network = deepcopy(network).eval().requires_grad_(False)
        self._steps = steps
        self._pairs = [
            (mine, theirs)
            for mine, theirs in zip(
                self.network.state_dict().values(), network.state_dict().values(), strict=True
            )
            if mine.is_floating_point()
        ]

    def update(self, step: int) -> None:
        """Take in the network's weights after a step (from 1)."""
        share = max(1 / self._steps, 10 / (9 + step))
        mine, theirs = zip(*self._pairs, strict=True)
        torch._foreach_lerp_(list(mine), list(theirs), min(share, 1.0))
