"""Functions that the process group of training/test_distributed.py runs, found by this name."""

import os
import signal

import torch
from torch import distributed

from dmrl.learn.training.distributed import ProcessGroup


def sum_ranks(group: ProcessGroup, more: int) -> int:
    """Return the sum of the ranks of all processes, plus a number."""
    ranks = torch.tensor([group.rank])
    distributed.all_reduce(ranks)
    return int(ranks) + more


def kill_others(group: ProcessGroup) -> None:
    """Kill every process but the first, so that the first waits for dead ones."""
    if not group.is_main:
        os.kill(os.getpid(), signal.SIGKILL)
    distributed.all_reduce(torch.zeros(1))


def fail_first(group: ProcessGroup) -> None:
    """Raise an error in the first process, while the others wait for it."""
    if group.is_main:
        raise RuntimeError("a bug")
    distributed.all_reduce(torch.zeros(1))
