"""Pool of worker processes; each step runs in one of its own."""

import json
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Self

from dmrl.guards.posix import count_cores
from dmrl.pipeline.job import JobResult
from dmrl.terminal.progress import Lines

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Each step has one core, however many run, so its sums and bytes are always the same."""
WORKER_CODE = "from dmrl.pipeline.job_worker import main; main()"
NO_BARS = {"TTY_COMPATIBLE": "0"}
"""Bars of several processes would overwrite each other."""
TERMINATE_TIMEOUT_S = 20.0
"""Time that a process has to clean up before it is killed, seconds."""


class ProcessPool:
    """A pool of worker processes.

    Parameters
    ----------
    workers
        Steps at a time, at most. None: as many as there are cores.
    bars
        Whether a single worker shows its own progress.
    """

    def __init__(self, workers: int | None = None, *, bars: bool = True) -> None:
        self.workers = workers = workers or count_cores()
        self.exclusive_blocks = True
        self._bars = bars and workers == 1
        self._threads = ThreadPoolExecutor(workers)
        self._idle: list[WorkerProcess] = []
        self._all: list[WorkerProcess] = []
        self._lock = threading.Lock()
        self._over = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object = None, *_: object) -> None:
        with self._lock:
            self._over, self._idle, found = True, [], self._all
        stop_processes(found, in_order=kind is not None)
        self._threads.shutdown()

    def list_nodes(self) -> Lines:
        """Return no table: it is this machine alone."""
        return ()

    def submit(self, job: str, *, exclusive: bool) -> Future[JobResult]:
        """Submit a job; return the future of its result.

        Parameters
        ----------
        job
            Line of `dmrl.pipeline.job.build_job`.
        exclusive
            Whether nothing else runs meanwhile, so that it may use all cores.
        """
        return self._threads.submit(self._run_job, job, exclusive=exclusive)

    def _run_job(self, job: str, *, exclusive: bool) -> JobResult:
        process = None
        with self._lock:
            if self._idle and not exclusive:
                process = self._idle.pop()
        if process is None:
            process = self._start_process(worker_environment(exclusive=exclusive, bars=self._bars))
        answer = process.run_job(job)
        with self._lock:
            if self._over:
                return answer
            if not (exclusive or "bug" in answer or "retry" in answer):
                self._idle.append(process)  # after a bug or for lack of memory it may be damaged
                return answer
            self._all.remove(process)
        stop_processes([process], in_order=False)
        return answer

    def _start_process(self, environment: dict[str, str]) -> "WorkerProcess":
        with self._lock:
            if self._over:
                raise RuntimeError("no step begins any more")
            process = WorkerProcess(environment)
            self._all.append(process)
            return process


class WorkerProcess:
    """A process that runs jobs, one after the other.

    Parameters
    ----------
    environment
        Environment of the process.
    folder
        Folder that relative names start from. None: the current one.
    """

    ready = False

    def __init__(self, environment: dict[str, str], folder: str | None = None) -> None:
        # A group of its own: Ctrl-C reaches the parent, which ends all that the stage started.
        self.popen = subprocess.Popen(
            [sys.executable, "-P", "-c", WORKER_CODE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            cwd=folder,
            text=True,
            encoding="utf-8",
            start_new_session=True,
        )

    def run_job(self, job: str) -> JobResult:
        """Run a job and return its result; a process that died is an error."""
        assert self.popen.stdin is not None and self.popen.stdout is not None
        line = ""
        with suppress(BrokenPipeError):
            self.popen.stdin.write(job + "\n")
            self.popen.stdin.flush()
            self.ready = self.ready or bool(self.popen.stdout.readline())
            line = self.popen.stdout.readline()
        if line:
            answer: JobResult = json.loads(line)
            return answer
        number = self.popen.wait()
        how = f"was killed (signal {-number})" if number < 0 else f"ended with status {number}"
        words = f"its process {how}, for lack of memory perhaps. Try fewer --workers"
        return {"error": words, "retry": "elsewhere"}


def worker_environment(*, exclusive: bool, bars: bool = False) -> dict[str, str]:
    """Return the environment of a worker: threads for one core, unless it is exclusive."""
    return os.environ | ({} if exclusive else ONE_THREAD | ({} if bars else NO_BARS))


def stop_processes(processes: list[WorkerProcess], *, in_order: bool) -> None:
    """Stop processes; in order, so that stages clean up, or at once, if they are idle."""
    told = [process for process in processes if in_order and process.ready]
    for process in told:
        process.popen.send_signal(signal.SIGINT)
    for process in processes:
        if process in told:
            with suppress(subprocess.TimeoutExpired):
                process.popen.wait(TERMINATE_TIMEOUT_S)
        with suppress(ProcessLookupError, PermissionError):
            if hasattr(os, "killpg"):
                os.killpg(process.popen.pid, signal.SIGKILL)
            else:  # Windows: what the process has started goes on
                process.popen.kill()
        process.popen.wait()
        for stream in (process.popen.stdin, process.popen.stdout):
            if stream is not None:
                with suppress(BrokenPipeError):
                    stream.close()
