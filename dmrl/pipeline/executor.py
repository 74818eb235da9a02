"""Who does the tasks of a plan: processes of this machine, or a cluster."""

from concurrent.futures import Future
from types import TracebackType
from typing import Protocol, Self

from dmrl.errors import SettingError
from dmrl.pipeline.job import Answer
from dmrl.pipeline.process_pool import Crew
from dmrl.terminal.progress import Lines

RAY, SLURM = "ray", "slurm"


class Executor(Protocol):
    """Who does tasks.

    Attributes
    ----------
    workers
        Tasks at a time.
    alone_blocks
        Whether nothing else can be done beside a task that is alone.
    """

    workers: int
    alone_blocks: bool

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...

    def nodes(self) -> Lines:
        """A table of the machines that do tasks, its head first; empty: it is this one alone."""

    def give(self, job: str, *, alone: bool) -> Future[Answer]:
        """The answer to a job, once it is there."""


def executor(on: str | None, workers: int | None, *, bars: bool = False) -> Executor:
    """Who does tasks, as ``--on`` says.

    Parameters
    ----------
    on
        None: processes here. ``ray`` or ``ray://HOST:PORT``: a Ray cluster.
    workers
        Processes here, at most. None: as many as there are cores.
    bars
        See `Crew`.

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
        return Crew(workers, bars=bars)
    if workers is not None:
        raise SettingError("--workers are of this machine. Leave out --workers, or --on")
    scheme, _, address = on.partition("://")
    if scheme != RAY or (address == "" and on != RAY):
        raise SettingError(f"--on {on}: this takes ray, or ray://HOST:PORT")
    from dmrl.pipeline.cluster.ray_executor import Ray  # noqa: PLC0415 - an extra

    return Ray(address)
