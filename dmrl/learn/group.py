"""Several processes that train one network, as ``torchrun`` starts them.

Every process computes its part of each batch; gradients, losses and the running statistics of
the normalisations are then averaged, so that all hold the same network after every step.
"""

import os

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, distributed

from dmrl.learn.network import Network


class Group:
    """The processes of a training, and which of them this is. Alone: rank 0 of 1."""

    def __init__(self, rank: int = 0, size: int = 1) -> None:
        self.rank, self.size = rank, size

    @property
    def leads(self) -> bool:
        """Whether this is the process that writes."""
        return self.rank == 0

    def part(self, items: NDArray[np.int64]) -> NDArray[np.int64]:
        """The items of this process; none where there are more processes than items."""
        return items[self.rank :: self.size]

    def average(self, network: Network, losses: Tensor, share: float) -> Tensor:
        """Losses of the whole batch; the network's gradients and statistics become its own.

        Parameters
        ----------
        network
            With the gradients of this process' part.
        losses
            (n,) losses of this process' part.
        share
            Share of the batch that this process had. The shares of all add up to 1.
        """
        if self.size == 1:
            return losses
        tensors = [losses, *(_gradient(p) for p in network.parameters())]
        tensors += [b for b in network.buffers() if b.is_floating_point()]
        flat = torch.cat([t.flatten() for t in tensors]).mul_(share)
        distributed.all_reduce(flat)
        means = torch.split(flat, [tensor.numel() for tensor in tensors])
        for tensor, mean in zip(tensors, means, strict=True):
            tensor.copy_(mean.view_as(tensor))
        return losses


def _gradient(parameter: torch.nn.Parameter) -> Tensor:
    if parameter.grad is None:
        parameter.grad = torch.zeros_like(parameter)
    return parameter.grad


def join_group() -> Group:
    """The group that ``torchrun`` put this process in, or one of this process alone."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return Group()
    if not distributed.is_initialized():
        cuda = torch.cuda.is_available()
        if cuda:
            torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
        distributed.init_process_group("nccl" if cuda else "gloo")
    return Group(distributed.get_rank(), distributed.get_world_size())


def leave_group() -> None:
    """Undo ``join_group``."""
    if distributed.is_available() and distributed.is_initialized():
        distributed.barrier()
        distributed.destroy_process_group()
