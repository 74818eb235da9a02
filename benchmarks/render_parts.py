"""CPU time of a render's parts: Cycles, the rest of Blender's process, and dmrl's process."""

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
    """Measure the CPU time of an image's parts, ms, with one worker and without the start.

    Of dmrl's process, a run of few images is subtracted; of Blender's, its first images.

    Parameters
    ----------
    recipe
        Name of a recipe.
    images
        How many more images the longer run has.
    rounds
        How many rounds. Lists have one number of each.
    """
    found = np.array([_render(recipe, FEW + images) - _render(recipe, FEW) for _ in range(rounds)])
    each = found / images * 1e3
    python = each[:, 1] + each[:, 2]
    parts = {f"{name}_ms": each[:, k].tolist() for k, name in enumerate(PARTS)}
    shares = python / each.sum(axis=1)
    return {**parts, "python_ms": python.tolist(), "share_of_python": shares.tolist()}


def _render(recipe: str, images: int) -> np.ndarray:
    """Return the CPU seconds of the parts of a run."""
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
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime
