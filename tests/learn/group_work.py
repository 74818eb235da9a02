"""What processes of a group do in test_group.py: they find it by this module's name."""

import os
import signal

import torch
from torch import distributed

from dmrl.learn.training.distributed import ProcessGroup


def rank_sum(group: ProcessGroup, more: int) -> int:
    """Sum of the ranks, and some more."""
    ranks = torch.tensor([group.rank])
    distributed.all_reduce(ranks)
    return int(ranks) + more


def half_dies(group: ProcessGroup) -> None:
    """All but the first go, without a word."""
    if not group.is_main:
        os.kill(os.getpid(), signal.SIGKILL)
    distributed.all_reduce(torch.zeros(1))


def first_fails(group: ProcessGroup) -> None:
    """The first raises, while the others wait for it."""
    if group.is_main:
        raise RuntimeError("a bug")
    distributed.all_reduce(torch.zeros(1))
