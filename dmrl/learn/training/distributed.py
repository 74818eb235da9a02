"""Several processes that train one network: those of ``torchrun``, or started here.

Every process computes its part of each batch; gradients, losses and the running statistics of
the normalisations are then averaged, so that all hold the same network after every step.
"""

import multiprocessing
import os
import signal
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, distributed
from torch._C._distributed_c10d import HashStore

from dmrl.errors import DmrlError, SettingError
from dmrl.learn.networks.architectures import Network

Made = TypeVar("Made")
Work = Callable[["Group"], Made]
"""What each process of a group does."""
SPAWN = multiprocessing.get_context("spawn")
MEETING_S = 60.0
"""How long the processes of a group may take to find each other. All have loaded by then."""
WORK_S = 1800.0
"""How long one may wait for the others afterwards: the first also validates and saves."""
LAST_WORDS_S = 5.0
"""How long a process that is done, or killed, may take to be gone."""


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


def in_group(processes: int, work: Work[Made]) -> Made:
    """What ``work(group)`` returns in the process that leads a group.

    Under ``torchrun`` the group is the one that this process was put in. Else this process leads,
    and starts the others on this machine's CPU; they end with it.

    Parameters
    ----------
    processes
        How many, where ``torchrun`` does not say.
    work
        A function of a module, or a part of one: fit to be pickled.

    Raises
    ------
    SettingError
        If one of the others is killed, or the processes do not find each other.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        return _by_torchrun(work)
    if processes == 1:
        return work(Group())
    threads = torch.get_num_threads()
    torch.set_num_threads(max(threads // processes, 1))
    try:
        with _others(processes, work) as meeting:
            return _member(meeting, 0, processes, work)
    finally:
        torch.set_num_threads(threads)


def _by_torchrun(work: Work[Made]) -> Made:
    cuda = torch.cuda.is_available()
    if cuda:
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
    distributed.init_process_group("nccl" if cuda else "gloo")
    return _until_all_are_done(work)


def _member(meeting: str, rank: int, size: int, work: Work[Made]) -> Made:
    wait = timedelta(seconds=MEETING_S)
    try:
        distributed.init_process_group("gloo", meeting, timeout=wait, rank=rank, world_size=size)
    except RuntimeError as e:
        _forget_failed_start()
        raise SettingError(
            f"the {size} processes did not find each other within {MEETING_S:g} s. "
            "Begin again, on a less busy machine or with fewer --processes"
        ) from e
    distributed.distributed_c10d._set_pg_timeout(timedelta(seconds=WORK_S))
    return _until_all_are_done(work)


def _forget_failed_start() -> None:
    """Make torch count its groups from 0 again.

    It names a group by that count, and a failed start leaves it raised: the next group of this
    process would look for its peers under a name that they do not have. Only the end of a group
    sets it back, so one of this process alone is begun and ended.
    """
    distributed.init_process_group("gloo", store=HashStore(), rank=0, world_size=1)
    distributed.destroy_process_group()


def _until_all_are_done(work: Work[Made]) -> Made:
    try:
        made = work(Group(distributed.get_rank(), distributed.get_world_size()))
        # Not after an error: whoever fails alone would wait for those who wait for it.
        distributed.barrier()
        return made
    finally:
        distributed.destroy_process_group()


@contextmanager
def _others(size: int, work: Work[Any]) -> Iterator[str]:
    """Where the group meets; all but the first of its processes run meanwhile.

    torch's launchers would start the first as well; here, its progress, its errors and Ctrl-C are
    those of a training alone.
    """
    with tempfile.TemporaryDirectory() as folder:
        meeting = (Path(folder) / "meeting").as_uri()
        started = [_start(meeting, rank, size, work) for rank in range(1, size)]
        processes = [process for _, process in started]
        try:
            for ready, _ in started:
                ready.recv()
            yield meeting
            _wait_for(processes, LAST_WORDS_S)
        except (EOFError, RuntimeError, SettingError) as e:
            # What was seen here may come of one that is gone: then that is what is said. One that
            # raised has said so itself, or fails because this one did.
            if not _any_killed(processes):
                raise
            raise SettingError(
                f"one of the {size} processes was killed, for want of memory perhaps. "
                "Go on with --resume, or begin again with fewer --processes"
            ) from e
        finally:
            for process in processes:
                process.kill()
                process.join()


def _wait_for(processes: Sequence[SpawnProcess], seconds: float) -> None:
    """Until all have ended, each for so long."""
    for process in processes:
        process.join(seconds)


def _any_killed(processes: Sequence[SpawnProcess]) -> bool:
    """Whether a signal ended one: only then is its exit code negative."""
    _wait_for(processes, LAST_WORDS_S / (len(processes) + 1))
    return any((process.exitcode or 0) < 0 for process in processes)


def _start(meeting: str, rank: int, size: int, work: Work[Any]) -> tuple[Connection, SpawnProcess]:
    here, there = SPAWN.Pipe(duplex=False)
    process = SPAWN.Process(target=_follow, args=(there, meeting, rank, size, work), daemon=True)
    process.start()
    there.close()  # so that the other end knows if the process is gone
    return here, process


def _follow(ready: Connection, meeting: str, rank: int, size: int, work: Work[Any]) -> None:
    """What a process does that does not lead."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the one that leads ends it
    torch.set_num_threads(max(torch.get_num_threads() // size, 1))
    ready.send(True)
    with suppress(DmrlError):  # the one that leads says so
        _member(meeting, rank, size, work)
