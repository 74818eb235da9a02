"""Compare reading small messages as dmrl's Arrow columns with mcap's iter_decoded_messages.

Run as ``python benchmarks/bench_columns.py [--messages 1000000]``. Prints the CPU time per message
of both and their ratio; mcap reads a tenth of the messages. Then prints the peak resident memory
of dmrl for a recording and for one of a tenth of its length, each in its own process.
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


def read_with_dmrl(path: Path) -> int:
    """Decode the messages to Arrow columns, batch by batch; return their number."""
    return sum(batch.num_rows for batch in iter_columns(path, TOPIC))


def read_with_mcap(path: Path) -> int:
    """Decode the messages to Python objects by mcap's own reader; return their number."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in reader.iter_decoded_messages(topics=[TOPIC]))


def measure_cpu_us(read: Callable[[Path], int], path: Path) -> float:
    """Return the CPU time per message, microseconds."""
    before = time.process_time()
    count = read(path)
    return (time.process_time() - before) / count * 1e6


def measure_peak_mb(path: Path) -> float:
    """Return the peak resident memory of a fresh process that reads the recording, MB."""
    out = subprocess.run(
        [sys.executable, __file__, "--peak-of", str(path)], check=True, capture_output=True
    )
    return float(out.stdout)


def main() -> None:
    """Print CPU times, their ratio and the peak memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--peak-of", type=Path)
    arguments = parser.parse_args()
    if arguments.peak_of:
        read_with_dmrl(arguments.peak_of)
        # VmHWM, because ru_maxrss starts at the peak of the parent process.
        status = Path("/proc/self/status").read_text(encoding="utf-8")
        print(int(status.split("VmHWM:")[1].split()[0]) / 1024)
        return
    with tempfile.TemporaryDirectory() as folder:
        long, short = Path(folder) / "long.mcap", Path(folder) / "short.mcap"
        write(long, arguments.messages)
        write(short, arguments.messages // 10)
        ours = [measure_cpu_us(read_with_dmrl, long) for _ in range(3)]
        theirs = measure_cpu_us(read_with_mcap, short)
        print(f"{arguments.messages} messages, {long.stat().st_size / 1e6:.1f} MB")
        print(f"dmrl columns            {sorted(ours)[1]:8.2f} us per message (median of 3)")
        print(f"mcap decoded messages   {theirs:8.2f} us per message")
        print(f"ratio                   {theirs / sorted(ours)[1]:8.1f}")
        tenth_mb, whole_mb = measure_peak_mb(short), measure_peak_mb(long)
        print(f"peak memory: a tenth {tenth_mb:6.1f} MB, all messages {whole_mb:6.1f} MB")


if __name__ == "__main__":
    main()
