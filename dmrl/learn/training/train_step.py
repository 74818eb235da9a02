"""One step of a training: losses of a batch, and the average of the weights."""

from copy import deepcopy

import torch
from torch import Tensor

from dmrl.learn.data.batches import Batch
from dmrl.learn.data.targets import as_targets, targets
from dmrl.learn.networks.architectures import Network, by_name, to_input
from dmrl.learn.training.config import FitSettings
from dmrl.learn.training.distributed import Group
from dmrl.learn.training.losses import TERMS, weighted

ALONE = Group()
LOSSES = tuple(term.name for term in TERMS)


def losses(
    network: Network, batch: Batch, settings: FitSettings, teacher: Network | None = None
) -> Tensor:
    """The weighted losses of a batch, in the order of ``LOSSES``.

    With a teacher, a share of them is against what it says in place of the labels.
    """
    device = next(network.parameters()).device
    images, robots = (t.to(device, non_blocking=True) for t in batch)
    pixels = to_input(images)
    out = _output(network, pixels, settings)
    wanted = targets(
        robots,
        (out.shape[2], out.shape[3]),
        sigma_cells=settings.target_sigma_cells,
        stride_px=network.stride_px,
        label_noise=settings.label_noise,
    )
    named = by_name(network.channels, out)
    parts = weighted(named, wanted, settings)
    if teacher is None:
        return parts
    with torch.no_grad():
        said = _output(teacher, pixels, settings)
    taught = weighted(named, as_targets(teacher.channels, said, wanted), settings)
    return torch.lerp(parts, taught, settings.distill_share)


def _output(network: Network, pixels: Tensor, settings: FitSettings) -> Tensor:
    """(N, C, rows, cols) float32."""
    half = settings.precision == "bfloat16"
    with torch.autocast(pixels.device.type, torch.bfloat16, enabled=half):
        out: Tensor = network(pixels)
    return out.float()


def train_step(
    network: Network,
    optimizer: torch.optim.Optimizer,
    batch: Batch,
    settings: FitSettings,
    learning_rate: float,
    group: Group = ALONE,
    share: float = 1.0,
    teacher: Network | None = None,
) -> Tensor:
    """Losses of a batch in the order of ``LOSSES``, after one step of the optimizer on their sum.

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
    teacher
        A network whose output is learnt beside the labels.
    """
    for parameters in optimizer.param_groups:
        parameters["lr"] = learning_rate
    parts = losses(network, batch, settings, teacher)
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
