"""Measure the CPU time of a render in Cycles, in the rest of Blender, and in dmrl's process."""

import os
import resource
import tempfile
from pathlib import Path

import numpy as np

from dmrl.render_recording import read_render_settings
from dmrl.rendering import worker_pool
from dmrl.stages.render import run

TIMED_WORKER = Path(__file__).parent / "timed_worker.py"
FEW = 4
PARTS = ("cycles", "rest_of_blender", "dmrl")


def measure_parts(recipe: str, images: int, rounds: int) -> dict[str, object]:
    """Measure the CPU time per image of each part, ms, with one worker and without start-up.

    The start-up is removed by subtracting a run with few images; Blender's first images of each run
    are left out as well.

    Parameters
    ----------
    recipe
        Name of a recipe.
    images
        Number of images that the longer run has in addition.
    rounds
        Number of rounds; the lists have one number per round.
    """
    found = np.array([_render(recipe, FEW + images) - _render(recipe, FEW) for _ in range(rounds)])
    each = found / images * 1e3
    python = each[:, 1] + each[:, 2]
    parts = {f"{name}_ms": each[:, k].tolist() for k, name in enumerate(PARTS)}
    shares = python / each.sum(axis=1)
    return {**parts, "python_ms": python.tolist(), "share_of_python": shares.tolist()}


def _render(recipe: str, images: int) -> np.ndarray:
    """Render some images; return the CPU seconds of the three parts."""
    shipped = worker_pool.WORKER_SCRIPT
    with tempfile.TemporaryDirectory() as folder:
        times = Path(folder) / "times"
        os.environ["DMRL_RENDER_TIMES"] = str(times)
        worker_pool.WORKER_SCRIPT = TIMED_WORKER
        before = _own_s()
        try:
            run(Path(folder) / "out.mcap", read_render_settings(recipe, images=images, workers=1))
        finally:
            worker_pool.WORKER_SCRIPT = shipped
        own = _own_s() - before
        lines = np.loadtxt(times)
    blender, cycles = lines[-1] - lines[-1 - (images - FEW)]
    return np.array([cycles, blender - cycles, own])


def _own_s() -> float:
    """Return the CPU seconds of this process."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime
