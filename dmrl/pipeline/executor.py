"""Executors of tasks: processes of this machine, or a cluster."""

from concurrent.futures import Future
from typing import Protocol, Self

from dmrl.errors import SettingError
from dmrl.pipeline.job import JobResult
from dmrl.pipeline.process_pool import ProcessPool
from dmrl.terminal.progress import Lines

RAY = "ray"


class Executor(Protocol):
    """An executor of tasks.

    Attributes
    ----------
    workers
        Most tasks at a time.
    exclusive_blocks
        Whether an exclusive task keeps all others from running.
    """

    workers: int
    exclusive_blocks: bool

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def list_nodes(self) -> Lines:
        """Return a table of the machines, its head first; empty: it is this one alone."""

    def submit(self, job: str, *, exclusive: bool) -> Future[JobResult]:
        """Submit a job; return the future of its result."""


def open_executor(on: str | None, workers: int | None, *, bars: bool = False) -> Executor:
    """Open the executor that ``--on`` names.

    Parameters
    ----------
    on
        None: processes here. ``ray`` or ``ray://HOST:PORT``: a Ray cluster.
    workers
        Processes here, at most. None: as many as there are cores.
    bars
        See `ProcessPool`.

    Raises
    ------
    SettingError
        If ``on`` is another.
    ClusterError
        If no cluster answers, or its nodes are of another version.
    MissingExtra
        If Ray is not installed.
    """
    if on is None:
        return ProcessPool(workers, bars=bars)
    if workers is not None:
        raise SettingError("--workers are processes of this machine. Leave out --workers, or --on")
    scheme, _, address = on.partition("://")
    if scheme != RAY or (address == "" and on != RAY):
        raise SettingError(f"--on {on}: this takes ray, or ray://HOST:PORT")
    from dmrl.pipeline.cluster.ray_executor import RayExecutor  # noqa: PLC0415 - an extra

    return RayExecutor(address)
