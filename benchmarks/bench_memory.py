"""What each command holds in memory, and whether that grows with its input.

Run as ``python benchmarks/bench_memory.py [--seconds 20] [--only label ...] [--json FILE]``. Two
flights of two robots with a camera, one ten times as long as the other. Each command is a process
of its own with one thread, and does with one what it then does with the other; its memory is the
most that it ever held (the maximum resident set, as the system counts it). ``fly`` makes the
flights, ``predict`` finds robots by `dmrl-nano`.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

TIMES = 10
FLY = ("fly", "fly_in_view", "flight.mcap", "--camera", "--camera-rate-hz", "4", "--seed", "1")
WORK: Mapping[str, tuple[str, ...]] = {
    "fly": FLY,
    "predict": ("predict", "dmrl-nano", "flight.mcap", "found.mcap", "--backend", "onnx"),
    "label": ("label", "flight.mcap", "labelled.mcap", "--workers", "1"),
    "check": ("check", "flight.mcap"),
    "trim": ("trim", "flight.mcap", "first.mcap", "--to", "{half}"),
    "trim, the rest": ("trim", "flight.mcap", "second.mcap", "--from", "{half}"),
    "merge": ("merge", "first.mcap", "second.mcap", "merged.mcap"),
    "recover": ("recover", "flight.mcap", "recovered.mcap"),
    "dataset": ("dataset", "flight.mcap", "dataset", "--labels", "truth", "--workers", "1"),
    "evaluate": ("evaluate", "found.mcap", "--workers", "1"),
    "convert to csv": ("convert", "flight.mcap", "csv", "--to", "csv"),
    "view": ("view", "flight.mcap", "--save", "flight.rrd"),
}
"""What is run, in this order: later ones read what earlier ones wrote."""


def peak_mb(words: tuple[str, ...], folder: Path) -> float:
    """Return the peak memory of a command, MB."""
    process = subprocess.Popen(
        [sys.executable, "-m", "dmrl.cli", *words], cwd=folder, stdout=subprocess.DEVNULL
    )
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"dmrl {' '.join(words)} ended with {process.returncode}")
    unit = 1 if sys.platform == "darwin" else 1024
    return used.ru_maxrss * unit / 1e6


def measure(folder: Path, seconds: float, only: list[str]) -> list[dict[str, Any]]:
    """Measure every command; return a row for each: MB with the short flight and the long one."""
    peaks: dict[str, list[float]] = {name: [] for name in WORK}
    megabytes = []
    for place, lasts_s in ((folder / "short", seconds), (folder / "long", TIMES * seconds)):
        place.mkdir(exist_ok=True)
        for name, words in WORK.items():
            if name != "fly" and only and name not in only:
                continue
            told = tuple(word.format(half=lasts_s / 2) for word in words)
            if name == "fly":
                told = (*told, "--duration-s", str(lasts_s))
            peaks[name].append(peak_mb(told, place))
        megabytes.append((place / "flight.mcap").stat().st_size / 1e6)
    return [
        {"what": name, "input_mb": megabytes, "peak_mb": found, "times": found[1] / found[0]}
        for name, found in peaks.items()
        if found
    ]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="of the short flight")
    parser.add_argument("--only", nargs="*", default=[], choices=list(WORK))
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    with tempfile.TemporaryDirectory() as folder:
        found = measure(Path(folder), arguments.seconds, arguments.only)
    short, long = found[0]["input_mb"]
    print(f"{platform.platform()}, Python {platform.python_version()}")
    print(f"{'peak, MB':16} {f'{short:.0f} MB':>10} {f'{long:.0f} MB':>10} {'times':>7}")
    for row in found:
        first, last = row["peak_mb"]
        print(f"{row['what']:16} {first:10.0f} {last:10.0f} {row['times']:7.2f}")
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
