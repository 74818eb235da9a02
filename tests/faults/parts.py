"""Split an MCAP file into records, and join them again with correct checksums and offsets.

Damage then passes every checksum and reaches the code behind them. The module uses neither dmrl
nor the mcap package, since both would stop at the first wrong byte.
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


def split_records(
    data: bytes, at: int = 0, end: int | None = None
) -> tuple[list[Record], list[int]]:
    """Return the complete records before ``end``, and the offset of each."""
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


def pack_record(record: Record) -> bytes:
    """Return a record as bytes: opcode, length and body."""
    return struct.pack("<BQ", record[0], len(record[1])) + record[1]


def unpack_chunk(body: bytes) -> tuple[str, bytes] | None:
    """Return compression and decompressed records of a chunk, or None if it is damaged."""
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


def pack_chunk(head: bytes, kind: str, inner: bytes) -> bytes:
    """Return a chunk of these records, with the first and last time of the chunk ``head``."""
    first, last = struct.unpack_from("<QQ", head)
    pack = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}.get(kind, bytes)
    data = pack(inner)
    head = CHUNK_HEAD.pack(first, last, len(inner), zlib.crc32(inner))
    return head + struct.pack("<I", len(kind)) + kind.encode() + struct.pack("<Q", len(data)) + data


def join_records(
    records: Sequence[tuple[Record, int]], moved: dict[int, int], sums: tuple[int, int]
) -> bytes:
    """Return a file of these records, with every offset and checksum corrected.

    Parameters
    ----------
    records
        Each record and its old offset in the file; -1 for a new record.
    moved
        New offset of each old one within chunks.
    sums
        CRC-32 of the metadata and of the message indexes of the old file, as dmrl stores them.
    """
    at, places = len(MAGIC), {}
    for record, old in records:
        places.setdefault(old, (at, 9 + len(record[1])))
        at += 9 + len(record[1])
    places.pop(-1, None)
    out, start, metadata, indexes = bytearray(MAGIC), 0, 0, 0
    for (opcode, body), _ in records:
        if opcode == Opcode.MESSAGE_INDEX:
            body = _correct_message_index(body, moved)
            indexes = zlib.crc32(pack_record((opcode, body)), indexes)
        elif opcode == Opcode.METADATA:
            for before, now in zip(sums, (metadata, indexes), strict=True):
                body = body.replace(f"{before:08x}".encode(), f"{now:08x}".encode())
            metadata = zlib.crc32(pack_record((opcode, body)), metadata)
        elif opcode == Opcode.ATTACHMENT and len(body) > 4:
            body = body[:-4] + struct.pack("<I", zlib.crc32(body[:-4]))
        elif opcode == Opcode.FOOTER and len(body) == 20:
            offsets = places.get(struct.unpack_from("<Q", body, 8)[0], (0, 0))[0]
            head = struct.pack("<BQQQ", opcode, 20, start, offsets)
            crc = zlib.crc32(head, zlib.crc32(out[start:])) if body[16:] != bytes(4) else 0
            body = head[9:] + struct.pack("<I", crc)
        else:
            body = _correct_offsets(opcode, body, places)
        out += pack_record((opcode, body))
        if opcode == Opcode.DATA_END:
            start = len(out)
    return bytes(out) + MAGIC


def compute_crcs(records: Sequence[Record]) -> tuple[int, int]:
    """Return the CRC-32 of all metadata but the last, and of the message indexes."""
    metadata = [record for record in records if record[0] == Opcode.METADATA][:-1]
    indexes = [record for record in records if record[0] == Opcode.MESSAGE_INDEX]
    return zlib.crc32(b"".join(map(pack_record, metadata))), zlib.crc32(
        b"".join(map(pack_record, indexes))
    )


def _correct_message_index(body: bytes, moved: dict[int, int]) -> bytes:
    """Return a message index with the new offsets of its messages within the chunk."""
    out = bytearray(body)
    for at in range(6, len(out) - 15, 16):
        (place,) = struct.unpack_from("<Q", out, at + 8)
        struct.pack_into("<Q", out, at + 8, moved.get(place, place))
    return bytes(out)


def _correct_offsets(opcode: int, body: bytes, places: dict[int, tuple[int, int]]) -> bytes:
    """Return a record of the summary with the new offsets and lengths of other records."""
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
