"""The decoder of micro-SD logs equals a simple one, also for damaged logs."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import SourceError
from dmrl.formats.base import Options
from dmrl.formats.crazyflie import usd_log

from .. import foreign, plain_usd

LOGS = ("log05", "jana00_brushed_flights", "eckart00_brushless_flights")
# Number of records of each event, counted by an independent decoder.
COUNTS = {
    "log05": {
        "estTDOA": 2044,
        "estGyroscope": 11457,
        "estAcceleration": 11457,
        "estBarometer": 573,
        "lhPosition": 1562,
    },
    "jana00_brushed_flights": {"fixedFrequency": 4643, "estPose": 511},
    "eckart00_brushless_flights": {"fixedFrequency": 4634, "estPose": 926},
}


def assert_equal_to_reference(log: usd_log.UsdLog, data: bytes) -> None:
    """Assert that a log equals the result of the value-by-value decoder, bit for bit."""
    wanted = plain_usd.decode(data)
    unit = {1: 1_000_000, 2: 1000}[log.version]
    assert [b.name for b in log.blocks] == [name for name, v in wanted.items() if v["timestamp"]]
    for block in log.blocks:
        values = wanted[block.name]
        assert (block.time_ns == np.array(values.pop("timestamp")) * unit).all()
        assert list(block.columns) == list(values)
        for name, column in block.columns.items():
            np.testing.assert_array_equal(column, np.array(values[name], column.dtype))


@pytest.mark.parametrize("name", LOGS)
def test_real_logs_equal_an_independent_decode(data: Path, name: str) -> None:
    raw = (data / "crazyflie-usd" / name).read_bytes()
    assert zlib.crc32(raw[:-4]) == struct.unpack("<I", raw[-4:])[0]
    log = usd_log.decode_log(raw)
    assert log.warnings == ()
    assert {b.name: len(b.time_ns) for b in log.blocks} == COUNTS[name]
    assert_equal_to_reference(log, raw)


def test_rates_of_a_real_log_match_its_settings(data: Path) -> None:
    raw = (data / "crazyflie-usd" / "eckart00_brushless_flights").read_bytes()
    rates = {
        b.name: (len(b.time_ns) - 1) / ((b.time_ns[-1] - b.time_ns[0]) * 1e-9)
        for b in usd_log.decode_log(raw).blocks
    }
    assert rates["fixedFrequency"] == pytest.approx(505, abs=1)
    assert rates["estPose"] == pytest.approx(101, abs=1)


@pytest.mark.parametrize("version", [1, 2])
def test_both_log_versions_are_read(version: int) -> None:
    raw = foreign.pack_usd_log(version)
    log = usd_log.decode_log(raw)
    assert (log.version, log.warnings) == (version, ())
    assert_equal_to_reference(log, raw)


def test_events_on_either_side_of_a_wrap_stay_together() -> None:
    events = {1: ("a", [("v.a", "f")]), 2: ("b", [("v.b", "f")])}
    records = [(1 + k % 2, (2**32 - 5 + 10 * k) % 2**32, (0.5,)) for k in range(6)]
    first, other = usd_log.decode_log(plain_usd.encode(events, records, version=1)).blocks
    assert (other.time_ns - first.time_ns).tolist() == [10_000_000] * 3


def test_a_damaged_time_of_64_bits_stays_later_than_all_others() -> None:
    records = [(1, ticks, (0.5,)) for ticks in (5, 2**60, 7)]
    (block,) = usd_log.decode_log(plain_usd.encode({1: ("a", [("v.a", "f")])}, records)).blocks
    assert block.time_ns[1] > 10**18 and block.time_ns[::2].tolist() == [5_000, 7_000]


def test_every_type_of_variable_is_read() -> None:
    values = {"b": -5, "B": 250, "h": -300, "H": 60000, "i": -(2**31), "I": 2**32 - 1}
    numbers = (*values.values(), 0.5, 1.25)
    codes = [*values, "e", "f"]
    raw = plain_usd.encode({1: ("all", [(f"v.{c}", c) for c in codes])}, [(1, 7, numbers)])
    (block,) = usd_log.decode_log(raw).blocks
    assert tuple(column[0] for column in block.columns.values()) == numbers


@pytest.mark.parametrize("name", ["synthetic", *LOGS])
@pytest.mark.heavy
def test_a_log_cut_anywhere_gives_every_whole_record_and_a_warning(
    name: str, request: pytest.FixtureRequest
) -> None:
    if name == "synthetic":
        raw = foreign.pack_usd_log()
    else:
        raw = (request.getfixturevalue("data") / "crazyflie-usd" / name).read_bytes()
    body = usd_log._parse_header(raw, name)[2]
    whole = usd_log.decode_log(raw)
    sizes = {b.name: 10 + sum(c.itemsize for c in b.columns.values()) for b in whole.blocks}
    times = np.concatenate([b.time_ns for b in whole.blocks])
    size = np.concatenate([np.full(len(b.time_ns), sizes[b.name]) for b in whole.blocks])
    assert body + size.sum() + 4 == len(raw)
    for length in np.random.default_rng(7).integers(body, len(raw) - 4, 50).tolist():
        log = usd_log.decode_log(raw[:length], name)
        assert "no valid CRC" in log.warnings[0]
        got = sum(len(b.time_ns) * sizes[b.name] for b in log.blocks)
        # The bytes that are not decoded are less than one record.
        assert 0 <= length - body - got < size.max()
        for cut in log.blocks:
            full = next(b for b in whole.blocks if b.name == cut.name)
            assert (cut.time_ns == full.time_ns[: len(cut.time_ns)]).all()
    assert len(times)


def test_empty_log_gives_one_line_error(tmp_path: Path) -> None:
    (tmp_path / "log00").write_bytes(b"")
    with pytest.raises(SourceError, match=r"log00 is empty.* Pass another log") as e:
        usd_log.load_content(tmp_path / "log00", Options())
    assert "\n" not in str(e.value)


@pytest.mark.parametrize(
    ("damage", "text"),
    [
        (lambda raw: b"\xbd" + raw[1:], "no micro-SD log of version 1 or 2"),
        (lambda raw: raw[:1] + b"\3" + raw[2:], "no micro-SD log of version 1 or 2"),
        (lambda raw: raw[:40], "damaged in its header, or ends there"),
        (lambda raw: raw.replace(b"estDistance\0", b"fixedFrequency\0"), "the same name"),
        (lambda raw: raw.replace(b"gyro.x(f)", b"gyro.x(q)"), "without name or known type"),
    ],
)
def test_damaged_header_gives_one_line_error(damage: object, text: str) -> None:
    with pytest.raises(SourceError, match=text):
        usd_log.decode_log(damage(foreign.pack_usd_log()), "log07")  # type: ignore[operator]


def test_an_id_that_is_unknown_ends_the_log_with_a_warning(
    capsys: pytest.CaptureFixture[str],
) -> None:
    raw = foreign.pack_usd_log()
    log = usd_log.decode_log(raw[:-4] + b"\x55\x55" + b"\0" * 30)
    assert [len(b.time_ns) for b in log.blocks] == [100, 20, 20]
    assert "left out: bytes that are no whole record: 32" in capsys.readouterr().err


def test_bytes_that_look_like_ids_are_no_records() -> None:
    events = {7: ("a", [("x", "H"), ("y", "H")]), 9: ("b", [("z", "I")])}
    rows = [(7, 7 * 65536 + 9, (7, 9)) if k % 3 else (9, 7, (9 * 65536 + 7,)) for k in range(300)]
    raw = plain_usd.encode(events, rows)
    assert_equal_to_reference(usd_log.decode_log(raw), raw)


@pytest.mark.parametrize("code", ["H", "B"])
@pytest.mark.parametrize(
    "pattern",
    [
        "aabab" + 60 * "ab",
        60 * "abc",
        60 * "bca",
        40 * "abca",
        60 * "ab" + "b" + 60 * "ab",
        60 * "ab" + "a",
        60 * "ab" + "ac" + 60 * "ab",
        60 * "ab" + 60 * "ba",
    ],
)
def test_interleaved_events_are_decoded(pattern: str, code: str) -> None:
    events = {ord(c) - 90: (c, [("x", "H"), ("y", code)]) for c in "abc"}
    rows = [(ord(c) - 90, 1000 * k, (k, 7)) for k, c in enumerate(pattern)]
    raw = plain_usd.encode(events, rows)
    assert_equal_to_reference(usd_log.decode_log(raw), raw)


def test_wrapping_milliseconds_are_unwrapped() -> None:
    rows = [(1, (2**32 - 2 + k) % 2**32, (k,)) for k in range(5)]
    (block,) = usd_log.decode_log(plain_usd.encode({1: ("a", [("x", "H")])}, rows, 1)).blocks
    assert np.diff(block.time_ns).tolist() == [1_000_000] * 4


@pytest.mark.parametrize(
    ("head", "known"),
    [
        (b"\xbc" + struct.pack("<HH", 1, 1), True),
        (b"\xbc" + struct.pack("<HH", 2, 250), True),
        (b"\xbc" + struct.pack("<HH", 2, 251), False),
        (b"\xbc" + struct.pack("<HH", 2, 0), False),
        (b"\xbc" + struct.pack("<HH", 0, 1), False),
        (b"\xbc" + struct.pack("<HH", 3, 1), False),
        (b"\xbd" + struct.pack("<HH", 1, 1), False),
        (b"\xbc\1\0\1", False),
    ],
)
def test_log_is_recognized_by_five_bytes(head: bytes, known: bool, tmp_path: Path) -> None:
    (tmp_path / "log").write_bytes(head)
    assert usd_log.can_read(tmp_path / "log") == known
    assert usd_log.can_read(tmp_path) == known
    if not known:
        with pytest.raises(SourceError, match="no micro-SD log in"):
            usd_log.load_content(tmp_path, Options())


@pytest.mark.parametrize(
    ("events", "words"),
    [
        ({1: ("a", [("x", "H"), ("x", "H")])}, "without name or known type"),
        ({1: ("a", [("", "H")])}, "without name or known type"),
        ({1: ("", [("x", "H")])}, "without name or known type"),
        ({1: ("a", [("x", "d")])}, "without name or known type"),
    ],
)
def test_variables_need_distinct_names_and_known_types(
    events: dict[int, tuple[str, list[tuple[str, str]]]], words: str
) -> None:
    head = b"\xbc" + struct.pack("<HH", 2, len(events))
    for number, (name, variables) in events.items():
        head += (
            struct.pack("<H", number) + name.encode() + b"\0" + struct.pack("<H", len(variables))
        )
        head += b"".join(f"{variable}({code})".encode() + b"\0" for variable, code in variables)
    with pytest.raises(SourceError, match=words):
        usd_log.decode_log(head + bytes(40))


@pytest.mark.parametrize("numbers", [(1, 257), (0x0102, 0xFF02), (0xFFFF, 0x00FF)])
def test_events_with_equal_low_id_bytes_are_decoded(numbers: tuple[int, int]) -> None:
    events = {numbers[0]: ("a", [("x", "H")]), numbers[1]: ("b", [("y", "I"), ("z", "H")])}
    rows = [
        (numbers[k % 3 == 0], 1000 * k, (k,) if k % 3 else (70_000 + k, 257)) for k in range(200)
    ]
    raw = plain_usd.encode(events, rows)
    assert_equal_to_reference(usd_log.decode_log(raw), raw)


def test_a_log_has_250_types_of_events_at_most_and_names_that_print() -> None:
    events = {k: (f"e{k}", [("x", "H")]) for k in range(251)}
    most = {k: events[k] for k in range(250)}
    raw = plain_usd.encode(most, [(k, k, (k,)) for k in range(250)])
    assert len(usd_log.decode_log(raw).blocks) == 250
    with pytest.raises(SourceError, match="no micro-SD log of version 1 or 2"):
        usd_log.decode_log(plain_usd.encode(events, []))
    for name, variable in (("a\n", "x"), ("a", "x\n")):
        with pytest.raises(SourceError, match="without name or known type"):
            usd_log.decode_log(plain_usd.encode({1: (name, [(variable, "H")])}, []))
    for head in (b"\xbc\2\0\0\0", b"\xbc\2\0"):
        with pytest.raises(SourceError):
            usd_log.decode_log(head + bytes(9))
