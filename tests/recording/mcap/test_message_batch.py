"""Message batches: every operation keeps times and bytes of each message."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.recording.mcap import message_batch as room
from dmrl.recording.mcap.message_batch import (
    EMPTY_BATCH,
    MESSAGE_PREFIX_BYTES,
    MessageBatch,
    concatenate,
    concatenate_all,
)

Row = tuple[int, int, int, bytes]
TIMES = st.integers(0, 5)
ROWS = st.lists(st.tuples(st.integers(1, 3), TIMES, TIMES, st.binary(max_size=5)), max_size=8)


def build_batch(rows: list[Row], gap: int = 3) -> MessageBatch:
    """Build a batch of messages with ``gap`` unused bytes before each record."""
    data, start = b"", []
    for *_, payload in rows:
        data += b"\xee" * (gap + MESSAGE_PREFIX_BYTES)
        start.append(len(data))
        data += payload
    columns = [np.array([row[k] for row in rows], np.int64) for k in range(3)]
    begin = np.array(start, np.int64)
    end = begin + np.array([len(row[3]) for row in rows], np.int64)
    return MessageBatch(np.frombuffer(data, np.uint8), *columns, begin, end)


@given(ROWS, ROWS)
@pytest.mark.heavy
def test_batch_operations_keep_messages_intact(one: list[Row], other: list[Row]) -> None:
    first, second = build_batch(one), build_batch(other, 1)
    assert list(first.iter_rows()) == one
    assert list(first.compact().iter_rows()) == one
    records, at = first.copy_records()
    bodies = [records[a + MESSAGE_PREFIX_BYTES : b].tobytes() for a, b in pairwise(at.tolist())]
    assert bodies == [payload for *_, payload in one]
    # Like `sorted`, sorting a batch keeps the order of messages at equal times.
    assert list(first.sort_by_time().iter_rows()) == sorted(one, key=lambda row: row[1])
    late = sorted(one, key=lambda row: (row[1], row[0] == 2))
    assert list(first.sort_by_time(last=[2]).iter_rows()) == late
    odd = np.array([row[0] % 2 == 1 for row in one], bool)
    assert list(first.take(odd).iter_rows()) == [row for row in one if row[0] % 2]
    assert list(concatenate(first, second).iter_rows()) == one + other
    assert list(concatenate(None, second).iter_rows()) == other
    assert (
        list(concatenate_all([first, second, EMPTY_BATCH, first]).iter_rows()) == one + other + one
    )


def test_concatenated_batch_copies_only_its_messages() -> None:
    large = build_batch([(1, k, k, bytes([k]) * 10) for k in range(100)], 0)
    few = concatenate_all([large.take(np.array([k])) for k in (3, 50)])
    assert [payload for *_, payload in few.iter_rows()] == [b"\x03" * 10, b"2" * 10]
    assert len(few.data) == 2 * (MESSAGE_PREFIX_BYTES + 10)
    assert concatenate_all([large]).data is not large.data
    assert len(large.take(np.array([5])).compact().data) == MESSAGE_PREFIX_BYTES + 10


def test_gathered_rows_of_several_parts_are_complete(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "ROWS_AT_A_TIME", 3)
    rows = [(1, k, 2 * k, bytes([k])) for k in range(7)]
    assert list(build_batch(rows).iter_rows()) == rows
