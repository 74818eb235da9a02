"""Small messages to Arrow: dmrl's columns against mcap's iter_decoded_messages, one process.

Run as ``python benchmarks/bench_columns.py [--messages 1000000]``. Prints CPU time a message
of both (mcap's on a tenth of them) and their ratio, then the peak resident memory of dmrl on a
recording and on one ten times longer, each in a process of its own.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, iter_columns

TOPIC = "/cf1/attitude"


def write(path: Path, messages: int) -> None:
    """Write a recording with this number of attitudes, at 100 Hz."""
    with RecordingWriter(path, Provenance("bench")) as out:
        for first in range(0, messages, 1_000_000):
            k = np.arange(first, min(first + 1_000_000, messages))
            fields = {"roll_rad": k * 1e-3, "pitch_rad": 0.1, "yaw_rad": -k.astype(float)}
            out.write_columns(TOPIC, message_class("Attitude"), k * 10_000_000, fields)


def with_dmrl(path: Path) -> int:
    """Messages decoded to Arrow columns, batch by batch."""
    return sum(batch.num_rows for batch in iter_columns(path, TOPIC))


def with_mcap(path: Path) -> int:
    """Messages decoded to Python objects by mcap's own reader."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in reader.iter_decoded_messages(topics=[TOPIC]))


def cpu_us(read: Callable[[Path], int], path: Path) -> float:
    """CPU microseconds a message."""
    before = time.process_time()
    count = read(path)
    return (time.process_time() - before) / count * 1e6


def peak_mb(path: Path) -> float:
    """Peak resident memory of a fresh process that reads the recording, MB."""
    out = subprocess.run(
        [sys.executable, __file__, "--peak-of", str(path)], check=True, capture_output=True
    )
    return float(out.stdout)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--peak-of", type=Path)
    arguments = parser.parse_args()
    if arguments.peak_of:
        with_dmrl(arguments.peak_of)
        # Not ru_maxrss, which begins with that of the process that started this one.
        status = Path("/proc/self/status").read_text(encoding="utf-8")
        print(int(status.split("VmHWM:")[1].split()[0]) / 1024)
        return
    with tempfile.TemporaryDirectory() as folder:
        long, short = Path(folder) / "long.mcap", Path(folder) / "short.mcap"
        write(long, arguments.messages)
        write(short, arguments.messages // 10)
        ours = [cpu_us(with_dmrl, long) for _ in range(3)]
        theirs = cpu_us(with_mcap, short)
        print(f"{arguments.messages} messages, {long.stat().st_size / 1e6:.1f} MB")
        print(f"dmrl columns            {sorted(ours)[1]:8.2f} us a message (median of 3)")
        print(f"mcap decoded messages   {theirs:8.2f} us a message")
        print(f"ratio                   {theirs / sorted(ours)[1]:8.1f}")
        print(f"peak memory, 1/10 as long {peak_mb(short):6.1f} MB, whole {peak_mb(long):6.1f} MB")


if __name__ == "__main__":
    main()
