"""Processes that are started here; what they train is in tests/stages/test_train.py."""

import os
import signal
from functools import partial

import pytest
import torch
from torch import distributed

from dmrl.errors import SettingError
from dmrl.learn.group import Group, in_group


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


def test_all_work_and_the_first_returns() -> None:
    threads = torch.get_num_threads()
    assert in_group(3, partial(rank_sum, more=10)) == 13
    assert torch.get_num_threads() == threads
    assert not distributed.is_initialized()


def test_one_that_was_killed_is_one_line() -> None:
    with pytest.raises(SettingError, match=r"one of the 2 processes was killed.*--resume"):
        in_group(2, half_dies)
    assert not distributed.is_initialized()


def test_the_others_end_with_the_first() -> None:
    with pytest.raises(RuntimeError, match="a bug"):
        in_group(2, first_fails)
    assert not distributed.is_initialized()
