"""Damage data: flip, overwrite, remove, repeat or insert bytes, or set extreme values."""

import numpy as np
from mcap.opcode import Opcode

from . import parts

EXTREMES = (b"\0" * 4, b"\xff" * 4, b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\1\0\0\0", b"\xff" * 8)


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """Return the data with random damage; half of it in the first 400 bytes, near headers."""
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


def mutate_record(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a recording with one record damaged, and every checksum and offset corrected.

    The record may lie within a chunk.
    """
    records, starts = parts.split_records(data, len(parts.MAGIC), len(data) - len(parts.MAGIC))
    if not records:
        return mutate(data, rng)
    sums, moved = parts.compute_crcs(records), dict[int, int]()
    placed = list(zip(records, starts, strict=True))
    chosen = _choose_record(records, rng)
    (opcode, body), place = placed[chosen]
    inner = parts.unpack_chunk(body) if opcode == Opcode.CHUNK and rng.random() < 0.8 else None
    if inner is not None:
        kind, unpacked = inner
        changed, moved = _mutate_chunk(unpacked, rng)
        if rng.random() < 0.1:
            kind = ("zstd", "lz4", "")[int(rng.integers(3))]
        placed[chosen] = (opcode, parts.pack_chunk(body, kind, changed)), place
    else:
        placed[chosen : chosen + 1] = _change_record(placed[chosen], rng)
    return parts.join_records(placed, moved, sums)


def _choose_record(records: list[parts.Record], rng: np.random.Generator) -> int:
    """Return the index of a random record; every second time of one with messages."""
    full = [k for k, (opcode, _) in enumerate(records) if opcode in (Opcode.CHUNK, Opcode.MESSAGE)]
    return int(rng.choice(full)) if full and rng.random() < 0.5 else int(rng.integers(len(records)))


def _change_record(
    placed: tuple[parts.Record, int], rng: np.random.Generator
) -> list[tuple[parts.Record, int]]:
    """Return a record damaged, repeated or removed; repeated ones have the old offset -1."""
    (opcode, body), place = placed
    kind = rng.random()
    if kind < 0.08:
        return []
    if kind < 0.16:
        return [placed, ((opcode, body), -1)]
    if kind < 0.2:
        return [((int(rng.integers(0x11)), body), place)]
    if opcode == Opcode.MESSAGE and len(body) > 22 and rng.random() < 0.7:
        return [((opcode, body[:22] + mutate_message(body[22:], rng)), place)]
    return [((opcode, mutate(body, rng)), place)]


def _mutate_chunk(data: bytes, rng: np.random.Generator) -> tuple[bytes, dict[int, int]]:
    """Damage one record of a chunk; return all records and the new offset of each old one."""
    records, starts = parts.split_records(data)
    if not records:
        return mutate(data, rng), {}
    placed = list(zip(records, starts, strict=True))
    chosen = int(rng.integers(len(placed)))
    placed[chosen : chosen + 1] = _change_record(placed[chosen], rng)
    out, moved = bytearray(), {}
    for record, place in placed:
        moved[place] = len(out)
        out += parts.pack_record(record)
    moved.pop(-1, None)
    return bytes(out), moved


def mutate_message(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a protobuf message with one field damaged, repeated, removed or of another type."""
    fields = _find_fields(data)
    if not fields or rng.random() < 0.3:
        return mutate(data, rng)
    start, at, end = fields[int(rng.integers(len(fields)))]
    key, value = data[start:at], data[at:end]
    kind = int(rng.integers(6))
    if kind == 0:
        new = b""
    elif kind == 1:
        new = (key + value) * 2
    elif kind == 2:
        new = bytes([int(rng.integers(128))]) + value
    elif kind == 3:
        new = key + EXTREMES[int(rng.integers(len(EXTREMES)))][: max(1, len(value))]
    elif kind == 4 and key[0] & 7 == 2:
        inner = mutate_message(value[1:], rng) if len(value) > 1 else b"\0"
        new = key + _encode_varint(len(inner)) + inner
    else:
        new = key + _encode_varint(int(rng.integers(1 << 62)) * 2 + 1)
    return data[:start] + new + data[end:]


def _find_fields(data: bytes) -> list[tuple[int, int, int]]:
    """Return the offsets of start, value and end of every field that can be parsed."""
    found, at = [], 0
    while at < len(data):
        start, kind = at, data[at] & 7
        at = value = _skip_varint(data, at)
        if kind == 0:
            at = _skip_varint(data, at)
        elif kind == 2 and at < len(data) and data[at] < 128:
            at += 1 + data[at]
        elif kind in (1, 5):
            at += 8 if kind == 1 else 4
        else:
            break
        if at > len(data):
            break
        found.append((start, value, at))
    return found


def _skip_varint(data: bytes, at: int) -> int:
    while at < len(data) and data[at] >= 128:
        at += 1
    return at + 1


def _encode_varint(value: int) -> bytes:
    """Return an integer as a protobuf varint."""
    out = bytearray()
    while value >= 128:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])
