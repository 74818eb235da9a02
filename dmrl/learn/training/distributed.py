"""Data-parallel training in several processes, started by ``torchrun`` or by dmrl.

Every process computes its part of each batch. Gradients, losses and running statistics of the batch
normalisations are then averaged, so that all processes have the same network after every step.
"""

import multiprocessing
import os
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
from dmrl.terminal.signals import block_ctrl_c

ResultT = TypeVar("ResultT")
GroupWork = Callable[["ProcessGroup"], ResultT]
"""Function that each process of a group calls."""
SPAWN = multiprocessing.get_context("spawn")
CONNECT_TIMEOUT_S = 60.0
"""Timeout for the processes of a group to connect, seconds. All have loaded by then."""
COLLECTIVE_TIMEOUT_S = 1800.0
"""Timeout of collective operations afterwards, seconds: rank 0 also validates and saves."""
EXIT_TIMEOUT_S = 5.0
"""Timeout for a finished or killed process to exit, seconds."""


class ProcessGroup:
    """Processes of a training, and the rank of this one. Single process: rank 0 of 1."""

    def __init__(self, rank: int = 0, size: int = 1) -> None:
        self.rank, self.size = rank, size

    @property
    def is_main(self) -> bool:
        """Whether this is rank 0, the process that writes."""
        return self.rank == 0

    def select_part(self, items: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the items of this process; none if there are more processes than items."""
        return items[self.rank :: self.size]

    def all_reduce_mean(self, network: Network, losses: Tensor, share: float) -> Tensor:
        """Average losses, gradients and running statistics over all processes (all-reduce).

        Parameters
        ----------
        network
            Network with the gradients of this process's part; gradients and statistics change in
            place.
        losses
            (n,) losses of this process's part, changed in place.
        share
            Weight of this process's part in the batch. The weights of all processes sum to 1.

        Returns
        -------
        Tensor
            (n,) losses of the whole batch.
        """
        if self.size == 1:
            return losses
        tensors = [losses, *(_gradient_or_zeros(p) for p in network.parameters())]
        tensors += [b for b in network.buffers() if b.is_floating_point()]
        flat = torch.cat([t.flatten() for t in tensors]).mul_(share)
        distributed.all_reduce(flat)
        means = torch.split(flat, [tensor.numel() for tensor in tensors])
        for tensor, mean in zip(tensors, means, strict=True):
            tensor.copy_(mean.view_as(tensor))
        return losses


def _gradient_or_zeros(parameter: torch.nn.Parameter) -> Tensor:
    """Return the gradient of a parameter; zeros if it has none yet."""
    if parameter.grad is None:
        parameter.grad = torch.zeros_like(parameter)
    return parameter.grad


def run_distributed(processes: int, work: GroupWork[ResultT]) -> ResultT:
    """Call ``work(group)`` in every process of a group and return the result of rank 0.

    Under ``torchrun``, the group is the one of this process. Otherwise this process is rank 0 and
    starts the others on this machine's CPU; they end with it.

    Parameters
    ----------
    processes
        Number of processes. Under ``torchrun``, its number applies instead.
    work
        Function of a module, or a partial of one, so that it can be pickled.

    Raises
    ------
    SettingError
        If another process is killed, or the processes do not connect.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        return _run_under_torchrun(work)
    if processes == 1:
        return work(ProcessGroup())
    threads = torch.get_num_threads()
    torch.set_num_threads(max(threads // processes, 1))
    try:
        with _start_others(processes, work) as meeting:
            return _join_group(meeting, 0, processes, work)
    finally:
        torch.set_num_threads(threads)


def _run_under_torchrun(work: GroupWork[ResultT]) -> ResultT:
    """Run in the group that ``torchrun`` started."""
    cuda = torch.cuda.is_available()
    if cuda:
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
    distributed.init_process_group("nccl" if cuda else "gloo")
    return _run_and_wait(work)


def _join_group(meeting: str, rank: int, size: int, work: GroupWork[ResultT]) -> ResultT:
    """Join a group and run as one of its processes."""
    wait = timedelta(seconds=CONNECT_TIMEOUT_S)
    try:
        distributed.init_process_group("gloo", meeting, timeout=wait, rank=rank, world_size=size)
    except RuntimeError as e:
        _reset_group_count()
        raise SettingError(
            f"the {size} processes did not find each other within {CONNECT_TIMEOUT_S:g} s. "
            "Try again on a less busy machine or with fewer --processes"
        ) from e
    # torch 2.14 made it public.
    set_timeout = getattr(distributed, "set_timeout", distributed.distributed_c10d._set_pg_timeout)
    set_timeout(timedelta(seconds=COLLECTIVE_TIMEOUT_S))
    return _run_and_wait(work)


def _reset_group_count() -> None:
    """Reset torch's count of process groups after a failed start.

    torch names a group by that count, and a failed start leaves it raised. The next group of this
    process would then wait for its peers under a name that they do not use. Only the end of a group
    resets the count, so a group of this process alone is started and ended.
    """
    distributed.init_process_group("gloo", store=HashStore(), rank=0, world_size=1)
    distributed.destroy_process_group()


def _run_and_wait(work: GroupWork[ResultT]) -> ResultT:
    """Run the work and wait for the other processes."""
    try:
        made = work(ProcessGroup(distributed.get_rank(), distributed.get_world_size()))
        # Not after an error: a process that fails alone would wait for those that wait for it.
        distributed.barrier()
        return made
    finally:
        distributed.destroy_process_group()


@contextmanager
def _start_others(size: int, work: GroupWork[Any]) -> Iterator[str]:
    """Start all processes of a group but the first; yield the address where they connect.

    torch's launchers would start the first process as well. Here, progress, errors and Ctrl-C of
    the first process are the same as in a training without a group.
    """
    with tempfile.TemporaryDirectory() as folder:
        meeting = (Path(folder) / "meeting").as_uri()
        started = [_start_process(meeting, rank, size, work) for rank in range(1, size)]
        processes = [process for _, process in started]
        try:
            for ready, _ in started:
                ready.recv()
            yield meeting
            _wait_for(processes, EXIT_TIMEOUT_S)
        except (EOFError, RuntimeError, SettingError) as e:
            # The error here may be the consequence of a killed process, which is then reported. A
            # process that raised has printed its error, or failed because this one did.
            if not _any_killed(processes):
                raise
            raise SettingError(
                f"one of the {size} processes was killed, possibly for lack of memory. "
                "Continue with --resume, or train again with fewer --processes"
            ) from e
        finally:
            for process in processes:
                process.kill()
                process.join()


def _wait_for(processes: Sequence[SpawnProcess], seconds: float) -> None:
    """Wait until all processes have ended, for so many seconds each."""
    for process in processes:
        process.join(seconds)


def _any_killed(processes: Sequence[SpawnProcess]) -> bool:
    """Return whether a signal ended a process; its exit code is then negative."""
    _wait_for(processes, EXIT_TIMEOUT_S / (len(processes) + 1))
    return any((process.exitcode or 0) < 0 for process in processes)


def _start_process(
    meeting: str, rank: int, size: int, work: GroupWork[Any]
) -> tuple[Connection, SpawnProcess]:
    """Start one process and return the connection on which it reports that it has loaded."""
    here, there = SPAWN.Pipe(duplex=False)
    process = SPAWN.Process(
        target=_run_follower, args=(there, meeting, rank, size, work), daemon=True
    )
    with block_ctrl_c():  # rank 0 ends it
        process.start()
    there.close()  # so that the other end detects the end of the process
    return here, process


def _run_follower(
    ready: Connection, meeting: str, rank: int, size: int, work: GroupWork[Any]
) -> None:
    """Run as a process other than rank 0."""
    torch.set_num_threads(max(torch.get_num_threads() // size, 1))
    ready.send(True)
    with suppress(DmrlError):  # rank 0 reports it
        _join_group(meeting, rank, size, work)
