"""Processes that steps run in, side by side; each step has one for itself."""

import json
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from types import TracebackType
from typing import Self

from dmrl.pipeline.job import Answer, failed
from dmrl.terminal.progress import Lines

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""A step has one core, however many run: so its sums, and its bytes, are always the same."""
START = "from dmrl.pipeline.job_worker import main; main()"
NO_BARS = {"TTY_COMPATIBLE": "0"}
"""Bars of several processes would overwrite each other."""
LAST_WORDS_S = 20.0
"""How long a process that is told to end may tidy up."""


class Crew:
    """Processes for as many steps at a time as there are workers.

    Parameters
    ----------
    workers
        Steps at a time, at most. None: as many as there are cores.
    bars
        Whether a single worker shows its own progress.
    """

    def __init__(self, workers: int | None = None, *, bars: bool = True) -> None:
        self.workers = workers = workers or cores()
        self.alone_blocks = True
        self._bars = bars and workers == 1
        self._threads = ThreadPoolExecutor(workers)
        self._idle: list[Process] = []
        self._all: list[Process] = []
        self._lock = threading.Lock()
        self._over = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._lock:
            self._over, self._idle, found = True, [], self._all
        end(found, in_order=kind is not None)
        self._threads.shutdown()

    def nodes(self) -> Lines:
        """No table: it is this machine alone."""
        return ()

    def give(self, job: str, *, alone: bool) -> Future[Answer]:
        """The answer to a job, once it is there.

        Parameters
        ----------
        job
            As `work.job` made it.
        alone
            Nothing else will run meanwhile: it may use all cores.
        """
        return self._threads.submit(self._answer, job, alone=alone)

    def _answer(self, job: str, *, alone: bool) -> Answer:
        process = None
        with self._lock:
            if self._idle and not alone:
                process = self._idle.pop()
        if process is None:
            process = self._new(environment(alone=alone, bars=self._bars))
        answer = process.answer(job)
        with self._lock:
            if self._over:
                return answer
            if not (failed(answer) or alone):
                self._idle.append(process)  # one that failed may hold what it should not
                return answer
            self._all.remove(process)
        end([process], in_order=False)
        return answer

    def _new(self, environment: dict[str, str]) -> "Process":
        with self._lock:
            if self._over:
                raise RuntimeError("no step begins any more")
            process = Process(environment)
            self._all.append(process)
            return process


class Process:
    """A process that does jobs, one after the other.

    Parameters
    ----------
    environment
        Of the process.
    folder
        That names are relative to. None: this one.
    """

    ready = False

    def __init__(self, environment: dict[str, str], folder: str | None = None) -> None:
        # A group of its own: Ctrl-C reaches us alone, and we end what the stage has started.
        self.popen = subprocess.Popen(
            [sys.executable, "-P", "-c", START],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            cwd=folder,
            text=True,
            encoding="utf-8",
            start_new_session=True,
        )

    def answer(self, job: str) -> Answer:
        """What became of a job; that the process died is one of the answers."""
        assert self.popen.stdin is not None and self.popen.stdout is not None
        line = ""
        with suppress(BrokenPipeError):
            self.popen.stdin.write(job + "\n")
            self.popen.stdin.flush()
            self.ready = self.ready or bool(self.popen.stdout.readline())
            line = self.popen.stdout.readline()
        if line:
            answer: Answer = json.loads(line)
            return answer
        number = self.popen.wait()
        how = f"was killed (signal {-number})" if number < 0 else f"ended with status {number}"
        words = f"its process {how}, for want of memory perhaps. Try fewer --workers"
        return {"error": words, "again": "elsewhere"}


def environment(*, alone: bool, bars: bool = False) -> dict[str, str]:
    """What a process that does jobs is given: threads for one core, unless it is to be alone."""
    return os.environ | ({} if alone else ONE_THREAD | ({} if bars else NO_BARS))


def end(processes: list[Process], *, in_order: bool) -> None:
    """End processes; in order, so that stages tidy up, or at once, where they do nothing."""
    told = [process for process in processes if in_order and process.ready]
    for process in told:
        process.popen.send_signal(signal.SIGINT)
    for process in processes:
        if process in told:
            with suppress(subprocess.TimeoutExpired):
                process.popen.wait(LAST_WORDS_S)
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.popen.pid, signal.SIGKILL)
        process.popen.wait()
        for stream in (process.popen.stdin, process.popen.stdout):
            if stream is not None:
                with suppress(BrokenPipeError):
                    stream.close()


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
