"""Parsing of the Message Index records of a chunk."""

import struct

import numpy as np
import pytest
from mcap.exceptions import McapError

from dmrl.recording.mcap.message_index import IndexEntries, parse_index_entries, parse_index_records

NUMBER, AT = 3, 5


def build_index(number: int = NUMBER, size: int = 32, length: int = 38, opcode: int = 7) -> bytes:
    """Build a message index of two messages behind five other bytes."""
    head = struct.pack("<BQHI", opcode, length, number, size)
    return b"other" + head + struct.pack("<4q", 40, 9, 20, 71)


def parse_both(raw: bytes, at: int) -> list[IndexEntries | str]:
    """Parse a record as the only one of a chunk, and as one of many."""
    one = np.array([NUMBER]), np.array([at])
    out: list[IndexEntries | str] = []
    for parse in (
        lambda: parse_index_entries(raw, {NUMBER: at}),
        lambda: parse_index_records(raw, *one, (0, len(raw))),
    ):
        try:
            out.append(parse())
        except McapError as e:
            out.append(str(e))
    return out


def test_single_record_is_parsed_like_many() -> None:
    for entries in parse_both(build_index() + b"more", AT):
        assert isinstance(entries, IndexEntries)
        assert [one.tolist() for one in entries] == [[3, 3], [40, 20], [9, 71], [2]]


@pytest.mark.parametrize(
    ("raw", "at", "why"),
    [
        (build_index(), -1, "a message index is cut"),
        (build_index()[: AT + 14], AT, "a message index is cut"),
        (build_index()[:-1], AT, "a message index is cut"),
        (build_index(length=39), AT, "a message index is cut"),
        (build_index(number=4), AT, "message index of channel 3 is wrong"),
        (build_index(opcode=8), AT, "message index of channel 3 is wrong"),
        (build_index(length=37), AT, "message index of channel 3 is wrong"),
        (build_index(size=31), AT, "message index of channel 3 is wrong"),
    ],
)
def test_single_record_is_refused_like_many(raw: bytes, at: int, why: str) -> None:
    assert parse_both(raw, at) == [why, why]
