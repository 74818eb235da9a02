"""Fast substitutes for slow work that writes no output.

They replace Blender, new Python processes, most of a parameter search and the drawing of figures.
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
"""Replaces the numbers of rounds and images with which `dmrl likeness` fits a camera."""


class Painter:
    """Replaces a Blender process: draws a grey spot for every robot."""

    def request(self, head: dict[str, Any], arrays: Arrays | None = None) -> tuple[Any, Arrays]:
        """Answer as `dmrl.rendering.worker_pool.Worker.request` does."""
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
    """Replaces `dmrl.rendering.worker_pool.WorkerPool`."""

    def __init__(self, start: WorkerStart, count: int) -> None:
        self.version = "0"
        self.points = np.asarray(crazyflie.CRAZYFLIE.build_mesh().vertices, float)

    def call(self, job: Callable[[Painter], Any]) -> Any:
        """Return the result of ``job`` for a painter."""
        return job(Painter())

    def map(self, job: Callable[[Painter, Any], Any], tasks: Iterable[Any]) -> Iterator[Any]:
        """Return the results of all tasks."""
        return (job(Painter(), task) for task in tasks)

    def __exit__(self, *_: object) -> None:
        pass


nothing = None
"""Replaces a module with figures, as if matplotlib were not installed."""


def sky(_: Path) -> list[Path]:
    """Replace `dmrl.rendering.renderer.list_shipped_panoramas`."""
    return [Path("sky.exr")]


def no_python(_: object) -> Path:
    """Replace `dmrl.rendering.blender_environment.ensure_environment`."""
    return Path("python")


def blank(*_: object) -> None:
    """Replace `matplotlib.figure.Figure.draw`, so that figures are saved empty."""


class Forked:
    """Replaces a new Python process of `ProcessPool` by a forked child with all modules loaded."""

    def __init__(self, _: list[str], **given: Any) -> None:
        jobs, our_jobs = os.pipe()
        our_answers, answers = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            os.close(our_jobs)
            os.close(our_answers)
            _run_worker(jobs, answers)
        os.close(jobs)
        os.close(answers)
        self.stdin: TextIO = os.fdopen(our_jobs, "w", encoding="utf-8")
        self.stdout: TextIO = os.fdopen(our_answers, "r", encoding="utf-8")
        self.status: int | None = None

    def send_signal(self, number: int) -> None:
        """Send the child a signal."""
        os.kill(self.pid, number)

    def wait(self, timeout_s: float | None = None) -> int:
        """Wait for the child, without a timeout as it ends soon; return its exit status."""
        if self.status is None:
            self.status = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        return self.status


class Processes:
    """Replaces the module ``subprocess``."""

    PIPE = subprocess.PIPE
    TimeoutExpired = subprocess.TimeoutExpired
    Popen = Forked


def _run_worker(jobs: int, answers: int) -> NoReturn:
    """Run the worker process of a pipeline step until its parent ends."""
    try:
        os.setsid()
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(120)  # an alarm is not inherited
        os.dup2(jobs, 0)
        os.dup2(answers, 1)
        # Close the parent's ends of the pipes too, or the worker would not notice its death.
        os.closerange(3, 4096)
        sys.stdin = os.fdopen(0, "r", encoding="utf-8")
        sys.stdout = sys.stderr = os.fdopen(2, "w", encoding="utf-8")
        job_worker.main()
    except BaseException:
        traceback.print_exc()
    os._exit(1)
