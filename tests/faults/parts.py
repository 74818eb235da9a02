"""The parts of an MCAP file, separated and joined again with correct checksums and offsets.

What no checksum and no index refuses has to be met by the code behind them. Written by the
specification, apart from dmrl and from mcap: both would stop at the first wrong byte.
"""

import struct
import zlib
from collections.abc import Sequence

import lz4.frame
import zstandard
from mcap.opcode import Opcode

MAGIC = b"\x89MCAP0\r\n"
Record = tuple[int, bytes]
CHUNK_HEAD = struct.Struct("<QQQI")


def taken_apart(data: bytes, at: int = 0, end: int | None = None) -> tuple[list[Record], list[int]]:
    """Records, and where each began, up to the first that is not whole."""
    end = len(data) if end is None else end
    records, starts = [], []
    while at + 9 <= end:
        opcode, length = struct.unpack_from("<BQ", data, at)
        if at + 9 + length > end:
            break
        starts.append(at)
        records.append((opcode, data[at + 9 : at + 9 + length]))
        at += 9 + length
    return records, starts


def written(record: Record) -> bytes:
    """A record as it stands in a file."""
    return struct.pack("<BQ", record[0], len(record[1])) + record[1]


def chunk_parts(body: bytes) -> tuple[str, bytes] | None:
    """Compression and unpacked records of a chunk; None where they cannot be had."""
    try:
        (length,) = struct.unpack_from("<I", body, CHUNK_HEAD.size)
        at = CHUNK_HEAD.size + 4
        kind = body[at : at + length].decode()
        data = body[at + length + 8 :]
        size = CHUNK_HEAD.unpack_from(body)[2]
        if kind == "zstd":
            return kind, zstandard.ZstdDecompressor().decompress(data, min(size, 1 << 20))
        return (kind, lz4.frame.decompress(data)) if kind == "lz4" else (kind, data)
    except (struct.error, ValueError, RuntimeError, zstandard.ZstdError):
        return None


def chunk_of(head: bytes, kind: str, inner: bytes) -> bytes:
    """A chunk that holds these records, with the times of another."""
    first, last = struct.unpack_from("<QQ", head)
    pack = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}.get(kind, bytes)
    data = pack(inner)
    head = CHUNK_HEAD.pack(first, last, len(inner), zlib.crc32(inner))
    return head + struct.pack("<I", len(kind)) + kind.encode() + struct.pack("<Q", len(data)) + data


def put_together(
    records: Sequence[tuple[Record, int]], moved: dict[int, int], sums: tuple[int, int]
) -> bytes:
    """A file of records, each with its place in the file before; None of its old places is left.

    Parameters
    ----------
    records
        Record, and where it was; -1: nowhere.
    moved
        Old and new places within chunks.
    sums
        CRC-32 of the metadata and of the message indexes in the file before, as dmrl keeps them.
    """
    at, places = len(MAGIC), {}
    for record, old in records:
        places.setdefault(old, (at, 9 + len(record[1])))
        at += 9 + len(record[1])
    places.pop(-1, None)
    out, start, metadata, indexes = bytearray(MAGIC), 0, 0, 0
    for (opcode, body), _ in records:
        if opcode == Opcode.MESSAGE_INDEX:
            body = _moved_index(body, moved)
            indexes = zlib.crc32(written((opcode, body)), indexes)
        elif opcode == Opcode.METADATA:
            for before, now in zip(sums, (metadata, indexes), strict=True):
                body = body.replace(f"{before:08x}".encode(), f"{now:08x}".encode())
            metadata = zlib.crc32(written((opcode, body)), metadata)
        elif opcode == Opcode.ATTACHMENT and len(body) > 4:
            body = body[:-4] + struct.pack("<I", zlib.crc32(body[:-4]))
        elif opcode == Opcode.FOOTER and len(body) == 20:
            offsets = places.get(struct.unpack_from("<Q", body, 8)[0], (0, 0))[0]
            head = struct.pack("<BQQQ", opcode, 20, start, offsets)
            crc = zlib.crc32(head, zlib.crc32(out[start:])) if body[16:] != bytes(4) else 0
            body = head[9:] + struct.pack("<I", crc)
        else:
            body = _moved(opcode, body, places)
        out += written((opcode, body))
        if opcode == Opcode.DATA_END:
            start = len(out)
    return bytes(out) + MAGIC


def sums_of(records: Sequence[Record]) -> tuple[int, int]:
    """CRC-32 of all metadata but the last, and of the message indexes."""
    metadata = [record for record in records if record[0] == Opcode.METADATA][:-1]
    indexes = [record for record in records if record[0] == Opcode.MESSAGE_INDEX]
    return zlib.crc32(b"".join(map(written, metadata))), zlib.crc32(b"".join(map(written, indexes)))


def _moved_index(body: bytes, moved: dict[int, int]) -> bytes:
    out = bytearray(body)
    for at in range(6, len(out) - 15, 16):
        (place,) = struct.unpack_from("<Q", out, at + 8)
        struct.pack_into("<Q", out, at + 8, moved.get(place, place))
    return bytes(out)


def _moved(opcode: int, body: bytes, places: dict[int, tuple[int, int]]) -> bytes:
    """The record with the places of others, and their lengths, as they are now."""
    out = bytearray(body)
    first = {Opcode.CHUNK_INDEX: 16, Opcode.METADATA_INDEX: 0, Opcode.ATTACHMENT_INDEX: 0}
    if opcode in first and len(out) >= first[opcode] + 16:
        at = first[opcode]
        old = struct.unpack_from("<QQ", out, at)
        struct.pack_into("<QQ", out, at, *places.get(old[0], old))
    if opcode == Opcode.CHUNK_INDEX and len(out) >= 36:
        for at in range(36, min(36 + struct.unpack_from("<I", out, 32)[0], len(out) - 9), 10):
            (old_at,) = struct.unpack_from("<Q", out, at + 2)
            struct.pack_into("<Q", out, at + 2, places.get(old_at, (old_at, 0))[0])
    if opcode == Opcode.SUMMARY_OFFSET and len(out) >= 17:
        (old_at,) = struct.unpack_from("<Q", out, 1)
        struct.pack_into("<Q", out, 1, places.get(old_at, (old_at, 0))[0])
    return bytes(out)
