"""Blender processes that render robots, replaced when they die."""

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

WORKER = Path(__file__).parent / "blender" / "worker.py"
TRIES = 3
AHEAD = 4
"""Jobs under way or waiting to be taken, for each worker."""

Task = TypeVar("Task")
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Start:
    """What a worker is told first.

    Parameters
    ----------
    python
        Of Blender's environment.
    head, arrays
        The model, the panoramas and the quality.
    """

    python: Path
    head: dict[str, Any]
    arrays: Arrays = field(default_factory=dict)


class Worker:
    """One Blender process with a robot in its scene.

    Parameters
    ----------
    start
        What it is told first.

    Raises
    ------
    BlenderError
        If it does not start, or cannot use the model: says why.
    """

    def __init__(self, start: Start) -> None:
        self._process = subprocess.Popen(
            [str(start.python), str(WORKER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        self._last_words: deque[bytes] = deque(maxlen=20)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        try:
            self.version, self.points = self._greet(start)
        except (EOFError, OSError) as e:
            self.close()
            raise BlenderError(f"Blender did not start: {self.why()}. {HINT}") from e

    def _greet(self, start: Start) -> tuple[str, Array]:
        head, arrays = self.ask(start.head, start.arrays)
        if "error" in head:
            self.close()
            raise BlenderError(head["error"])
        return head["version"], arrays["points"].astype(float)

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def ask(self, head: dict[str, Any], arrays: Arrays | None = None) -> tuple[Any, Arrays]:
        """What the worker answers.

        Raises
        ------
        EOFError, OSError
            If it has died.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        send(self._process.stdin, head, arrays)
        return receive(self._process.stdout)

    def _listen(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            if line.strip():
                self._last_words.append(line)

    def why(self) -> str:
        """What it said last, or how it ended."""
        words = self._last_words[-1].decode(errors="replace").strip() if self._last_words else ""
        return words or f"exit {self._process.poll()}"

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        self._listener.join()
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            if stream is not None:
                try:
                    stream.close()
                except BrokenPipeError:  # what it never read is of no use to it now
                    continue


HINT = "Try: dmrl render --setup"


class Pool:
    """Workers that take jobs as they come free; results keep the order of the tasks.

    Parameters
    ----------
    start
        What every worker is told first.
    count
        Number of workers.

    Raises
    ------
    BlenderError
        If the first worker does not start.
    """

    def __init__(self, start: Start, count: int) -> None:
        self._start = start
        self._count = count
        self._all: list[Worker] = []
        self._lock, self._closed = threading.Lock(), False
        self._idle: SimpleQueue[Worker | None] = SimpleQueue()
        first = self._new()
        self.version, self.points = first.version, first.points
        self._idle.put(first)
        for _ in range(count - 1):
            self._idle.put(None)  # started by the first job that takes it
        self._threads = ThreadPoolExecutor(count)
        self.replaced = 0

    def _new(self) -> Worker:
        worker = Worker(self._start)
        with self._lock:
            self._all.append(worker)
            closed = self._closed
        if closed:
            worker.close()
        return worker

    @property
    def pids(self) -> list[int]:
        """Numbers of the processes."""
        return [worker.pid for worker in self._all]

    def call(self, job: Callable[[Worker], Result]) -> Result:
        """What ``job`` makes of a worker; asked again of a new one if that dies.

        Raises
        ------
        BlenderError
            If three workers died of it.
        """
        worker = self._idle.get()
        why = ""
        try:
            for _ in range(TRIES):
                try:
                    worker = worker or self._new()
                    return job(worker)
                except (EOFError, OSError):
                    if self._closed:
                        raise
                    if worker is not None:
                        with self._lock:
                            self._all.remove(worker)
                        worker.close()
                        why = worker.why()
                    worker = None
                    self.replaced += 1
        finally:
            self._idle.put(worker)
        raise BlenderError(
            f"Blender died {TRIES} times on one image: {why}. Free memory, use fewer --workers, "
            "or set Blender up anew"
        )

    def map(self, job: Callable[[Worker, Task], Result], tasks: Iterable[Task]) -> Iterator[Result]:
        """Results of all tasks, in their order; few are under way or waiting at a time.

        Raises
        ------
        BlenderError
            As ``call``.
        """
        waiting: deque[Future[Result]] = deque()
        for task in tasks:
            waiting.append(self._threads.submit(self.call, lambda w, t=task: job(w, t)))
            if len(waiting) >= AHEAD * self._count:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._threads.shutdown(wait=False, cancel_futures=True)
        with self._lock:
            self._closed = True  # who starts one from now on ends it itself
            workers = list(self._all)
        for worker in workers:
            worker.close()
        self._threads.shutdown(wait=True)
