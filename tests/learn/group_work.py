"""What processes of a group do in test_group.py: they find it by this module's name."""

import os
import signal

import torch
from torch import distributed

from dmrl.learn.training.distributed import Group


def rank_sum(group: Group, more: int) -> int:
    """Sum of the ranks, and some more."""
    ranks = torch.tensor([group.rank])
    distributed.all_reduce(ranks)
    return int(ranks) + more


def half_dies(group: Group) -> None:
    """All but the first go, without a word."""
    if not group.leads:
        os.kill(os.getpid(), signal.SIGKILL)
    distributed.all_reduce(torch.zeros(1))


def first_fails(group: Group) -> None:
    """The first raises, while the others wait for it."""
    if group.leads:
        raise RuntimeError("a bug")
    distributed.all_reduce(torch.zeros(1))
