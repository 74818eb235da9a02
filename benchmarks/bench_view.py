"""Measure CPU time and memory to prepare a long flight for the viewer.

Run as ``python benchmarks/bench_view.py [RECORDING] [--minutes 5]``. By default it makes a flight
of two robots with a camera each, 20 images per second, labels of truth and estimate, detections and
maps. Images are drawn once per second and repeated, which costs the viewer the same. Each .rrd file
is written in its own process: by ``dmrl view`` from the recording and from its first half, and by
rerun's own importer of MCAP for comparison, which shows no labels, detections or plots.
bench_view_first.py measures the time to the first image.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from dmrl import topics
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, read, read_summary, trim
from dmrl.stages import fly
from dmrl.viewer import Settings, save
from dmrl.viewer.window import viewer_process

RATE_HZ = 20
ROWS, COLS = 28, 40


def write(path: Path, minutes: float) -> int:
    """Simulate and write the flight; return the number of images."""
    flown = path.with_name(f"flown-{path.name}")
    settings = fly.Settings(duration_s=60 * minutes, camera=True, camera_rate_hz=1.0)
    fly.run(flown, settings)
    rng = np.random.default_rng(0)
    count = 0
    with RecordingWriter(path, Provenance("bench")) as sink:
        for stamped in read(flown):
            names = topics.parse_topic(topics.CAMERA_IMAGE, stamped.topic)
            labelled = topics.parse_topic(topics.LABELS, stamped.topic)
            if names is None and labelled is None:
                _copy(sink, stamped)
                continue
            robot = (names or labelled or {})["robot"]
            for k in range(RATE_HZ):
                time_ns = stamped.time_ns + k * 1_000_000_000 // RATE_HZ
                if names is not None:
                    count += 1
                    sink.write(time_ns, stamped.topic, stamped.message)
                    _predict(sink, time_ns, robot, rng)
                else:
                    sink.write(time_ns, stamped.topic, _with_estimates(stamped.message))
    flown.unlink()
    return count


def _copy(sink: RecordingWriter, stamped) -> None:  # noqa: ANN001
    """Copy a message; write true positions once more as estimates with a covariance."""
    sink.write(stamped.time_ns, stamped.topic, stamped.message)
    names = topics.parse_topic(topics.TRUTH, stamped.topic)
    if names is not None:
        guess = message_class("PeerPosition")()
        guess.CopyFrom(stamped.message)
        guess.covariance[:] = [0.01, 0, 0, 0, 0.02, 0, 0, 0, 0.002]
        sink.write(stamped.time_ns, topics.POSITION(**names), guess)


def _with_estimates(labels):  # noqa: ANN001, ANN202
    """Return labels with an estimated label beside each true one."""
    both = message_class("PeerLabels")()
    both.CopyFrom(labels)
    for label in labels.peers:
        sigmas = {"sigma_u_px": 15.0, "sigma_v_px": 8.0, "sigma_depth_m": 0.1}
        values = {"peer": label.peer, "u_px": label.u_px + 5, "v_px": label.v_px + 3}
        both.peers.add(source="estimate", depth_m=label.depth_m, **values, **sigmas)
    return both


def _predict(sink: RecordingWriter, time_ns: int, robot: str, rng: np.random.Generator) -> None:
    """Write ten random detections and a random grid."""
    cells = rng.random((2, ROWS, COLS), np.float32)
    found = [
        {"u_px": u, "v_px": v, "depth_m": 1.0, "confidence": c}
        for u, v, c in zip(*rng.uniform(0, [[320], [224], [1]], (3, 10)), strict=True)
    ]
    channels = ["confidence", "depth_m"]
    grid = message_class("GridMap")(rows=ROWS, cols=COLS, channels=channels, data=cells.tobytes())
    sink.write(time_ns, topics.DETECTIONS(robot), message_class("Detections")(detections=found))
    sink.write(time_ns, topics.GRID(robot), grid)


def measure_dmrl(path: Path, out: Path, layout: str) -> dict[str, float]:
    """Return CPU seconds, peak memory and file size of ``dmrl view --save``."""
    begun = time.process_time()
    save([path], out, Settings(layout=layout))  # type: ignore[arg-type]
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"cpu_s": time.process_time() - begun, "peak_mb": peak_mb, "rrd_mb": read_size_mb(out)}


def measure_rerun(path: Path, out: Path) -> dict[str, float]:
    """Return CPU seconds, peak memory and file size of rerun's own importer of MCAP."""
    program = viewer_process.build_command(viewer_process.LOOPBACK)[0]
    subprocess.run([program, "mcap", "convert", str(path), "-o", str(out)], check=True)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak_mb": used.ru_maxrss / 1024,
        "rrd_mb": read_size_mb(out),
    }


def read_size_mb(path: Path) -> float:
    """Return the size of a file, MB."""
    return path.stat().st_size / 1e6


def run_in_process(*arguments: object) -> dict[str, float]:
    """Run this script with some arguments in a new process; return the figures it prints."""
    command = [sys.executable, __file__, *map(str, arguments)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def measure(what: str, path: Path, layout: str) -> dict[str, float]:
    """Measure rerun or dmrl in this process, and remove the file it writes."""
    out = path.with_suffix(f".{what}.rrd")
    try:
        return measure_rerun(path, out) if what == "rerun" else measure_dmrl(path, out, layout)
    finally:
        out.unlink(missing_ok=True)


def main() -> None:
    """Print the table of each layout."""
    if sys.argv[1:2] == ["measure"]:
        print(json.dumps(measure(sys.argv[2], Path(sys.argv[3]), sys.argv[4])))
        return
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path, nargs="?")
    parser.add_argument("--minutes", type=float, default=5.0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        long, half = given.recording or Path(scratch) / "long.mcap", Path(scratch) / "half.mcap"
        if given.recording is None:
            print(f"{write(long, given.minutes)} images", flush=True)
        held = read_summary(long)
        middle_ns = (held.start_ns + held.end_ns) // 2
        trim(long, half, end_ns=middle_ns)
        print(
            f"{long.name}: {read_size_mb(long):.0f} MB, {(held.end_ns - held.start_ns) / 1e9:.0f} s"
        )
        peer = run_in_process("measure", "rerun", long, "-")
        print(f"{'':<26}{'cpu-s':>8}{'peak MB':>10}{'.rrd MB':>10}")
        rows = {"rerun mcap convert": peer}
        for layout in ("image", "flight"):
            rows[f"dmrl view, {layout}"] = run_in_process("measure", "dmrl", long, layout)
            rows["  half the length"] = run_in_process("measure", "dmrl", half, layout)
            for name, row in rows.items():
                print(f"{name:<26}{row['cpu_s']:8.1f}{row['peak_mb']:10.0f}{row['rrd_mb']:10.0f}")
            shown = rows[f"dmrl view, {layout}"]
            print(f"{'  CPU ratio to rerun':<26}{shown['cpu_s'] / peer['cpu_s']:8.2f}")
            rows = {}


if __name__ == "__main__":
    main()
