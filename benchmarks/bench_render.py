"""Measure dmrl render: reprojection, noise, cost compared with the published method, memory.

    python benchmarks/bench_render.py reprojection [--images 500]
    python benchmarks/bench_render.py grain --images 24 --backgrounds DIR
    python benchmarks/bench_render.py speed [--model crazyflie-published.blend --backgrounds DIR]
    python benchmarks/bench_render.py memory [--images 3000]
    python benchmarks/bench_render.py parts --images 120 [--rounds 3]

CPU seconds are sums over all processes, and include the start-up unless stated otherwise.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from render_exactness import build_grey_panorama, measure_noise, measure_reprojection
from render_parts import measure_parts

from dmrl.render_recording import read_render_camera, read_render_settings
from dmrl.rendering.blender_environment import ensure_environment
from dmrl.rendering.randomise import SceneSource, draw_scene
from dmrl.stages.render import run
from dmrl.terminal.progress import say

PUBLISHED_WAY = Path(__file__).parent / "published_way.py"
PUBLISHED = "the published way"
SAMPLES, FEW = 16, 4
M_PER_UNIT = 0.002  # of the published model, which the authors rendered at twice life size


def _children_s() -> float:
    """Return the CPU seconds of ended child processes."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _own_s() -> float:
    """Return the CPU seconds of this process."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def measure_published_way(
    model: Path, backgrounds: Path, images: int, samples: int, *, lean: bool
) -> dict[str, float]:
    """Return the CPU seconds per image of the published method on dmrl's scenes, with start-up.

    Parameters
    ----------
    model
        crazyflie-published.blend.
    backgrounds
        Folder of photos.
    images
        Number of images.
    samples
        Light paths per pixel.
    lean
        Use dmrl's settings: 2 bounces and a filter of one pixel. Else 12 bounces and a wider
        filter, as published.
    """
    settings = replace(read_render_settings("synthetic_paper"), images=images, robots_max=1)
    world = SceneSource(
        settings,
        read_render_camera(settings),
        0.1,
        ("none",),
        build_grey_panorama,
        None,
    )
    photos = sorted(backgrounds.glob("*.jpg"))
    listed = []
    for k in range(images):
        matrices = []
        for robot in draw_scene(world, k).robots:
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = robot.pose.camera_from_body, robot.pose.xyz_camera
            matrices.append(matrix.tolist())
        listed.append({"background": str(photos[k % len(photos)]), "robots": matrices})
    with tempfile.TemporaryDirectory() as folder:
        job = {"model": str(model), "samples": samples, "lean": lean, "folder": folder}
        job["images"] = listed
        (Path(folder) / "job.json").write_text(json.dumps(job))
        before, begin = _children_s(), time.monotonic()
        subprocess.run(
            [ensure_environment(say), PUBLISHED_WAY, Path(folder) / "job.json"],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        wall_s = time.monotonic() - begin
        cpu_s = _children_s() - before
    return {"cpu_s_per_image": cpu_s / images, "images_per_s": images / wall_s}


def measure_ours(recipe: str, images: int, workers: int, **changes: object) -> dict[str, float]:
    """Return the CPU seconds per image of ``dmrl render``, with start-up and recording.

    Parameters
    ----------
    recipe
        Name of a recipe.
    images
        Number of images.
    workers
        Number of Blender processes.
    changes
        Settings that replace those of the recipe.
    """
    with tempfile.TemporaryDirectory() as folder:
        settings = read_render_settings(recipe, images=images, workers=workers, **changes)
        before, own, begin = _children_s(), _own_s(), time.monotonic()
        run(Path(folder) / "out.mcap", settings)
        wall_s = time.monotonic() - begin
        workers_s, own_s = _children_s() - before, _own_s() - own
    return {
        "cpu_s_per_image": (workers_s + own_s) / images,
        "of_it_blender": workers_s / images,
        "images_per_s": images / wall_s,
    }


def measure_memory(images: int) -> dict[str, float]:
    """Return the resident memory of this process and its workers early and late in a run, MB.

    Parameters
    ----------
    images
        Number of images to render; the first and the last third of the run are compared.
    """
    seen: list[float] = []
    stop = threading.Event()

    def watch() -> None:
        while not stop.wait(0.5):
            seen.append(_resident_mb())

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        rates = measure_ours("synthetic_paper", images, 0)
    finally:
        stop.set()
        thread.join()
    third = len(seen) // 3
    first, last = np.median(seen[2 : third + 2]), np.median(seen[-third:])
    return {"first_mb": float(first), "last_mb": float(last), "growth": last / first - 1, **rates}


def _resident_mb() -> float:
    """Return the resident memory of the benchmark and its children, MB."""
    own = os.getpid()
    total = 0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rsplit(")", 1)[1].split()
            if int(stat.parent.name) == own or int(fields[1]) == own:
                total += int(fields[21])
        except (OSError, IndexError):
            continue  # the process has ended in the meantime
    return total * os.sysconf("SC_PAGE_SIZE") / 1e6


Way = tuple[Callable[[int], dict[str, float]], int]
"""A function that measures rendering a number of images, and that number."""


def build_ways(model: Path | None, backgrounds: Path | None, images: int) -> dict[str, Way]:
    """Return ways to render by name: the published method, if there is a model, and dmrl."""
    one = {"backgrounds": backgrounds or Path("rooms"), "robots_max": 1}
    own: dict[str, Way] = {
        "ours, default model": (
            lambda n: measure_ours("synthetic_paper", n, 2, samples=SAMPLES, **one),
            images,
        ),
        "synthetic_paper": (lambda n: measure_ours("synthetic_paper", n, 2, **one), images),
        "synthetic_large": (lambda n: measure_ours("synthetic_large", n, 2, **one), images),
    }
    if model is None or backgrounds is None:
        return own
    as_published = {"model": model, "scale": M_PER_UNIT, "model_up": "y"}
    theirs = partial(measure_published_way, model, backgrounds, samples=SAMPLES)
    return {
        PUBLISHED: (partial(theirs, lean=False), images // 10),
        f"{PUBLISHED}, 2 bounces and a box": (partial(theirs, lean=True), images // 10),
        "ours, published model": (
            lambda n: measure_ours("synthetic_paper", n, 2, samples=SAMPLES, **one, **as_published),
            images,
        ),
        **own,
    }


def compare_speed(
    model: Path | None, backgrounds: Path | None, images: int, rounds: int
) -> dict[str, object]:
    """Time the published method and dmrl, with the published model and dmrl's, in turns.

    The rows of the published method and those that start with "ours" have equal numbers of samples.
    Rows with the name of a recipe use its settings.

    Each is timed with few and with many images. The difference gives the cost of an image without
    the start-up. Because they take turns, other load on the machine slows all of them alike.

    Parameters
    ----------
    model
        crazyflie-published.blend. None: without the published method.
    backgrounds
        Folder of photos. None: generated rooms, and without the published method.
    images
        Number of images of dmrl per round; the published method renders a tenth of them.
    rounds
        Number of rounds; the result has minimum, median and maximum.
    """
    ways = build_ways(model, backgrounds, images)
    found: dict[str, list[dict[str, float]]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, (way, many) in ways.items():
            few, all_of_them = way(FEW), way(FEW + many)
            spent_s = [r["cpu_s_per_image"] * n for r, n in ((few, FEW), (all_of_them, FEW + many))]
            took_s = [n / r["images_per_s"] for r, n in ((few, FEW), (all_of_them, FEW + many))]
            without_start = {
                "cpu_s_without_start": (spent_s[1] - spent_s[0]) / many,
                "images_per_s_without_start": many / (took_s[1] - took_s[0]),
            }
            found[name].append({**all_of_them, **without_start})
    result: dict[str, object] = {"equal_samples": SAMPLES, "load": os.getloadavg()}
    for name, rates in found.items():
        result[name] = {
            key: {"least": min(values), "median": float(np.median(values)), "most": max(values)}
            for key in rates[0]
            if (values := [rate[key] for rate in rates])
        }
        for peer in (way for way in found if way.startswith(PUBLISHED)):
            result[f"{peer} / {name}"] = [
                theirs["cpu_s_without_start"] / rate["cpu_s_without_start"]
                for theirs, rate in zip(found[peer], rates, strict=True)
            ]
    return result


def main() -> None:
    """Print the requested figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("reprojection", "grain", "speed", "memory", "parts"))
    parser.add_argument("--images", type=int, default=500)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--backgrounds", type=Path)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    if asked.what == "reprojection":
        result: object = {p: measure_reprojection(p, asked.images) for p in ("published", "himax")}
    elif asked.what == "memory":
        result = measure_memory(asked.images)
    elif asked.what == "parts":
        result = measure_parts("synthetic_paper", asked.images, asked.rounds)
    elif asked.what == "speed":
        result = compare_speed(asked.model, asked.backgrounds, asked.images, asked.rounds)
    elif asked.backgrounds is None:
        sys.exit(f"{asked.what} needs --backgrounds DIR")
    else:
        recipes = ("synthetic_paper", "synthetic_large")
        result = {r: measure_noise(r, asked.images, asked.backgrounds) for r in recipes}
    text = json.dumps(result, indent=2)
    print(text)
    if asked.json:
        asked.json.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
