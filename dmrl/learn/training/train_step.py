"""Training step: losses of a batch, backward pass, optimizer update, and the EMA of the weights."""

from copy import deepcopy

import torch
from torch import Tensor

from dmrl.learn.data.batches import Batch
from dmrl.learn.data.targets import build_targets, build_teacher_targets
from dmrl.learn.networks.architectures import Network, normalize_images, unbind_channels
from dmrl.learn.training.config import TrainConfig
from dmrl.learn.training.consistency import LENS
from dmrl.learn.training.distributed import ProcessGroup
from dmrl.learn.training.losses import TERMS, compute_loss_terms

SINGLE_PROCESS = ProcessGroup()
LOSS_NAMES = tuple(term.name for term in TERMS)


def compute_losses(
    network: Network, batch: Batch, settings: TrainConfig, teacher: Network | None = None
) -> Tensor:
    """Compute the weighted losses of a batch, in the order of ``LOSS_NAMES``.

    With a teacher, a fraction ``distill_share`` of each loss is against the teacher's output.
    """
    device = next(network.parameters()).device
    images, robots = (t.to(device, non_blocking=True) for t in batch[:2])
    pixels = normalize_images(images)
    out = _forward(network, pixels, settings)
    wanted = build_targets(
        robots,
        (out.shape[2], out.shape[3]),
        sigma_cells=settings.target_sigma_cells,
        stride_px=network.stride_px,
        label_noise=settings.label_noise,
    )
    if batch.poses is not None:
        poses = batch.poses.to(device, copy=True)
        poses[:, LENS] /= network.stride_px
        nothing = torch.zeros_like(wanted.confidence)
        wanted = wanted._replace(confidence_weight=nothing, poses=poses)
    named = unbind_channels(network.channels, out)
    parts = compute_loss_terms(named, wanted, settings)
    if teacher is None:
        return parts
    with torch.no_grad():
        said = _forward(teacher, pixels, settings)
    targets = build_teacher_targets(teacher.channels, said, wanted)
    taught = compute_loss_terms(named, targets, settings)
    return torch.lerp(parts, taught, settings.distill_share)


def _forward(network: Network, pixels: Tensor, settings: TrainConfig) -> Tensor:
    """Run a network in the configured precision; return (N, C, rows, cols) float32."""
    half = settings.precision == "bfloat16" and computes_bfloat16(pixels.device)
    with torch.autocast(pixels.device.type, torch.bfloat16, enabled=half):
        out: Tensor = network(pixels)
    return out.float()


def computes_bfloat16(device: torch.device) -> bool:
    """Return whether a device computes in bfloat16. CPUs without it take ten times as long."""
    if device.type != "cpu":
        return True
    mkldnn = torch.backends.mkldnn
    return mkldnn.is_available() and bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())  # type: ignore[no-untyped-call]


def train_step(
    network: Network,
    optimizer: torch.optim.Optimizer,
    batch: Batch,
    settings: TrainConfig,
    learning_rate: float,
    group: ProcessGroup = SINGLE_PROCESS,
    share: float = 1.0,
    teacher: Network | None = None,
    unlabelled: Batch | None = None,
) -> Tensor:
    """Take one optimizer step on a batch.

    Parameters
    ----------
    network, optimizer
        Changed in place.
    batch
        Images and labels; this process's part of the batch.
    settings
        Training configuration.
    learning_rate
        Learning rate of this step.
    group
        Processes that train together.
    share
        Weight of ``batch`` in the whole batch. 0: ``batch`` does not contribute.
    teacher
        Network whose output is learned in addition to the labels.
    unlabelled
        Pairs of images without labels, for the consistency loss.

    Returns
    -------
    Tensor
        Losses of the whole batch before the update, in the order of ``LOSS_NAMES``.
    """
    for parameters in optimizer.param_groups:
        parameters["lr"] = learning_rate
    parts = compute_losses(network, batch, settings, teacher)
    if unlabelled is not None:
        parts = parts + compute_losses(network, unlabelled, settings)
    optimizer.zero_grad(set_to_none=True)
    parts.sum().backward()  # type: ignore[no-untyped-call]
    parts = group.all_reduce_mean(network, parts.detach(), share)
    optimizer.step()
    return parts


class WeightEma:
    """Exponential moving average (EMA) of the weights; it varies less than the weights do.

    The time constant is shorter in the first steps, so that the initial weights do not persist.
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
        """Update the average with the network's weights after a step (from 1)."""
        share = max(1 / self._steps, 10 / (9 + step))
        mine, theirs = zip(*self._pairs, strict=True)
        torch._foreach_lerp_(list(mine), list(theirs), min(share, 1.0))
