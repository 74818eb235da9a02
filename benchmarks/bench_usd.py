"""Micro-SD logs to arrays: dmrl against a plain decoder in Python, one process.

Run as ``python benchmarks/bench_usd.py LOG...``. The plain decoder unpacks value by value with
``struct``, appends each to its list, and makes arrays of the lists in the end, as the script
that comes with the firmware and its users do. Both check the CRC. They take turns, so that a busy
machine slows both down, and the process keeps the memory that it frees: pages new from the system
would cost as much as the decoding. Prints CPU time of both, the best of some rounds each, their
ratio, and whether every value agrees.
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


def text(data: bytes, at: int) -> tuple[str, int]:
    """Return a string that ends in 0, and its end."""
    end = data.index(0, at)
    return data[at:end].decode(), end + 1


def plain(data: bytes) -> dict[str, dict[str, np.ndarray]]:
    """Arrays by event and variable, value by value."""
    assert zlib.crc32(data[:-4]) == struct.unpack("<I", data[-4:])[0]
    version, count = struct.unpack("<HH", data[1:5])
    at, kinds = 5, {}
    found: dict[str, dict[str, list[float]]] = {}
    for _ in range(count):
        (number,) = struct.unpack("<H", data[at : at + 2])
        name, at = text(data, at + 2)
        (size,) = struct.unpack("<H", data[at : at + 2])
        at, names, codes = at + 2, [], "<"
        for _ in range(size):
            variable, at = text(data, at)
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


def cpu_ms(run: Callable[[bytes], object], data: bytes) -> float:
    """CPU milliseconds of one run."""
    before = time.process_time()
    run(data)
    return 1e3 * (time.process_time() - before)


def agree(data: bytes) -> bool:
    """Whether both find the same values."""
    wanted = plain(data)
    return all(
        np.array_equal(column, wanted[block.name][name].astype(column.dtype), equal_nan=True)
        for block in decode_log(data).blocks
        for name, column in block.columns.items()
    )


def main(*logs: str) -> None:
    """One line per log."""
    # The C library gives nothing back below twice the largest block that it saw freed.
    np.empty(KEPT_BYTES, np.uint8)
    print("log, records, MB, plain ms, dmrl ms, ratio, equal")
    for name in logs:
        data = Path(name).read_bytes()
        records = sum(len(block.time_ns) for block in decode_log(data).blocks)
        rounds = [
            (cpu_ms(plain, data), min(cpu_ms(decode_log, data) for _ in range(10)))
            for _ in range(ROUNDS)
        ]
        slow, fast = np.min(rounds, axis=0)
        line = f"{records}, {len(data) / 1e6:.2f}, {slow:.2f}, {fast:.3f}, {slow / fast:.0f}"
        print(f"{Path(name).name}, {line}, {agree(data)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
