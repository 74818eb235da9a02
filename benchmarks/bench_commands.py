"""What a command costs before it works: its help; and what a sketch costs.

Run as ``python benchmarks/bench_commands.py [--rounds 3] [--json FILE]``. CPU seconds of a process
for ``dmrl --help`` and the help of every command, beside Python that imports cyclopts alone; then
CPU milliseconds of a sketch, 320 x 224: of three robots, and of one at most with its JPEG, as
``dmrl fly --camera`` makes them. Medians over rounds.
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

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # threads that wait for each other count as work

import numpy as np

from dmrl.cli import COMMANDS
from dmrl.geometry.frames import AIDECK
from dmrl.images.codec import encode_jpeg
from dmrl.rendering.sketch_renderer import render_sketch
from dmrl.rendering.sketch_scene import random_look, random_poses
from dmrl.simulation.drawn_pictures import draw_picture
from dmrl.stages import sketch

SKETCHES = 40


def cpu_s(words: list[str]) -> float:
    """CPU seconds of a process, its start included."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def sketch_ms(seed: int) -> float:
    """CPU milliseconds of a sketch, over several."""
    camera = replace(AIDECK, distortion=())
    begun = time.process_time()
    for k in range(SKETCHES):
        rng = np.random.default_rng((seed, k))
        render_sketch(camera, random_poses(rng, camera, 3), random_look(rng, camera))
    return (time.process_time() - begun) / SKETCHES * 1e3


def with_jpeg_ms(seed: int) -> float:
    """CPU milliseconds of a sketch of one robot or none, and its JPEG."""
    settings = sketch.Settings(seed=seed, robots_max=1)
    begun = time.process_time()
    for k in range(SKETCHES):
        encode_jpeg(draw_picture(settings, k).rgb)
    return (time.process_time() - begun) / SKETCHES * 1e3


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # as where it is installed
    work = {
        "python, import cyclopts": ["-c", "import cyclopts"],
        "--help": ["-m", "dmrl.cli", "--help"],
    }
    work |= {f"{name} --help": ["-m", "dmrl.cli", name, "--help"] for name in COMMANDS}
    for words in work.values():
        cpu_s(words)
    rounds = range(arguments.rounds)
    found = {name: median(cpu_s(words) for _ in rounds) for name, words in work.items()}
    sketch_ms(0), with_jpeg_ms(0)  # tables are made
    found["sketch, ms"] = median(sketch_ms(seed) for seed in rounds)
    found["sketch of one and JPEG, ms"] = median(with_jpeg_ms(seed) for seed in rounds)
    print(f"{platform.platform()}, Python {platform.python_version()}")
    for name, value in found.items():
        print(f"{name:28} {value:8.3f}")
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
