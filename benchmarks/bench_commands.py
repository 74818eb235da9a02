"""Measure the CPU time of the help of every command, and of a sketched image.

Run as ``python benchmarks/bench_commands.py [--rounds 3] [--json FILE]``. Prints the CPU seconds of
``dmrl --help``, of the help of every command, and of Python that only imports cyclopts. Then
prints the CPU milliseconds of a sketch of three robots, 320 x 224 px, and of a sketch of at most
one robot with its JPEG, as ``dmrl fly --camera`` makes it. All are medians over the rounds.
"""

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from statistics import median

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # threads that spin while waiting count as CPU time

import numpy as np

from dmrl.cli import COMMANDS
from dmrl.geometry.frames import AIDECK
from dmrl.images.codec import encode_jpeg
from dmrl.rendering.sketch_renderer import render_sketch
from dmrl.rendering.sketch_scene import random_look, random_poses
from dmrl.simulation.drawn_pictures import draw_picture
from dmrl.stages import sketch

SKETCHES = 40


def measure_cpu_s(words: list[str]) -> float:
    """Return the CPU seconds of a Python process, including its start."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measure_sketch_ms(seed: int) -> float:
    """Return the mean CPU time of a sketch of three robots, milliseconds."""
    camera = replace(AIDECK, distortion=())
    begun = time.process_time()
    for k in range(SKETCHES):
        rng = np.random.default_rng((seed, k))
        render_sketch(camera, random_poses(rng, camera, 3), random_look(rng, camera))
    return (time.process_time() - begun) / SKETCHES * 1e3


def measure_sketch_with_jpeg_ms(seed: int) -> float:
    """Return the mean CPU time of a sketch of at most one robot and its JPEG, milliseconds."""
    settings = sketch.Settings(seed=seed, robots_max=1)
    begun = time.process_time()
    for k in range(SKETCHES):
        encode_jpeg(draw_picture(settings, k).rgb)
    return (time.process_time() - begun) / SKETCHES * 1e3


def main() -> None:
    """Print every median, and write them as JSON with --json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed dmrl has bytecode on disk
    work = {
        "python, import cyclopts": ["-c", "import cyclopts"],
        "--help": ["-m", "dmrl.cli", "--help"],
    }
    work |= {f"{name} --help": ["-m", "dmrl.cli", name, "--help"] for name in COMMANDS}
    for words in work.values():
        measure_cpu_s(words)
    rounds = range(arguments.rounds)
    found = {name: median(measure_cpu_s(words) for _ in rounds) for name, words in work.items()}
    measure_sketch_ms(0), measure_sketch_with_jpeg_ms(0)  # the first calls build lookup tables
    found["sketch, ms"] = median(measure_sketch_ms(seed) for seed in rounds)
    with_jpeg_ms = median(measure_sketch_with_jpeg_ms(seed) for seed in rounds)
    found["sketch of one and JPEG, ms"] = with_jpeg_ms
    print(f"{platform.platform()}, Python {platform.python_version()}")
    for name, value in found.items():
        print(f"{name:28} {value:8.3f}")
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
