"""The vectorised search for log records equals sequential parsing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.formats.crazyflie.usd_records import EventType, gather_records

NUMBERS = st.lists(
    st.sampled_from([1, 2, 3, 255, 256, 257, 0x0201, 0xFF01, 0xFFFF]),
    min_size=1,
    max_size=4,
    unique=True,
)


def parse_sequentially(
    data: bytes, body: int, end: int, events: list[EventType]
) -> tuple[dict[str, bytes], int]:
    """Return the bytes of the records of each event, and the end of the last whole record."""
    sizes = {event.number: event.dtype.itemsize for event in events}
    names = {event.number: event.name for event in events}
    found, at = {event.name: b"" for event in events}, body
    while at + 2 <= end:
        number = int.from_bytes(data[at : at + 2], "little")
        if number not in sizes or at + sizes[number] > end:
            break
        found[names[number]] += data[at : at + sizes[number]]
        at += sizes[number]
    return found, at


@given(
    numbers=NUMBERS,
    codes=st.lists(st.sampled_from(["", "B", "H", "HB", "I", "IHB", "f"]), min_size=4, max_size=4),
    time=st.sampled_from(["<u4", "<u8"]),
    pattern=st.lists(st.integers(0, 3), min_size=1, max_size=5),
    repeats=st.integers(1, 40),
    odd=st.lists(st.tuples(st.integers(0, 150), st.integers(0, 3)), max_size=3),
    rest=st.binary(max_size=7),
    seed=st.integers(0, 9),
)
@pytest.mark.heavy
def test_records_equal_sequential_parsing(
    numbers: list[int],
    codes: list[str],
    time: str,
    pattern: list[int],
    repeats: int,
    odd: list[tuple[int, int]],
    rest: bytes,
    seed: int,
) -> None:
    events = [
        EventType(number, f"e{number}", tuple((f"v{k}", c) for k, c in enumerate(code)), time)
        for number, code in zip(numbers, codes, strict=False)
    ]
    order = [events[k % len(events)] for k in pattern * repeats]
    for at, k in odd:
        order.insert(min(at, len(order)), events[k % len(events)])
    rng = np.random.default_rng(seed)
    data = b"head" + b"".join(
        event.number.to_bytes(2, "little")
        # The content of a record may look like the number of an event.
        + rng.choice([0, 1, 2, 255], event.dtype.itemsize - 2).astype(np.uint8).tobytes()
        for event in order
    )
    cut = data + rest + b"tail"
    for end in (len(data), len(data) - 1, len(data) + len(rest)):
        rows, stop = gather_records(cut, 4, end, events)
        wanted, wanted_stop = parse_sequentially(cut, 4, end, events)
        assert stop == wanted_stop
        assert {name: row.tobytes() for name, row in rows.items()} == wanted


def test_record_layout_has_no_padding() -> None:
    event = EventType(1, "a", (("x", "B"), ("y", "I")), "<u8")
    assert event.dtype.itemsize == 2 + 8 + 1 + 4
    assert list(event.dtype.fields or ()) == ["id", "time", "v0", "v1"]
    row = np.frombuffer(bytes(range(15)), event.dtype)[0]
    assert row["time"] == int.from_bytes(bytes(range(2, 10)), "little")
    assert (row["v0"], row["v1"]) == (10, int.from_bytes(bytes(range(11, 15)), "little"))
