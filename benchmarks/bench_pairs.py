"""Compare the costs of this dmrl with those of another installation, usually an older commit.

    python benchmarks/bench_pairs.py OTHER/.venv/bin/python [--rounds 5] [--only NAME ...]
        [--folder DIR]

Both run in turns. Prints for each row the median of both, the median ratio of the pairs, and the
cost of another package in the same rounds, if there is one for this row. Each figure is the CPU
time of a process with one thread, or is printed by that process. The other installation makes the
input files in DIR, which a later run reuses: 0.5 GB, and 6 GB more for `info`. Without ``--only``,
all rows are measured.
"""

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

MAIN = "from dmrl.cli import main; main()"
PICTURES = """
import numpy as np
from pathlib import Path
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter
def write(name, count, size, attitudes=0):
    data = np.random.default_rng(1).bytes(8_000_000 + size)
    with RecordingWriter(Path(name), Provenance("bench")) as out:
        for k in range(count):
            for part in range(attitudes):
                at = k * 40_000_000 + part * 10_000_000
                out.write(at, "/cf1/attitude", message_class("Attitude")(roll_rad=k))
            start = k * size % 8_000_000
            picture = message_class("CompressedImage")(data=data[start : start + size])
            out.write(k * 40_000_000, "/cf1/camera/image", picture)
"""
ATTITUDES = """
import numpy as np
from pathlib import Path
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter
def write(name, count, topic):
    Path(name).parent.mkdir(exist_ok=True)
    with RecordingWriter(Path(name), Provenance("bench")) as out:
        for first in range(0, count, 1_000_000):
            k = np.arange(first, min(first + 1_000_000, count))
            fields = {"roll_rad": k * 1e-3, "pitch_rad": 0.1, "yaw_rad": -k.astype(float)}
            out.write_columns(topic, message_class("Attitude"), k * 10_000_000, fields)
"""
CUT = """
from pathlib import Path
data = Path("flight.mcap").read_bytes()
for folder, count in (("one", 1), ("twelve", 12)):
    Path(folder).mkdir()
    for k in range(count):
        (Path(folder) / f"{k}.mcap").write_bytes(data[: len(data) * 2 // 3])
"""
TIMED = """
import time
def spent(work):
    before = time.process_time()
    work()
    return time.process_time() - before
"""
READ = (
    TIMED
    + """
import dmrl
from pathlib import Path
from dmrl.recording import read_table
read_table(Path("few.mcap"), "/cf1/camera/image")  # a warm-up: imports and caches
"""
)
WINDOW = """
import random
topic, pick = dmrl.open("six.mcap")["/cf1/attitude"], random.Random(1)
def windows(count):
    for _ in range(count):
        first = pick.uniform(0, 1000)
        topic.to_arrow(start_s=first, end_s=first + 1)
windows(20)
print(1e3 * spent(lambda: windows(200)) / 200)
"""
UNPACK = (
    TIMED
    + """
from mcap.records import Chunk
from mcap.stream_reader import StreamReader, get_chunk_data_stream
def unpack():
    with open("pictures.mcap", "rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Chunk):
                get_chunk_data_stream(record, validate_crc=True)
unpack()
print(spent(unpack) / 0.5)
"""
)
DECODE = (
    TIMED
    + """
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
def decode():
    with open("short.mcap", "rb") as stream:
        for _ in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            pass
print(spent(decode) / 0.1)
"""
)
SUMMARY = (
    TIMED
    + """
from mcap.reader import make_reader
def summary():
    with open("six.mcap", "rb") as stream:
        make_reader(stream).get_summary()
print(spent(summary))
"""
)


def dmrl(line: str) -> tuple[str, ...]:
    """Return the code and arguments that run a command of dmrl."""
    return MAIN, *line.split()


PICTURE_TOPIC = "read_table(Path('pictures.mcap'), '/cf1/camera/image')"
ATTITUDE_TOPIC = "read_table(Path('long.mcap'), '/cf1/attitude')"
MATERIAL: Mapping[str, tuple[str, ...]] = {
    "flight.mcap": dmrl("fly fly_in_view flight.mcap --duration-s 100 --camera"),
    "few.mcap": dmrl("trim flight.mcap few.mcap --to-s 1"),
    "twelve": (CUT,),
    "short.mcap": (ATTITUDES + "write('short.mcap', 100_000, '/cf1/attitude')",),
    "long.mcap": (ATTITUDES + "write('long.mcap', 10_000_000, '/cf1/attitude')",),
    "pictures.mcap": (PICTURES + "write('pictures.mcap', 12_500, 40_000)",),
    "six.mcap": (PICTURES + "write('six.mcap', 25_200, 240_000, 4)",),
    "1": (ATTITUDES + "write('1/million.mcap', 1_000_000, '/cf1/attitude')",),
    "10": (ATTITUDES + "write('10/million.mcap', 10_000_000, '/cf1/attitude')",),
}
"""Code that makes each input file."""


@dataclass(frozen=True, slots=True)
class Row:
    """How a figure is measured.

    Parameters
    ----------
    code
        Code to run, and its arguments.
    unit
        Unit of the figure.
    needs
        Input files.
    less
        Code and arguments of a run whose figure is subtracted, such as the start-up.
    over
        Divisor of the figure.
    peer
        Code of another package for comparison.
    prints
        The code prints its figure; otherwise it is the CPU time, seconds.
    peak
        The figure is the peak memory, MB.
    """

    code: tuple[str, ...]
    unit: str
    needs: tuple[str, ...] = ()
    less: tuple[str, ...] = ()
    over: int = 1
    peer: tuple[str, ...] = ()
    prints: bool = False
    peak: bool = False


ROWS: Mapping[str, Row] = {
    "a recording that fails": Row(
        dmrl("trim twelve out --workers 1"),
        "CPU-s",
        ("flight.mcap", "twelve"),
        less=dmrl("trim one out --workers 1"),
        over=11,
    ),
    "window of 1 s in 6 GB": Row((READ + WINDOW,), "ms", ("few.mcap", "six.mcap"), prints=True),
    "pictures": Row(
        (READ + f"print(spent(lambda: {PICTURE_TOPIC}) / 0.5)",),
        "CPU-s/GB",
        ("pictures.mcap",),
        peer=(UNPACK,),
        prints=True,
    ),
    "attitudes": Row(
        (READ + f"print(spent(lambda: {ATTITUDE_TOPIC}) / 10)",),
        "us",
        ("long.mcap", "short.mcap"),
        peer=(DECODE,),
        prints=True,
    ),
    "predict, start": Row(
        dmrl("predict dmrl-nano few.mcap out.mcap --backend onnx"),
        "CPU-s",
        ("flight.mcap", "few.mcap"),
    ),
    "label, start": Row(
        ("import dmrl.cli, dmrl.stages.label, dmrl.labelling.label_flight",), "CPU-s", less=("",)
    ),
    "small dataset": Row(
        dmrl("dataset few.mcap out --labels truth --workers 1"),
        "CPU-s",
        ("flight.mcap", "few.mcap"),
    ),
    "write pictures": Row(
        (TIMED + PICTURES + "print(spent(lambda: write('out.mcap', 12_500, 40_000)) / 0.5)",),
        "CPU-s/GB",
        prints=True,
    ),
    "info of 6 GB": Row(
        dmrl("info six.mcap"),
        "CPU-s",
        ("flight.mcap", "few.mcap", "six.mcap"),
        less=dmrl("info few.mcap"),
        peer=(SUMMARY,),
    ),
    **{
        f"memory of {line.split()[0]}, 1 M to 10 M": Row(
            dmrl(line.format("10")),
            "MB",
            ("1", "10", "short.mcap"),
            less=dmrl(line.format("1")),
            peak=True,
        )
        for line in (
            "info {}/million.mcap",
            "check {}/million.mcap",
            "index {} --workers 1",
            "merge short.mcap {}/million.mcap out.mcap",
        )
    },
}


def run(python: str, words: Sequence[str], folder: Path, how: Row | None = None) -> float:
    """Run some code; return its CPU time, seconds, its peak memory, MB, or the number it prints."""
    prints = how is not None and how.prints
    for old in [folder / "out", folder / "out.mcap", *folder.glob("*/catalogue.parquet")]:
        shutil.rmtree(old) if old.is_dir() else old.unlink(missing_ok=True)
    command = [python, "-P", "-c", *words]
    pipe = subprocess.PIPE if prints else subprocess.DEVNULL
    process = subprocess.Popen(command, cwd=folder, stdout=pipe, stderr=subprocess.DEVNULL)
    text = process.stdout.read() if process.stdout else b""
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    # A command on a folder with damaged recordings exits with 1.
    if process.returncode not in (0, 1) or (prints and not text):
        raise SystemExit(f"{' '.join(command)[-300:]} ended with {process.returncode}")
    if how is not None and how.peak:
        return used.ru_maxrss / 1024
    return float(text) if prints else used.ru_utime + used.ru_stime


def measure(python: str, row: Row, folder: Path) -> float:
    """Return the figure of a row, measured with one interpreter."""
    value = run(python, row.code, folder, row)
    if row.less:
        value -= run(python, row.less, folder, replace(row, prints=False))
    return value / row.over


def main() -> None:
    """Print a line for each row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("other", help="interpreter of the other installation")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", nargs="*", default=list(ROWS), choices=list(ROWS))
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed dmrl has bytecode on disk
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.folder or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        print(f"{'':32}{'other':>9}{'this':>9}{'ratio':>8}{'peer':>9}")
        for name in given.only:
            row = ROWS[name]
            for file in row.needs:
                if not (folder / file).exists():
                    run(given.other, MATERIAL[file], folder)
                if not (folder / file).exists():
                    raise SystemExit(f"{file} could not be made for {name}")
            pythons = (given.other, sys.executable)
            for python in pythons:
                measure(python, row, folder)  # a warm-up: bytecode and caches
            pairs, peers = [], []
            for _ in range(given.rounds):
                pairs.append([measure(python, row, folder) for python in pythons])
                if row.peer:
                    peers.append(run(sys.executable, row.peer, folder, replace(row, prints=True)))
            before, after = (statistics.median(each) for each in zip(*pairs, strict=True))
            ratio = statistics.median(this / other for other, this in pairs)
            peer = f"{statistics.median(peers):9.3f}" if peers else ""
            print(f"{name:32}{before:9.3f}{after:9.3f}{ratio:8.2f}{peer:9} {row.unit}", flush=True)


if __name__ == "__main__":
    main()
