"""Processes that are started here; what they train is in tests/stages/test_train.py."""

import importlib
from functools import partial
from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch import distributed

from dmrl.errors import SettingError
from dmrl.learn.group import in_group


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Functions that another process can import."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    return importlib.import_module("group_work")


def test_all_work_and_the_first_returns(work: ModuleType) -> None:
    threads = torch.get_num_threads()
    assert in_group(3, partial(work.rank_sum, more=10)) == 13
    assert torch.get_num_threads() == threads
    assert not distributed.is_initialized()


def test_one_that_was_killed_is_one_line(work: ModuleType) -> None:
    with pytest.raises(SettingError, match=r"one of the 2 processes was killed.*--resume"):
        in_group(2, work.half_dies)
    assert not distributed.is_initialized()


def test_the_others_end_with_the_first(work: ModuleType) -> None:
    with pytest.raises(RuntimeError, match="a bug"):
        in_group(2, work.first_fails)
    assert not distributed.is_initialized()
