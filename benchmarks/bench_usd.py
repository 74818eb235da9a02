"""Compare decoding micro-SD logs by dmrl with a plain Python decoder.

Run as ``python benchmarks/bench_usd.py LOG...``. The plain decoder unpacks value by value with
``struct``, appends each to a list, and converts the lists to arrays, like the script of the
firmware. Both check the CRC. They take turns, so that other load slows both alike. The process
keeps freed memory, because new pages from the system would cost as much as the decoding. Prints the
minimum CPU time of both, their ratio, and whether all values agree.
"""

import struct
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dmrl.formats.crazyflie.usd_log import decode_log

ROUNDS = 40
KEPT_BYTES = 1 << 24


def read_text(data: bytes, at: int) -> tuple[str, int]:
    """Return a zero-terminated string and the offset after it."""
    end = data.index(0, at)
    return data[at:end].decode(), end + 1


def decode_plainly(data: bytes) -> dict[str, dict[str, np.ndarray]]:
    """Decode a log value by value; return arrays by event and variable."""
    assert zlib.crc32(data[:-4]) == struct.unpack("<I", data[-4:])[0]
    version, count = struct.unpack("<HH", data[1:5])
    at, kinds = 5, {}
    found: dict[str, dict[str, list[float]]] = {}
    for _ in range(count):
        (number,) = struct.unpack("<H", data[at : at + 2])
        name, at = read_text(data, at + 2)
        (size,) = struct.unpack("<H", data[at : at + 2])
        at, names, codes = at + 2, [], "<"
        for _ in range(size):
            variable, at = read_text(data, at)
            names.append(variable[:-3])
            codes += variable[-2]
        kinds[number] = (name, names, codes, struct.calcsize(codes))
        found[name] = {key: [] for key in ("timestamp", *names)}
    head = {1: "<HI", 2: "<HQ"}[version]
    step = struct.calcsize(head)
    while at < len(data) - 4:
        number, ticks = struct.unpack(head, data[at : at + step])
        at += step
        name, names, codes, size = kinds[number]
        values = struct.unpack(codes, data[at : at + size])
        at += size
        for key, value in zip(names, values, strict=True):
            found[name][key].append(value)
        found[name]["timestamp"].append(ticks)
    return {name: {k: np.array(v) for k, v in rows.items()} for name, rows in found.items()}


def measure_cpu_ms(run: Callable[[bytes], object], data: bytes) -> float:
    """Return the CPU time of one run, milliseconds."""
    before = time.process_time()
    run(data)
    return 1e3 * (time.process_time() - before)


def agree(data: bytes) -> bool:
    """Return whether both decoders give the same values."""
    wanted = decode_plainly(data)
    return all(
        np.array_equal(column, wanted[block.name][name].astype(column.dtype), equal_nan=True)
        for block in decode_log(data).blocks
        for name, column in block.columns.items()
    )


def main(*logs: str) -> None:
    """Print a line for each log."""
    # Freeing a large block raises the threshold above which glibc returns memory to the system.
    np.empty(KEPT_BYTES, np.uint8)
    print("log, records, MB, plain ms, dmrl ms, ratio, equal")
    for name in logs:
        data = Path(name).read_bytes()
        records = sum(len(block.time_ns) for block in decode_log(data).blocks)
        rounds = [
            (
                measure_cpu_ms(decode_plainly, data),
                min(measure_cpu_ms(decode_log, data) for _ in range(10)),
            )
            for _ in range(ROUNDS)
        ]
        slow, fast = np.min(rounds, axis=0)
        line = f"{records}, {len(data) / 1e6:.2f}, {slow:.2f}, {fast:.3f}, {slow / fast:.0f}"
        print(f"{Path(name).name}, {line}, {agree(data)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
