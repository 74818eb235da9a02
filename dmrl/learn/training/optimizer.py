"""Optimizers: Adam as published, or Muon for the kernels that mix channels."""

from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor, nn

from dmrl.learn.networks.architectures import INPUT_CHANNELS, Network

OptimizerName = Literal["muon", "adam"]

ADAM_EPSILON = 1e-7
"""Denominator term of Adam: the default of Keras, which the paper used."""
MUON_MOMENTUM = 0.95
"""Momentum of Muon, with Nesterov's look-ahead."""
MUON_UPDATE_RMS = 0.2
"""Root mean square of a Muon update over the learning rate. About that of Adam, so that one
learning rate suits both (Liu et al. 2025)."""
NEWTON_SCHULZ_COEFFICIENTS = (3.4445, -4.7750, 2.0315)
"""Coefficients of the quintic iteration."""
NEWTON_SCHULZ_STEPS = 5


def build_optimizer(
    network: Network, name: OptimizerName, weight_decay: float
) -> torch.optim.Optimizer:
    """Build the optimizer of a training.

    Parameters
    ----------
    network
        Network whose parameters it updates.
    name
        "adam", or "muon" for the kernels that mix channels and Adam for the rest.
    weight_decay
        Decoupled weight decay, of kernels only. 0 with "adam": the paper's plain Adam.
    """
    kernels = [p for p in network.parameters() if p.ndim > 1]
    others = [p for p in network.parameters() if p.ndim == 1]
    if name == "muon":
        mixing = _mixing_kernels(network)
        rest = [p for p in kernels if not any(p is q for q in mixing)]
        return Muon(
            [
                {"params": mixing, "weight_decay": weight_decay, "mixing": True},
                {"params": rest, "weight_decay": weight_decay, "mixing": False},
                {"params": others, "weight_decay": 0.0, "mixing": False},
            ]
        )
    if not weight_decay:
        return torch.optim.Adam(network.parameters(), eps=ADAM_EPSILON)
    groups = [
        {"params": kernels, "weight_decay": weight_decay},
        {"params": others, "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, eps=ADAM_EPSILON)


def _mixing_kernels(network: Network) -> list[Tensor]:
    """Return the kernels between hidden layers: no first layer, no depthwise layer, no head."""
    convs = [m for m in network.modules() if isinstance(m, nn.Conv2d)]
    return [
        conv.weight
        for conv in convs[:-1]
        if conv.groups == 1 and conv.in_channels > INPUT_CHANNELS and conv.out_channels > 1
    ]


class Muon(torch.optim.AdamW):
    """Muon (Jordan et al. 2024) for parameter groups that are ``mixing``, AdamW for the others.

    Adam scales every number of a kernel by itself. A kernel that mixes channels is one matrix: Muon
    orthogonalises its momentum, so that all singular values are about 1. Rare directions are then
    learned as fast as common ones.

    ``torch.optim.Muon`` accepts matrices only; these kernels are (out, in, rows, cols).

    Parameters
    ----------
    groups
        As for `torch.optim.AdamW`, each with ``mixing``.
    """

    def __init__(self, groups: list[dict[str, Any]]) -> None:
        super().__init__(groups, eps=ADAM_EPSILON)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Update all parameters once; gradients of the mixing kernels are set to None."""
        for group in self.param_groups:
            if group["mixing"]:
                for kernel in group["params"]:
                    self._update_kernel(kernel, group["lr"], group["weight_decay"])
                    kernel.grad = None  # so that AdamW skips it
        return super().step(closure)

    def _update_kernel(self, kernel: Tensor, learning_rate: float, weight_decay: float) -> None:
        """Apply the Muon update to one kernel."""
        state = self.state[kernel]
        if not state:
            # The key that AdamW requires in every state that it loads.
            state["step"] = torch.tensor(0.0)
            state["momentum"] = torch.zeros_like(kernel)
        assert kernel.grad is not None
        momentum = state["momentum"].lerp_(kernel.grad, 1 - MUON_MOMENTUM)
        ahead = torch.lerp(kernel.grad, momentum, MUON_MOMENTUM).flatten(1)  # Nesterov
        update = orthogonalize(ahead).reshape(kernel.shape)
        kernel.mul_(1 - learning_rate * weight_decay)
        kernel.add_(update, alpha=-learning_rate * MUON_UPDATE_RMS * max(ahead.shape) ** 0.5)


def orthogonalize(matrix: Tensor) -> Tensor:
    """Orthogonalise a matrix: scale all singular values to about 1 (0.7 to 1.2).

    Five steps of a quintic Newton-Schulz iteration need only products, no decomposition.
    """
    tall = matrix.shape[0] > matrix.shape[1]
    x: Tensor = matrix.T if tall else matrix
    x = x / (x.norm() + ADAM_EPSILON)
    a, b, c = NEWTON_SCHULZ_COEFFICIENTS
    for _ in range(NEWTON_SCHULZ_STEPS):
        square = x @ x.T
        x = a * x + (b * square + c * square @ square) @ x
    return x.T if tall else x
