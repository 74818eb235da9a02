"""Pool of Blender worker processes, which are replaced when they exit."""

import os
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Self, TypeVar

from dmrl.errors import BlenderError
from dmrl.geometry.frames import Array
from dmrl.rendering.blender.protocol import Arrays, receive, send

WORKER_SCRIPT = Path(__file__).parent / "blender" / "worker.py"
MAX_TRIES = 3
MAX_QUEUED_JOBS = 4
"""Jobs in progress or waiting for the caller, per worker."""

Task = TypeVar("Task")
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class WorkerStart:
    """First message to a worker.

    Parameters
    ----------
    python
        Python of Blender's environment.
    head, arrays
        The model, the panoramas and the quality.
    """

    python: Path
    head: dict[str, Any]
    arrays: Arrays = field(default_factory=dict)


def _build_environment(python: Path) -> dict[str, str]:
    """Return the environment variables of a worker.

    It is another Python: variables for this one would hide its modules. Blender keeps caches of
    extensions and thumbnails, by default among the user's.
    """
    kept = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    own = str(python.parent.parent / "user")
    return kept | {"BLENDER_USER_RESOURCES": own, "XDG_CACHE_HOME": own}


class Worker:
    """A Blender process with one robot in its scene.

    Parameters
    ----------
    start
        First message.

    Raises
    ------
    BlenderError
        If the process does not start, or cannot use the model. Contains the reason.
    """

    def __init__(self, start: WorkerStart) -> None:
        self._process = subprocess.Popen(
            [str(start.python), str(WORKER_SCRIPT)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=_build_environment(start.python),
        )
        self._last_words: deque[bytes] = deque(maxlen=20)
        self._listener = threading.Thread(target=self._collect_errors, daemon=True)
        self._listener.start()
        try:
            self.version, self.points = self._send_start(start)
        except (EOFError, OSError) as e:
            self.close()
            raise BlenderError(
                f"Blender did not start: {self.failure_reason()}. {SETUP_HINT}"
            ) from e

    def _send_start(self, start: WorkerStart) -> tuple[str, Array]:
        head, arrays = self.request(start.head, start.arrays)
        if "error" in head:
            self.close()
            raise BlenderError(head["error"])
        return head["version"], arrays["points"].astype(float)

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def request(self, head: dict[str, Any], arrays: Arrays | None = None) -> tuple[Any, Arrays]:
        """Send a request and return the reply.

        Raises
        ------
        EOFError, OSError
            If the process has exited.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        send(self._process.stdin, head, arrays)
        return receive(self._process.stdout)

    def _collect_errors(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            if line.strip():
                self._last_words.append(line)

    def failure_reason(self) -> str:
        """Return its last line on standard error, or its exit status."""
        words = self._last_words[-1].decode(errors="replace").strip() if self._last_words else ""
        return words or f"exit {self._process.poll()}"

    def close(self) -> None:
        """Stop the process."""
        self._process.kill()
        self._process.wait()
        self._listener.join()
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            if stream is not None:
                try:
                    stream.close()
                except BrokenPipeError:  # unread requests do not matter any more
                    continue


SETUP_HINT = "Try: dmrl render --setup"


class WorkerPool:
    """Workers that run jobs as they become free. Results keep the order of the tasks.

    Parameters
    ----------
    start
        First message to every worker.
    count
        Number of workers.

    Raises
    ------
    BlenderError
        If the first worker does not start.
    """

    def __init__(self, start: WorkerStart, count: int) -> None:
        self._start = start
        self._count = count
        self._all: list[Worker] = []
        self._lock, self._closed = threading.Lock(), False
        self._idle: SimpleQueue[Worker | None] = SimpleQueue()
        first = self._start_worker()
        self.version, self.points = first.version, first.points
        self._idle.put(first)
        for _ in range(count - 1):
            self._idle.put(None)  # the first job that takes it starts the worker
        self._threads = ThreadPoolExecutor(count)
        self.replaced = 0

    def _start_worker(self) -> Worker:
        worker = Worker(self._start)
        with self._lock:
            self._all.append(worker)
            closed = self._closed
        if closed:
            worker.close()
        return worker

    @property
    def pids(self) -> list[int]:
        """Process ids of all workers."""
        return [worker.pid for worker in self._all]

    def call(self, job: Callable[[Worker], Result]) -> Result:
        """Run ``job`` with a free worker. Retry it with a new one if the worker exits.

        Raises
        ------
        BlenderError
            If three workers exited during the job.
        """
        worker = self._idle.get()
        why = ""
        try:
            for _ in range(MAX_TRIES):
                try:
                    worker = worker or self._start_worker()
                    return job(worker)
                except (EOFError, OSError):
                    if self._closed:
                        raise
                    if worker is not None:
                        with self._lock:
                            self._all.remove(worker)
                        worker.close()
                        why = worker.failure_reason()
                    worker = None
                    self.replaced += 1
        finally:
            self._idle.put(worker)
        raise BlenderError(
            f"Blender died {MAX_TRIES} times on one image: {why}. Free memory, use fewer "
            "--workers, "
            "or set up Blender again"
        )

    def map(self, job: Callable[[Worker, Task], Result], tasks: Iterable[Task]) -> Iterator[Result]:
        """Yield the results of all tasks, in their order, with few in progress at a time.

        Raises
        ------
        BlenderError
            As ``call``.
        """
        waiting: deque[Future[Result]] = deque()
        for task in tasks:
            waiting.append(self._threads.submit(self.call, lambda w, t=task: job(w, t)))
            if len(waiting) >= MAX_QUEUED_JOBS * self._count:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._threads.shutdown(wait=False, cancel_futures=True)
        with self._lock:
            self._closed = True  # from now on _start_worker closes what it starts
            workers = list(self._all)
        for worker in workers:
            worker.close()
        self._threads.shutdown(wait=True)
