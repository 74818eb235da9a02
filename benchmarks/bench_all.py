"""Run every benchmark that needs no external data, and collect its results.

Run as ``python benchmarks/bench_all.py [OUT] [--only recording ...]``, or by ``make bench``. OUT
gets a .txt file of each benchmark, its .json file if it writes one, machine.json and ratios.png.
The picture shows the CPU time of other packages relative to that of dmrl for the same work.

If a benchmark fails, for example because a package or Blender is missing, the last line of its
error is printed, the others still run, and the exit status is 1. With ``--model
crazyflie-published.blend --backgrounds DIR`` (the authors' model and a folder of photos) rendering
is compared with the published method. Without them it is only timed.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

HERE = Path(__file__).parent
WORK: Mapping[str, tuple[str, ...]] = {
    "recording": ("bench_recording.py", "--json"),
    "columns": ("bench_columns.py",),
    "predict": ("bench_predict.py", "--json"),
    "commands": ("bench_commands.py", "--json"),
    "growth": ("bench_growth.py", "--json"),
    "training": ("bench_training.py",),
    "render": ("bench_render.py", "speed", "--images", "100", "--rounds", "2", "--json"),
    "dataset": ("bench_dataset.py",),
    "labels": ("bench_labels.py", "--costs-only"),
}
"""Scripts and their arguments; after a final ``--json`` the output path is added."""
ASKS = {
    "deploy": "python benchmarks/bench_deploy.py EXPORT needs an exported network",
}
"""Benchmarks that are skipped, and how to run them."""


def describe_machine() -> dict[str, Any]:
    """Return platform, Python version, processor, number of cores and load of this machine."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return {
        "platform": platform.platform(),
        "python": platform.python_version(),
        "processor": names[0] if names else platform.processor(),
        "cores": os.cpu_count(),
        "load": os.getloadavg(),
    }


def run(name: str, out: Path, material: list[str]) -> str:
    """Run one benchmark and store its output; return the last line of its error, or ""."""
    script, *words = WORK[name]
    if words and words[-1] == "--json":
        words.append(str(out / f"{name}.json"))
    if name == "render":
        words += material
    done = subprocess.run(
        [sys.executable, str(HERE / script), *words], capture_output=True, text=True, check=False
    )
    (out / f"{name}.txt").write_text(done.stdout, encoding="utf-8")
    print(f"== {name}\n{done.stdout}", flush=True)
    return (done.stderr.strip().splitlines() or ["?"])[-1] if done.returncode else ""


def draw(out: Path) -> None:
    """Draw bars of the CPU time of other packages over that of dmrl, from the JSON files there."""
    bars: list[tuple[str, float]] = []
    if (path := out / "recording.json").exists():
        rows = json.loads(path.read_text())
        bars += [(f"{r['what']}: {r['who']}", r["ratio"]) for r in rows]
    if (path := out / "predict.json").exists():
        rows = {row["who"]: row for row in json.loads(path.read_text())}
        own = rows.pop("dmrl predict --backend onnx")["cpu_ms"]
        bars += [(f"predict: {who}", row["cpu_ms"] / own) for who, row in rows.items()]
    if (path := out / "render.json").exists():
        found = json.loads(path.read_text())
        bars += [
            (f"render: {name}", sum(ratios) / len(ratios))
            for name, ratios in found.items()
            if " / ours, published model" in name and not name.startswith("ours")
        ]
    if not bars:
        return
    figure = Figure(figsize=(9, 0.3 * len(bars) + 1), layout="constrained")
    axes = figure.subplots()
    axes.barh([name for name, _ in bars], [ratio for _, ratio in bars], color="#4477aa")
    axes.axvline(1, color="black", linewidth=1)
    axes.set(xscale="log", xlabel="CPU time, relative to dmrl")
    axes.invert_yaxis()
    figure.savefig(out / "ratios.png", dpi=120)


def main() -> None:
    """Run all benchmarks, or those given by --only."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, nargs="?", default=Path("build/bench"))
    parser.add_argument("--only", nargs="+", choices=list(WORK), default=list(WORK))
    parser.add_argument("--model", type=Path, help="crazyflie-published.blend")
    parser.add_argument("--backgrounds", type=Path, help="a folder of photos")
    arguments = parser.parse_args()
    given = {"--model": arguments.model, "--backgrounds": arguments.backgrounds}
    material = [w for flag, path in given.items() if path for w in (flag, str(path.resolve()))]
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "machine.json").write_text(json.dumps(describe_machine(), indent=1) + "\n")
    failed = {name: why for name in arguments.only if (why := run(name, arguments.out, material))}
    draw(arguments.out)
    for name, why in ASKS.items():
        print(f"skipped: {name}: {why}")
    for name, why in failed.items():
        print(f"failed: {name}: {why}", file=sys.stderr)
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
