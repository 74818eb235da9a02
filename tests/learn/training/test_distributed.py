"""Groups of processes; tests/stages/test_train.py tests a training in them."""

import importlib
import multiprocessing
from functools import partial
from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch import distributed

from dmrl.errors import SettingError
from dmrl.learn.training import distributed as group
from dmrl.learn.training.distributed import ProcessGroup, run_distributed


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return the module of functions that the processes import.

    Processes are forked from one that has loaded torch, because each would take seconds to.
    """
    monkeypatch.syspath_prepend(Path(__file__).parents[1])
    forked = multiprocessing.get_context("forkserver")
    forked.set_forkserver_preload(["dmrl.learn.training.distributed"])
    monkeypatch.setattr(group, "SPAWN", forked)
    return importlib.import_module("group_work")


@pytest.mark.heavy
def test_all_processes_run_and_rank_0_returns(work: ModuleType) -> None:
    threads = torch.get_num_threads()
    assert run_distributed(2, partial(work.sum_ranks, more=10)) == 11
    assert torch.get_num_threads() == threads
    assert not distributed.is_initialized()


def test_killed_process_gives_one_line_error(work: ModuleType) -> None:
    with pytest.raises(SettingError, match=r"one of the 2 processes was killed.*--resume"):
        run_distributed(2, work.kill_others)
    assert not distributed.is_initialized()


def test_failure_of_rank_0_ends_the_other_processes(work: ModuleType) -> None:
    with pytest.raises(RuntimeError, match="a bug"):
        run_distributed(2, work.fail_first)
    assert not distributed.is_initialized()


def test_processes_start_after_a_start_that_failed(
    work: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as short:
        short.setattr(group, "CONNECT_TIMEOUT_S", 0.1)
        with pytest.raises(SettingError, match=r"the 2 processes did not find each other.*0\.1 s"):
            group._join_group((tmp_path / "meeting").as_uri(), 0, 2, group.ProcessGroup)
    assert not distributed.is_initialized()
    assert run_distributed(2, partial(work.sum_ranks, more=0)) == 1


def test_collective_timeout_is_longer_than_the_join_timeout(tmp_path: Path) -> None:
    def patience(_: ProcessGroup) -> float:
        found = distributed.distributed_c10d._get_default_group()
        backend = found._get_backend(torch.device("cpu"))
        return float(backend.options._timeout.total_seconds())

    assert (
        group._join_group((tmp_path / "meeting").as_uri(), 0, 1, patience)
        == group.COLLECTIVE_TIMEOUT_S
    )
