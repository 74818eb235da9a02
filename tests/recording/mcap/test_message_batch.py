"""Blocks of messages: whatever is done to one, each message keeps its times and its bytes."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.recording.mcap import message_batch as room
from dmrl.recording.mcap.message_batch import EMPTY, HEAD_BYTES, Block, concatenate, joined

Row = tuple[int, int, int, bytes]
TIMES = st.integers(0, 5)
ROWS = st.lists(st.tuples(st.integers(1, 3), TIMES, TIMES, st.binary(max_size=5)), max_size=8)


def block_of(rows: list[Row], gap: int = 3) -> Block:
    """Messages with their heads, and bytes of nobody's before each."""
    data, start = b"", []
    for *_, payload in rows:
        data += b"\xee" * (gap + HEAD_BYTES)
        start.append(len(data))
        data += payload
    columns = [np.array([row[k] for row in rows], np.int64) for k in range(3)]
    begin = np.array(start, np.int64)
    end = begin + np.array([len(row[3]) for row in rows], np.int64)
    return Block(np.frombuffer(data, np.uint8), *columns, begin, end)


@given(ROWS, ROWS)
def test_messages_stay_whole(one: list[Row], other: list[Row]) -> None:
    first, second = block_of(one), block_of(other, 1)
    assert list(first.rows()) == one
    assert list(first.compact().rows()) == one
    records, at = first.records()
    bodies = [records[a + HEAD_BYTES : b].tobytes() for a, b in pairwise(at.tolist())]
    assert bodies == [payload for *_, payload in one]
    assert list(first.sorted().rows()) == sorted(one, key=lambda row: row[1])  # stable, as this is
    late = sorted(one, key=lambda row: (row[1], row[0] == 2))
    assert list(first.sorted(last=[2]).rows()) == late
    odd = np.array([row[0] % 2 == 1 for row in one], bool)
    assert list(first.take(odd).rows()) == [row for row in one if row[0] % 2]
    assert list(concatenate(first, second).rows()) == one + other
    assert list(concatenate(None, second).rows()) == other
    assert list(joined([first, second, EMPTY, first]).rows()) == one + other + one


def test_joined_blocks_hold_little_but_their_own() -> None:
    large = block_of([(1, k, k, bytes([k]) * 10) for k in range(100)], 0)
    few = joined([large.take(np.array([k])) for k in (3, 50)])
    assert [payload for *_, payload in few.rows()] == [b"\x03" * 10, b"2" * 10]
    assert len(few.data) == 2 * (HEAD_BYTES + 10)
    assert joined([large]).data is not large.data
    assert len(large.take(np.array([5])).compact().data) == HEAD_BYTES + 10


def test_rows_of_several_parts_are_all_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "ROWS", 3)
    rows = [(1, k, 2 * k, bytes([k])) for k in range(7)]
    assert list(block_of(rows).rows()) == rows
