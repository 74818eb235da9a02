"""Micro-SD logs written and read value by value, as a reference for the fast decoder."""

import struct
import zlib
from collections.abc import Sequence

Variables = Sequence[tuple[str, str]]
Record = tuple[int, int, tuple[float, ...]]


def encode(
    events: dict[int, tuple[str, Variables]], records: Sequence[Record], version: int = 2
) -> bytes:
    """Return a log with these events, by id, and records of id, time in ticks, and values."""
    out = bytearray(struct.pack("<BHH", 0xBC, version, len(events)))
    for number, (name, variables) in events.items():
        out += struct.pack("<H", number) + name.encode() + b"\0"
        out += struct.pack("<H", len(variables))
        for variable, code in variables:
            out += f"{variable}({code})".encode() + b"\0"
    time = {1: "I", 2: "Q"}[version]
    for number, ticks, values in records:
        codes = "".join(code for _, code in events[number][1])
        out += struct.pack(f"<H{time}{codes}", number, ticks, *values)
    return bytes(out + struct.pack("<I", zlib.crc32(out)))


def decode(data: bytes) -> dict[str, dict[str, list[float]]]:
    """Return the values of each variable of each event; times in ticks are in "timestamp"."""
    _, version, count = struct.unpack_from("<BHH", data)
    at, kinds, found = 5, {}, {}
    for _ in range(count):
        (number,) = struct.unpack_from("<H", data, at)
        end = data.index(0, at + 2)
        name = data[at + 2 : end].decode()
        (size,) = struct.unpack_from("<H", data, end + 1)
        at, names, codes = end + 3, [], "<"
        for _ in range(size):
            end = data.index(0, at)
            text = data[at:end].decode()
            names.append(text[:-3])
            codes += text[-2]
            at = end + 1
        kinds[number] = (name, names, codes, struct.calcsize(codes))
        found[name] = {key: [] for key in ("timestamp", *names)}
    time = {1: "<HI", 2: "<HQ"}[version]
    while at < len(data) - 4:
        number, ticks = struct.unpack_from(time, data, at)
        at += struct.calcsize(time)
        name, names, codes, size = kinds[number]
        values = struct.unpack_from(codes, data, at)
        at += size
        table = found[name]
        for key, value in zip(names, values, strict=True):
            table[key].append(value)
        table["timestamp"].append(ticks)
    return found
