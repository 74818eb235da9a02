"""Parsing of chunks that are built byte by byte."""

import struct
import zlib
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Chunk, Message

from dmrl.guards import limits
from dmrl.recording.mcap.chunks.chunk import (
    batch_from_messages,
    build_batch_at,
    decompress,
    parse_records,
    select_channels,
)
from dmrl.recording.mcap.file import BudgetError
from dmrl.recording.mcap.message_batch import MessageBatch

PATH = Path("a.mcap")
ROWS = [(7, 30, 31, b"ab"), (300, 2**40, 2**50, b""), (7, 5, 6, b"xyz")]


def build_record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def build_message_record(number: int, time_ns: int, publish_ns: int, data: bytes) -> bytes:
    return build_record(Opcode.MESSAGE, struct.pack("<HIQQ", number, 0, time_ns, publish_ns) + data)


def to_array(data: bytes) -> np.ndarray:
    return np.frombuffer(data, np.uint8)


def build_batch(rows: list[tuple[int, int, int, bytes]] = ROWS) -> MessageBatch:
    return parse_records(to_array(b"".join(build_message_record(*row) for row in rows))).batch


def test_messages_among_other_records_are_found_at_any_byte() -> None:
    for junk in range(4):
        parts = [
            build_record(Opcode.SCHEMA, bytes(junk)) + build_message_record(*row) for row in ROWS
        ]
        assert list(parse_records(to_array(b"".join(parts))).batch.iter_rows()) == ROWS
    assert len(parse_records(to_array(b"")).batch) == 0
    assert len(build_batch_at(to_array(b"abc"), np.zeros(0, np.int64))) == 0


def test_messages_outside_chunks_become_a_batch() -> None:
    found = batch_from_messages([Message(n, t, d, p, 0) for n, t, p, d in ROWS])
    assert list(found.iter_rows()) == ROWS


def test_records_fill_a_chunk_to_its_last_byte() -> None:
    whole, other = build_message_record(1, 2, 3, b"data"), build_record(Opcode.SCHEMA, b"abc")
    scan = parse_records(to_array(whole + other + whole))
    assert scan.messages == [0, len(whole + other)]
    assert scan.others == [(Opcode.SCHEMA, len(whole), len(whole + other))]
    for lost in range(1, len(whole)):
        with pytest.raises(McapError):
            parse_records(to_array(whole + whole[:-lost]))
    short = build_record(Opcode.MESSAGE, bytes(21))  # the header of a message takes 22 bytes
    with pytest.raises(McapError, match="wrong length"):
        parse_records(to_array(short))
    assert parse_records(to_array(build_record(Opcode.MESSAGE, bytes(22)))).messages == [0]


def test_only_requested_channels_are_parsed() -> None:
    assert list(select_channels(build_batch(), {7}, {7, 300}).iter_rows()) == [ROWS[0], ROWS[2]]
    assert list(select_channels(build_batch(), {300}, {7, 300}).iter_rows()) == [ROWS[1]]
    assert list(select_channels(build_batch(), {7, 300, 9}, {7, 300, 9}).iter_rows()) == ROWS
    with pytest.raises(McapError, match="channel 300, which is not defined"):
        select_channels(build_batch(), {7}, {7})


LATE = [(1, 2**63, 0, b""), (1, 0, 2**63, b""), (1, 2**63 - 1, 0, b"")]


@pytest.mark.parametrize("late", LATE)
def test_times_beyond_int64_are_refused(late: tuple[int, int, int, bytes]) -> None:
    """A log time of 2**63 - 1 ns is refused too, as the end of a span could not exceed it."""
    last = (1, 2**63 - 2, 2**63 - 1, b"")
    assert len(select_channels(build_batch([last]), {1}, {1})) == 1
    with pytest.raises(McapError, match="beyond the year 2262"):
        select_channels(build_batch([last, late]), {1}, {1})


def build_chunk(data: bytes, packed: bytes, how: str, crc: int | None = None) -> Chunk:
    """Build a chunk record of compressed bytes, with the size and CRC of ``data``."""
    return Chunk(how, packed, 0, 0, zlib.crc32(data) if crc is None else crc, len(data))


DATA = b"".join(build_message_record(*row) for row in ROWS)
PACKED = {
    "": DATA,
    "zstd": zstandard.ZstdCompressor().compress(DATA),
    "lz4": lz4.frame.compress(DATA),
}


@pytest.mark.parametrize("how", PACKED)
def test_chunk_size_and_crc_are_verified(how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    packed = PACKED[how]
    assert decompress(build_chunk(DATA, packed, how), 9).tobytes() == DATA
    assert decompress(build_chunk(DATA, packed, how, crc=0), 9).tobytes() == DATA  # 0 means no CRC
    with pytest.raises(McapError, match="chunk at byte 9 fails its CRC"):
        decompress(build_chunk(DATA, packed, how, crc=1), 9)
    for said in (DATA + b"\0", DATA[:-1]):
        with pytest.raises(
            McapError, match=r"(another size than|more than the size that) it states"
        ):
            decompress(build_chunk(said, packed, how, crc=0), 9)
    monkeypatch.setattr(limits, "UNPACKED_BYTES", len(DATA))
    assert len(decompress(build_chunk(DATA, packed, how), 9)) == len(DATA)
    monkeypatch.setattr(limits, "UNPACKED_BYTES", len(DATA) - 1)
    with pytest.raises(BudgetError, match="decompresses to 0 MB"):
        decompress(build_chunk(DATA, packed, how), 9)


def test_unknown_compression_is_reported() -> None:
    with pytest.raises(McapError, match="unknown compression 'rar'"):
        decompress(build_chunk(DATA, DATA, "rar"), 0)
