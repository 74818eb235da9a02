"""Measure how CPU time and memory of each command grow with the length of a recording.

    python benchmarks/bench_growth.py [--seconds 20] [--times 1 10 100] [--only label ...]
        [--json FILE] [--plot FILE.png]

The flights have two robots with a camera; their lengths are multiples of the shortest. Each command
runs in its own process with one thread. Its memory is the maximum resident set size. `fly` makes
the flights, `predict` runs `dmrl-nano`, and `read` reads every topic from `dmrl.open` as an Arrow
table. With three lengths or more, the exponent of the CPU time is fitted, without the constant time
of the start.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

MIN_GROWTH = 0.2
"""Smallest relative growth of the CPU time from the first length to the second that is fitted: one
run repeats within a tenth."""
READ = "import dmrl; rec = dmrl.open('flight.mcap'); [rec[name].to_arrow() for name in rec.topics]"
WORK: Mapping[str, tuple[str, ...]] = {
    "fly": ("fly", "fly_in_view", "flight.mcap", "--camera", "--camera-rate-hz", "4"),
    "read": ("-c", READ),
    "predict": ("predict", "dmrl-nano", "flight.mcap", "found.mcap", "--backend", "onnx"),
    "label": ("label", "flight.mcap", "labelled.mcap", "--workers", "1"),
    "check": ("check", "flight.mcap"),
    "index": ("index", ".", "--workers", "1"),
    "trim": ("trim", "flight.mcap", "first.mcap", "--to", "{half}"),
    "trim, the rest": ("trim", "flight.mcap", "second.mcap", "--from", "{half}"),
    "merge": ("merge", "first.mcap", "second.mcap", "merged.mcap"),
    "recover": ("recover", "flight.mcap", "recovered.mcap"),
    "dataset": ("dataset", "flight.mcap", "dataset", "--labels", "truth", "--workers", "1"),
    "evaluate": ("evaluate", "found.mcap", "--workers", "1"),
    "convert to csv": ("convert", "flight.mcap", "csv", "--to", "csv"),
    "view": ("view", "flight.mcap", "--save", "flight.rrd"),
}
"""Commands in the order in which they run: later ones read the output of earlier ones."""


def run(words: Sequence[str], folder: Path) -> tuple[float, float]:
    """Return the CPU time of a command, seconds, and its peak memory, MB."""
    start = () if words[0] == "-c" else ("-m", "dmrl.cli")
    process = subprocess.Popen(
        [sys.executable, *start, *words], cwd=folder, stdout=subprocess.DEVNULL
    )
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"dmrl {' '.join(words)} ended with {process.returncode}")
    unit = 1 if sys.platform == "darwin" else 1024
    return used.ru_utime + used.ru_stime, used.ru_maxrss * unit / 1e6


def measure(
    folder: Path, seconds: float, times: Sequence[int], only: Sequence[str]
) -> list[dict[str, Any]]:
    """Measure every command with every flight; return a row for each command."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in WORK}
    megabytes = []
    for number in times:
        place, lasts_s = folder / str(number), number * seconds
        place.mkdir()
        for name, words in WORK.items():
            if name != "fly" and only and name not in only:
                continue
            filled = [word.replace("{half}", str(lasts_s / 2)) for word in words]
            if name == "fly":
                filled += ["--duration-s", str(lasts_s), "--seed", "1"]
            found[name].append(run(filled, place))
            print(f"{lasts_s:.0f} s, {name}: {found[name][-1]}", file=sys.stderr, flush=True)
        megabytes.append((place / "flight.mcap").stat().st_size / 1e6)
    return [
        {
            "what": name,
            "times": list(times),
            "input_mb": megabytes,
            "cpu_s": [cpu_s for cpu_s, _ in each],
            "peak_mb": [peak_mb for _, peak_mb in each],
            "exponent": fit_exponent(times, [cpu_s for cpu_s, _ in each]),
        }
        for name, each in found.items()
        if each
    ]


def fit_exponent(times: Sequence[int], cpu_s: Sequence[float]) -> float | None:
    """Return k of the fit ``start + a times^k``, by relative error.

    None is returned below three lengths, and where the start hides the growth of the first two.
    """
    if len(times) < 3 or cpu_s[1] < (1 + MIN_GROWTH) * cpu_s[0]:
        return None
    size, cost = np.array(times, float), np.array(cpu_s)

    def residuals(unknown: np.ndarray) -> np.ndarray:
        start, factor, power = unknown
        return np.log((np.exp(start) + np.exp(factor) * size**power) / cost)

    first = np.log(cost[0] / 2), np.log(cost[-1] / size[-1]), 1.0
    return float(least_squares(residuals, first).x[2])


def draw(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw CPU time and peak memory over the size of the recording."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - only for the picture

    figure = Figure(figsize=(11, 4.8), layout="constrained", dpi=110)
    left, right = figure.subplots(1, 2)
    styles = ("-", "--", "-.", ":")
    for number, row in enumerate(rows):
        style = {"marker": "o", "ms": 4, "ls": styles[number % 4], "color": f"C{number % 10}"}
        power = row["exponent"]
        label = row["what"] if power is None else f"{row['what']}: exponent {power:.2f}"
        left.plot(row["input_mb"], row["cpu_s"], label=label, **style)
        right.plot(row["input_mb"], row["peak_mb"], **style)
    for axes, title in ((left, "CPU time, s"), (right, "peak memory, MB")):
        sizes = rows[0]["input_mb"]
        axes.set(xscale="log", xlabel="recording, MB", title=title)
        axes.set_xticks(sizes, [f"{size:.0f}" for size in sizes])
        axes.xaxis.set_minor_formatter("")
        axes.grid(alpha=0.3)
    left.set_yscale("log")
    left.yaxis.set_major_formatter("{x:g}")
    left.yaxis.set_minor_formatter("")
    right.set_ylim(bottom=0)
    figure.legend(loc="outside right center", fontsize=9)
    figure.savefig(path)


def print_rows(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print CPU time, its exponent and the peak memory of every command."""
    sizes = "".join(f"{f'{size:.0f} MB':>10}" for size in rows[0]["input_mb"])
    print(f"{platform.platform()}, Python {platform.python_version()}")
    print(f"{'':16}{sizes}{sizes}{'exponent':>10}\n{'':16}{'CPU, s':>10}")
    for row in rows:
        cpu = "".join(f"{value:10.2f}" for value in row["cpu_s"])
        peak = "".join(f"{value:10.0f}" for value in row["peak_mb"])
        power = "-" if row["exponent"] is None else f"{row['exponent']:.2f}"
        print(f"{row['what']:16}{cpu}{peak}{power:>10}")


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="of the shortest flight")
    parser.add_argument("--times", type=int, nargs="+", default=[1, 10], help="lengths over it")
    parser.add_argument("--only", nargs="*", default=[], choices=list(WORK))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    given = parser.parse_args()
    os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(Path(folder), given.seconds, given.times, given.only)
    print_rows(rows)
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")
    if given.plot:
        draw(rows, given.plot)


if __name__ == "__main__":
    main()
