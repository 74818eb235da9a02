"""Compare the exported C with onnxruntime on this computer, one thread each.

Run as ``python benchmarks/bench_deploy.py EXPORT_DIR [--rounds 30]`` on the output of ``dmrl
export``. Every round runs each backend once, so that other load slows all of them alike. Prints the
median and minimum CPU time of an image, and the ratio of the median to onnxruntime int8.
"""

import argparse
import shutil
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dmrl.deploy.backends import to_network_input
from dmrl.deploy.c.run.compiled import CompiledNetwork
from dmrl.deploy.int8.store import load_network
from dmrl.deploy.onnx.runtime import OnnxRun
from dmrl.deploy.samples import load_samples

PEER = "onnxruntime int8"


def build_runs(folder: Path) -> dict[str, Callable[[], object]]:
    """Return a function for each backend that runs one image, by name."""
    network, image = load_network(folder), load_samples(folder)[0]
    seen = to_network_input(network, image)
    out: dict[str, Callable[[], object]] = {}
    for name, file in ((PEER, "model.int8.onnx"), ("onnxruntime float", "model.onnx")):
        session = OnnxRun(folder / file, threads=1)
        out[name] = lambda session=session: session.outputs(image[None])
    for compiler in ("clang", "gcc"):
        if shutil.which(compiler):
            compiled = CompiledNetwork(network, folder, compiler)
            out[f"C, {compiler} -O3"] = lambda c=compiled: c.run(seen)
    return out


def main() -> None:
    """Print a line for each backend."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rounds", type=int, default=30)
    args = parser.parse_args()
    runs = build_runs(args.folder)
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(args.rounds):
        for name, run in runs.items():
            before = time.process_time()
            run()
            times[name].append((time.process_time() - before) * 1e3)
    peer = statistics.median(times[PEER])
    for name, spent in times.items():
        middle = statistics.median(spent)
        print(
            f"{name:28} {middle:7.2f} ms CPU per image, minimum {np.min(spent):.2f}, "
            f"{middle / peer:.2f} x {PEER}"
        )


if __name__ == "__main__":
    main()
