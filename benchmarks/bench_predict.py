"""Compare `dmrl predict` with a plain onnxruntime loop over images that are already decoded.

Run as ``python benchmarks/bench_predict.py [--rounds 5] [--json FILE]``. The recording is a flight
of `dmrl fly` with cameras. All use one numeric thread. Figures are medians over rounds of the CPU
time per image, over all threads and of the calling thread alone. Ratios, also that of the wall
time, are to the plain loop over batches of 16 in the same round. The plain loop is faster with
single images, which is why `dmrl predict` also runs them one by one. The wall time is meaningful
only if a second core is free.
"""

import argparse
import json
import os
import platform
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import numpy as np  # after the environment variables, which NumPy reads on import
import onnxruntime

from dmrl.deploy.onnx.float_model import float_onnx_of
from dmrl.images.codec import decode
from dmrl.learn.inference.loaded_model import load_model
from dmrl.learn.pretrained import resolve_model_path
from dmrl.recording import read
from dmrl.stages import fly, predict

BATCH = 16
DURATION_S = 30.0
CLOCKS = (time.process_time, time.thread_time, time.perf_counter)
PLAIN = "onnxruntime, plain loop, batches of 16"


def build_plain_loops(model: Path, recording: Path) -> tuple[int, dict[str, Callable[[], object]]]:
    """Decode all images; return their number, and functions that run onnxruntime on all of them."""
    found = read(recording, "/*/camera/image")
    images = np.stack([decode(one.message.data, str(one.time_ns)) for one in found])
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    written = float_onnx_of(load_model(model), grey=False)
    session = onnxruntime.InferenceSession(written, options)

    def run(size: int) -> None:
        for k in range(0, len(images), size):
            session.run(None, {"image": images[k : k + size]})

    loops: dict[str, Callable[[], object]] = {
        PLAIN: partial(run, BATCH),
        "onnxruntime, plain loop, one by one": partial(run, 1),
    }
    return len(images), loops


def measure(folder: Path, rounds: int) -> list[dict[str, Any]]:
    """Return a row for each backend: CPU milliseconds per image, and ratios to the plain loop."""
    model, recording = resolve_model_path(Path("dmrl-nano")), folder / "flight.mcap"
    fly.run(recording, fly.Settings(2, DURATION_S, camera=True, camera_rate_hz=5.0, seed=1))
    count, work = build_plain_loops(model, recording)
    for backend in ("onnx", "torch"):
        out, how = folder / f"{backend}.mcap", predict.Settings(backend=backend)
        work[f"dmrl predict --backend {backend}"] = partial(predict.run, model, recording, out, how)
    spent: dict[str, list[tuple[float, ...]]] = {name: [] for name in work}
    for number in range(rounds + 1):
        for name, run in work.items():
            begun = [clock() for clock in CLOCKS]
            run()
            took = tuple(clock() - at for clock, at in zip(CLOCKS, begun, strict=True))
            if number:  # the first round is a warm-up
                spent[name].append(took)
            for path in folder.glob("*.mcap"):
                if path != recording:
                    path.unlink()
    plain = spent[PLAIN]
    return [
        {
            "who": name,
            "images": count,
            "cpu_ms": median(all_ for all_, *_ in took) / count * 1e3,
            "own_thread_ms": median(own for _, own, _ in took) / count * 1e3,
            "ratio": median(a[0] / b[0] for a, b in zip(took, plain, strict=True)),
            "own_ratio": median(a[1] / b[1] for a, b in zip(took, plain, strict=True)),
            "wall_ratio": median(a[2] / b[2] for a, b in zip(took, plain, strict=True)),
        }
        for name, took in spent.items()
    ]


def main() -> None:
    """Print a line for each backend."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = measure(Path(folder), arguments.rounds)
    print(f"{platform.platform()}, Python {platform.python_version()}, {found[0]['images']} images")
    print(f"{'':40} {'cpu-ms/image':>13} {'ratio':>6} {'own thread':>11} {'ratio':>6} {'wall':>6}")
    for row in found:
        print(
            f"{row['who']:40} {row['cpu_ms']:13.2f} {row['ratio']:6.2f} "
            f"{row['own_thread_ms']:11.2f} {row['own_ratio']:6.2f} {row['wall_ratio']:6.2f}"
        )
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
