"""Measure CPU time and memory of index, find, check and dataset for many small recordings.

    python benchmarks/bench_many.py [COUNT...] [--keep FOLDER]

A recording has four images of 64 x 48 px with labels, and four attitudes. Each command runs in its
own process with one worker; its memory is the peak of it and its workers. Indexing is timed for new
recordings, and again when all of them are known.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from dmrl import atomic_output
from dmrl.images.codec import encode_png
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter
from dmrl.terminal.tables import print_table
from dmrl.topics import ATTITUDE, CAMERA_IMAGE, LABELS

IMAGES, STEP_NS = 4, 100_000_000
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def write_recordings(folder: Path, count: int) -> None:
    """Write small recordings, a thousand per folder."""
    atomic_output.sync = lambda path: None  # syncing ten thousand files would take minutes
    atomic_output.sync_entry = lambda path: None
    rng = np.random.default_rng(0)
    for number in range(count):
        place = folder / f"{number // 1000:03d}" / f"{number:06d}.mcap"
        place.parent.mkdir(parents=True, exist_ok=True)
        begin_ns, robot = 10**18 + number * 10**12, f"cf{1 + number % 3}"
        with RecordingWriter(place, Provenance("bench", {"number": number})) as sink:
            for k in range(IMAGES):
                data = encode_png(rng.integers(0, 40, (48, 64, 3), np.uint8))
                picture = message_class("CompressedImage")(data=data, format="png")
                peer = {"peer": "cf9", "u_px": 20, "v_px": 20, "depth_m": 1.2, "source": "truth"}
                at = begin_ns + k * STEP_NS
                sink.write(at, CAMERA_IMAGE(robot), picture)
                sink.write(at, LABELS(robot), message_class("PeerLabels")(peers=[peer]))
                sink.write(at + 1, ATTITUDE(robot), message_class("Attitude")(roll_rad=0.01 * k))


def measure_cost(*words: str) -> tuple[float, float]:
    """Return the CPU seconds and the peak memory, MB, of a command and its child processes.

    Raises
    ------
    RuntimeError
        If the command fails.
    """
    code = (
        "import os, resource, subprocess, sys\n"
        "status = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode\n"
        "used = resource.getrusage(resource.RUSAGE_CHILDREN)\n"
        "print(status, used.ru_utime + used.ru_stime, used.ru_maxrss / 1e3)"
    )
    dmrl = ("-c", "from dmrl.cli import main; main()", *words)
    line = [sys.executable, "-c", code, sys.executable, *dmrl]
    found = subprocess.run(line, capture_output=True, text=True, env=os.environ | ONE_THREAD)
    status, seconds, most = found.stdout.split()
    if status != "0":
        raise RuntimeError(found.stderr)
    return float(seconds), float(most)


def measure(folder: Path, count: int) -> list[tuple[str, int, float, float, float]]:
    """Write the recordings and measure every command; return a row for each."""
    flights, out = folder / "flights", folder / "set"
    write_recordings(flights, count)
    works = {
        "index, new": ("index", str(flights), "--workers", "1"),
        "index, known": ("index", str(flights), "--workers", "1"),
        "find": ("find", "ok_labels > 2", str(flights), "--paths"),
        "check": ("check", str(flights), "--workers", "1"),
        "dataset": ("dataset", str(flights), str(out), "--workers", "1"),
    }
    rows = []
    for name, words in works.items():
        seconds, most = measure_cost(*words)
        rows.append((name, count, seconds, 1e3 * seconds / count, most))
        print(*rows[-1], file=sys.stderr)
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("counts", nargs="*", type=int, default=[1000, 10_000])
    parser.add_argument("--keep", type=Path, help="folder for the recordings; default: temporary")
    given = parser.parse_args()
    rows = []
    for count in given.counts:
        with tempfile.TemporaryDirectory() as scratch:
            rows += measure((given.keep or Path(scratch)) / str(count), count)
    heads = ("command", "recordings", "cpu-s", "ms per recording", "peak MB")
    print_table("", heads, sorted(rows, key=lambda row: row[0]))


if __name__ == "__main__":
    main()
