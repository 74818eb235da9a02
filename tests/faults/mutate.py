"""Damage: bytes flipped, overwritten, cut, doubled, inserted, or made extreme."""

import struct
import zlib

import numpy as np
from mcap.opcode import Opcode

EXTREMES = (b"\0" * 4, b"\xff" * 4, b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\1\0\0\0", b"\xff" * 8)


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """The same with some kind of damage; half of it near the front, where headers are."""
    out = bytearray(data)
    reach = max(1, len(out) if rng.random() < 0.5 else min(len(out), 400))
    at, size, kind = int(rng.integers(reach)), int(rng.integers(1, 64)), int(rng.integers(7))
    if kind == 0 and out:
        for place in rng.integers(len(out), size=int(rng.integers(1, 9))):
            out[int(place)] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        out[at : at + size] = rng.integers(0, 256, size, np.uint8).tobytes()
    elif kind == 2:
        del out[at:]
    elif kind == 3:
        del out[at : at + size]
    elif kind == 4:
        out[at:at] = out[at : at + size]
    elif kind == 5:
        out[at:at] = rng.integers(0, 256, size, np.uint8).tobytes()
    else:
        extreme = EXTREMES[int(rng.integers(len(EXTREMES)))]
        out[at : at + len(extreme)] = extreme
    return bytes(out)


def mutated_within(data: bytes, rng: np.random.Generator) -> bytes:
    """A recording with one record's content damaged, its length and the summary's CRC made good.

    What no checksum refuses has to be met by the code behind it.
    """
    at, records = 8, []
    while at + 9 <= len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, at)
        if at + 9 + length > len(data) - 8:
            break
        records.append((opcode, data[at + 9 : at + 9 + length]))
        at += 9 + length
    if not records:
        return mutated(data, rng)
    chosen = int(rng.integers(len(records)))
    opcode, body = records[chosen]
    records[chosen] = opcode, mutated(body, rng)
    out = bytearray(data[:8])
    start = 0
    for code, content in records:
        if code == Opcode.FOOTER and len(content) == 20 and start:
            _, offsets, _ = struct.unpack("<QQI", content)
            head = struct.pack("<BQQQ", code, 20, start, offsets)
            content = head[9:] + struct.pack("<I", zlib.crc32(head, zlib.crc32(out[start:])))
        out += struct.pack("<BQ", code, len(content)) + content
        if code == Opcode.DATA_END:
            start = len(out)
    return bytes(out) + data[-8:]
