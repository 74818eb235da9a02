"""Substitutes for work that takes long and writes no output.

Blender, new processes, compilers, most of a search, the drawing of figures: what uses them is as
it always is.
"""

import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NoReturn, TextIO

import numpy as np

from dmrl.pipeline import job_worker
from dmrl.rendering.blender.protocol import Arrays
from dmrl.rendering.robots import crazyflie
from dmrl.rendering.worker_pool import WorkerStart

FEW = (2, 3)
"""In place of the rounds, and the pictures, that `dmrl likeness` fits a camera by."""


class Painter:
    """In place of a Blender process: a grey spot for every robot that is asked for."""

    def request(self, head: dict[str, Any], arrays: Arrays | None = None) -> tuple[Any, Arrays]:
        """As `dmrl.rendering.worker_pool.Worker.ask`."""
        if "panorama" in head:
            return {}, {"panorama": np.full((8, 16, 3), 0.5, np.float32)}
        left, top, right, bottom = head["crop_px"]
        width, height = right - left, bottom - top
        v, u = np.mgrid[:height, :width]
        inside = np.hypot((u - width / 2) / width, (v - height / 2) / height) < 0.3
        light = np.zeros((height, width, 4), np.float32)
        light[inside] = (0.4, 0.4, 0.4, 1.0)
        depth = np.where(inside, 1.0, np.inf).astype(np.float32)
        return {}, {"light": light, "depth": depth}


class Painters:
    """In place of `dmrl.rendering.worker_pool.WorkerPool`."""

    def __init__(self, start: WorkerStart, count: int) -> None:
        self.version = "0"
        self.points = np.asarray(crazyflie.CRAZYFLIE.build_mesh().vertices, float)

    def call(self, job: Callable[[Painter], Any]) -> Any:
        """What ``job`` makes of a painter."""
        return job(Painter())

    def map(self, job: Callable[[Painter, Any], Any], tasks: Iterable[Any]) -> Iterator[Any]:
        """Results of all tasks."""
        return (job(Painter(), task) for task in tasks)

    def __exit__(self, *_: object) -> None:
        pass


nothing = None
"""In place of a module with figures, as where matplotlib is not installed."""


def sky(_: Path) -> list[Path]:
    """In place of `dmrl.rendering.renderer.list_shipped_panoramas`."""
    return [Path("sky.exr")]


def no_python(_: object) -> Path:
    """In place of `dmrl.rendering.blender_environment.ensure_environment`."""
    return Path("python")


def blank(*_: object) -> None:
    """In place of `matplotlib.figure.Figure.draw`: figures are saved empty."""


class Forked:
    """In place of a new Python: a child that has everything loaded, and works as `ProcessPool`'s
    do."""

    def __init__(self, _: list[str], **given: Any) -> None:
        jobs, our_jobs = os.pipe()
        our_answers, answers = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            os.close(our_jobs)
            os.close(our_answers)
            _work(jobs, answers)
        os.close(jobs)
        os.close(answers)
        self.stdin: TextIO = os.fdopen(our_jobs, "w", encoding="utf-8")
        self.stdout: TextIO = os.fdopen(our_answers, "r", encoding="utf-8")
        self.status: int | None = None

    def send_signal(self, number: int) -> None:
        """Send it a signal."""
        os.kill(self.pid, number)

    def wait(self, timeout_s: float | None = None) -> int:
        """How it ended; it always ends soon."""
        if self.status is None:
            self.status = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        return self.status


class Processes:
    """In place of the module ``subprocess``."""

    PIPE = subprocess.PIPE
    TimeoutExpired = subprocess.TimeoutExpired
    Popen = Forked


def _work(jobs: int, answers: int) -> NoReturn:
    """The life of a step's process."""
    try:
        os.setsid()
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(120)  # an alarm is not inherited
        os.dup2(jobs, 0)
        os.dup2(answers, 1)
        # The other ends of its parent's pipes, too: they tell of its parent's death.
        os.closerange(3, 4096)
        sys.stdin = os.fdopen(0, "r", encoding="utf-8")
        sys.stdout = sys.stderr = os.fdopen(2, "w", encoding="utf-8")
        job_worker.main()
    except BaseException:
        traceback.print_exc()
    os._exit(1)
