"""Every byte of a small recording flipped: the flip is noticed, or changes nothing."""

import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Metadata
from mcap.writer import CompressionType, IndexType, Writer

from dmrl.errors import RecordingError
from dmrl.messages import message, schema_bytes
from dmrl.recording import (
    Provenance,
    RecordingWriter,
    check,
    glance,
    log_times,
    read_raw,
    read_table,
    recover,
    stretches,
    summary,
    trim,
)
from dmrl.recording.opening import MAGIC

TOPICS = ("/cf1/height", "/cf1/range/cf2")
PATTERNS = (0x01, 0x80, 0xFF)
OPCODES = (0x00, Opcode.FOOTER, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.METADATA, 0x7F, 0x90)


def small(path: Path) -> Path:
    """Seven messages on two topics in three chunks, with metadata and an attachment."""
    with RecordingWriter(path, Provenance("test", {"level": 1}, seed=3)) as sink:
        for k in range(4):
            sink.write(10 * k, TOPICS[0], message("Height")(height_m=k))
            if k:
                sink.write(10 * k + 5, TOPICS[1], message("UwbRange")(range_m=k))
            if k % 2:
                sink.flush()
        sink.add_metadata("dmrl.split", {"train": "[[0, 10]]"})
        sink.add_attachment("note.txt", "text/plain", b"seven")
    return path


def everything(path: Path) -> list[Any]:
    """What every way to read gives."""
    wanted = dict.fromkeys(TOPICS)
    return [
        summary(path),
        [(raw.time_ns, raw.publish_ns, raw.channel, raw.data) for raw in read_raw(path)],
        [(raw.time_ns, raw.data) for raw in read_raw(path, start_ns=15, end_ns=26)],
        {topic: read_table(path, topic).to_pydict() for topic in TOPICS},
        {topic: times.tolist() for topic, times in log_times(path, TOPICS).items()},
        [{t: b.to_pydict() for t, b in seen.items()} for seen in stretches(path, wanted)],
        {
            topic: batch.to_pydict()
            for topic, batch in glance(path, wanted, start_ns=0, end_ns=100).items()
        },
        check(path),
    ]


def flips(data: bytes, patterns: tuple[int, ...], step: int = 1) -> Iterator[tuple[int, int]]:
    for at in range(0, len(data), step):
        for pattern in patterns:
            yield at, data[at] ^ pattern


def opcodes(data: bytes) -> Iterator[tuple[int, int]]:
    """Every record's opcode, and every other byte that looks like one, replaced by others."""
    for at, byte in enumerate(data):
        if 0x01 <= byte <= 0x0F and data[at + 3 : at + 9] == bytes(6):
            yield from ((at, int(code)) for code in OPCODES if code != byte)


def unnoticed(path: Path, changes: Iterator[tuple[int, int]], read: Callable[[Path], Any]) -> int:
    """Read with one byte changed, again and again: how many changes were no error.

    Those must give what the sound file gives.
    """
    data = path.read_bytes()
    sound = read(path)
    harmless = 0
    for at, byte in changes:
        path.write_bytes(data[:at] + bytes([byte]) + data[at + 1 :])
        try:
            assert read(path) == sound, f"byte {at}: {data[at]:#04x} to {byte:#04x}"
            harmless += 1
        except RecordingError as e:
            assert "\n" not in str(e)
            assert "dmrl recover" in str(e) or "Convert" in str(e) or "MCAP" in str(e), str(e)
    path.write_bytes(data)
    return harmless


@pytest.mark.parametrize("step", [3, pytest.param(1, marks=pytest.mark.slow)])
def test_every_flipped_byte_is_noticed_or_changes_nothing(step: int, tmp_path: Path) -> None:
    """Every third reaches each number of a record: they have four or eight bytes."""
    path = small(tmp_path / "a.mcap")
    data = path.read_bytes()
    unseen = unnoticed(path, flips(data, (0xFF,), step), everything)
    # The header's names, the sum of the data section, and who made an attachment's index.
    assert unseen < 100 / step


@pytest.mark.slow
def test_every_pattern_of_flips_is_noticed_or_changes_nothing(tmp_path: Path) -> None:
    path = small(tmp_path / "a.mcap")
    data = path.read_bytes()
    unnoticed(path, flips(data, PATTERNS), everything)


def test_every_substituted_opcode_is_noticed_or_changes_nothing(tmp_path: Path) -> None:
    path = small(tmp_path / "a.mcap")
    data = path.read_bytes()
    changes = list(opcodes(data))
    assert len(changes) > 20 * len(OPCODES)
    unnoticed(path, iter(changes), everything)


@pytest.mark.heavy
@pytest.mark.parametrize("step", [7, pytest.param(1, marks=pytest.mark.slow)])
def test_recover_says_that_nothing_was_lost_only_if_nothing_was(step: int, tmp_path: Path) -> None:
    path = small(tmp_path / "a.mcap")
    data = path.read_bytes()
    sound = [(raw.time_ns, raw.topic, raw.data) for raw in read_raw(path)]
    for at in range(8, len(data), step):
        path.write_bytes(data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :])
        out = tmp_path / "b.mcap"
        try:
            result = recover(path, out)
        except RecordingError:
            continue
        found = summary(out)
        got = [(raw.time_ns, raw.topic, raw.data) for raw in read_raw(out)]
        assert result.messages == len(got)
        assert set(got) <= set(sound), at
        if result.whole:
            assert got == sound, at
            assert found.metadata["dmrl.split"] == [{"train": "[[0, 10]]"}], at
            assert found.attachments["note.txt"] == b"seven", at
        elif result.counted:
            assert len(got) + sum(result.missing.values()) == len(sound), at
        out.unlink()


def records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of every record of a file."""
    at = 8
    while at < len(data) - 8:
        end = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        yield data[at], at, end
        at = end


def without_chunk(data: bytes, number: int) -> bytes:
    """The file with a chunk cut out, and its message indexes."""
    found = list(records(data))
    chunks = [k for k, (opcode, _, _) in enumerate(found) if opcode == Opcode.CHUNK]
    first = last = chunks[number]
    while found[last + 1][0] == Opcode.MESSAGE_INDEX:
        last += 1
    return data[: found[first][1]] + data[found[last][2] :]


def test_a_removed_chunk_is_missed_by_topic(tmp_path: Path) -> None:
    path = small(tmp_path / "a.mcap")
    path.write_bytes(without_chunk(path.read_bytes(), 1))
    for use in (summary, check, lambda p: list(read_raw(p)), lambda p: trim(p, tmp_path / "c")):
        with pytest.raises(RecordingError, match="dmrl recover"):
            use(path)
    result = recover(path, tmp_path / "b.mcap")
    assert (result.messages, result.whole, result.counted) == (3, False, True)
    assert result.missing == {"/cf1/height": 2, "/cf1/range/cf2": 2}


def test_messages_of_a_damaged_chunk_are_counted_even_without_the_end(tmp_path: Path) -> None:
    path = small(tmp_path / "a.mcap")
    data = bytearray(path.read_bytes())
    second = [at for opcode, at, _ in records(data) if opcode == Opcode.CHUNK][1]
    data[second + 70] ^= 0xFF
    path.write_bytes(data[:-100])
    result = recover(path, tmp_path / "b.mcap")
    assert (result.messages, result.damaged_chunks, result.counted) == (3, 1, False)
    assert result.missing == {"/cf1/height": 2, "/cf1/range/cf2": 2}


def foreign(path: Path, **options: Any) -> Path:
    """Seven messages on one topic, by mcap's own writer."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=100, **options)
        writer.start()
        schema = writer.register_schema("dmrl.v1.Height", "protobuf", schema_bytes("Height"))
        channel = writer.register_channel("/cf1/height", "protobuf", schema)
        for k in range(7):
            writer.add_message(channel, k, message("Height")(height_m=k).SerializeToString(), k)
        writer.finish()
    return path


@pytest.mark.parametrize(
    "options",
    [
        {"enable_crcs": False},
        {"use_statistics": False},
        {"use_statistics": False, "enable_crcs": False},
        {"repeat_channels": False},
        {"repeat_schemas": False, "repeat_channels": False},
        {"index_types": IndexType.CHUNK, "use_statistics": False},
        {"index_types": IndexType.MESSAGE},
        {"compression": CompressionType.LZ4, "enable_data_crcs": True},
    ],
    ids=str,
)
def test_what_other_writers_leave_out_is_not_missed(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    path = foreign(tmp_path / "a.mcap", **options)
    assert [raw.time_ns for raw in read_raw(path)] == list(range(7))
    assert summary(path).topics["/cf1/height"].count == 7
    assert log_times(path, ["/cf1/height"])["/cf1/height"].tolist() == list(range(7))
    assert not [finding for finding in check(path) if finding.level == "error"]


def test_sums_that_another_program_copied_say_nothing_of_its_file(tmp_path: Path) -> None:
    """As `mcap filter --include-metadata` does."""
    path, copy = small(tmp_path / "a.mcap"), tmp_path / "b.mcap"
    with path.open("rb") as source, copy.open("wb") as stream:
        reader, writer = make_reader(source), Writer(stream, chunk_size=90)
        writer.start()
        for schema, channel, raw in reader.iter_messages():
            assert schema
            number = writer.register_schema(schema.name, schema.encoding, schema.data)
            topic = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(topic, raw.log_time, raw.data, raw.publish_time)
        for record in (*reader.iter_metadata(), Metadata("mine", {"a": "1"})):
            writer.add_metadata(record.name, record.metadata)
        writer.finish()
    assert summary(copy).metadata["mine"] == [{"a": "1"}]
    assert log_times(copy, ["/cf1/height"]).keys() == {"/cf1/height"}
    assert not [finding for finding in check(copy) if finding.level == "error"]
    assert recover(copy, tmp_path / "c.mcap").whole


def test_a_lost_channel_is_noticed_without_any_crc(tmp_path: Path) -> None:
    """The statistics and indexes tell, where a writer left out the sums."""
    path = foreign(tmp_path / "a.mcap", enable_crcs=False)
    data = path.read_bytes()
    starts = {opcode: at for opcode, at, _ in records(data)}
    channel = starts[Opcode.CHANNEL]
    path.write_bytes(data[:channel] + b"\x7f" + data[channel + 1 :])
    # Nothing else is defined there, so that all of it is read: nothing is lost.
    assert len(list(read_raw(path))) == 7
    index = starts[Opcode.CHUNK_INDEX]
    path.write_bytes(data[:index] + b"\x7f" + data[index + 1 :])
    with pytest.raises(RecordingError, match=r"lists \d of \d chunks.*dmrl recover"):
        list(read_raw(path))


def rejoined(path: Path, parts: list[tuple[int, bytes]]) -> None:
    """The file of these records, with a footer that finds its summary and sums up nothing."""
    at, start = 8, 0
    for opcode, record in parts:
        at += len(record)
        start = at if opcode == Opcode.DATA_END else start
    footer = struct.pack("<BQQQI", Opcode.FOOTER, 20, start, 0, 0)
    body = b"".join(footer if opcode == Opcode.FOOTER else record for opcode, record in parts)
    path.write_bytes(b"\x89MCAP0\r\n" + body + b"\x89MCAP0\r\n")


@pytest.mark.parametrize(
    ("kind", "place", "complaint"),
    [
        (Opcode.CHANNEL, Opcode.FOOTER, "two channels"),
        (Opcode.SCHEMA, Opcode.FOOTER, "two message types"),
        (Opcode.CHUNK_INDEX, Opcode.FOOTER, r"lists 3 of 2 chunks"),
        (Opcode.CHUNK, Opcode.DATA_END, "lacks the chunk"),
    ],
)
def test_a_record_that_is_there_twice_is_noticed_without_any_crc(
    tmp_path: Path, kind: Opcode, place: Opcode, complaint: str
) -> None:
    path = small(tmp_path / "a.mcap")
    data = path.read_bytes()
    parts = [(opcode, data[start:end]) for opcode, start, end in records(data)]
    twin = next(part for part in reversed(parts) if part[0] == kind)
    other = (kind, twin[1].replace(b"cf1", b"cf9").replace(b"Range", b"Ranje"))
    at = next(k for k, (opcode, _) in enumerate(parts) if opcode == place)
    rejoined(path, parts)
    assert len(list(read_raw(path))) == 7
    rejoined(path, [*parts[:at], other, *parts[at:]])
    with pytest.raises(RecordingError, match=complaint):
        list(read_raw(path))


def test_a_summary_with_a_crc_that_renames_a_topic_is_noticed(tmp_path: Path) -> None:
    """Made by somebody who knows: every sum is right, and other readers would see another topic."""
    path = foreign(tmp_path / "a.mcap", compression=CompressionType.NONE)
    data = bytearray(path.read_bytes())
    end = next(start for opcode, start, _ in records(bytes(data)) if opcode == Opcode.DATA_END)
    at = data.index(b"/cf1/height", end)
    data[at : at + 11] = b"/cf1/heigst"
    footer = len(data) - len(MAGIC) - 9 - 20
    (start,) = struct.unpack_from("<Q", data, footer + 9)
    struct.pack_into("<I", data, footer + 25, zlib.crc32(data[start : footer + 25]))
    path.write_bytes(data)
    for read in (
        lambda: list(read_raw(path)),
        lambda: trim(path, tmp_path / "b.mcap"),
        lambda: read_table(path, "/cf1/heigst"),
        lambda: check(path),
    ):
        with pytest.raises(RecordingError, match="is not what its summary repeats of it"):
            read()


@pytest.mark.parametrize("renamed", ["summary", "messages"])
def test_without_an_index_too_a_topic_has_one_name(renamed: str, tmp_path: Path) -> None:
    """Read as a whole, the later of two definitions was believed."""
    options = {"compression": CompressionType.NONE, "index_types": IndexType.NONE}
    path = foreign(tmp_path / "a.mcap", enable_crcs=False, **options)
    data = path.read_bytes()
    end = next(start for opcode, start, _ in records(data) if opcode == Opcode.DATA_END)
    halves = {"messages": data[:end], "summary": data[end:]}
    assert halves[renamed].count(b"/cf1/height") == 1
    halves[renamed] = halves[renamed].replace(b"/cf1/height", b"/cf1/heigst")
    path.write_bytes(halves["messages"] + halves["summary"])
    for read in (summary, check, lambda path: list(read_raw(path))):
        with pytest.raises(RecordingError, match="is defined twice"):
            read(path)


def test_a_summary_without_crc_that_renames_a_topic_is_noticed(tmp_path: Path) -> None:
    """The chunks say what the topic is called, as every other reader would."""
    path = foreign(tmp_path / "a.mcap", enable_crcs=False, compression=CompressionType.NONE)
    data = path.read_bytes()
    end = next(start for opcode, start, _ in records(data) if opcode == Opcode.DATA_END)
    assert data[:end].count(b"/cf1/height") == data[end:].count(b"/cf1/height") == 1
    path.write_bytes(data[:end] + data[end:].replace(b"/cf1/height", b"/cf1/heigst"))
    complaint = "/cf1/height is not what its summary repeats of it"
    for read in (
        lambda: list(read_raw(path)),
        lambda: trim(path, tmp_path / "b.mcap"),
        lambda: read_table(path, "/cf1/heigst"),
        lambda: glance(path, {"/cf1/heigst": None}, start_ns=0, end_ns=10),
    ):
        with pytest.raises(RecordingError, match=complaint):
            read()


def test_recover_does_not_call_whole_what_has_messages_too_many(tmp_path: Path) -> None:
    path = small(tmp_path / "a.mcap")
    data = path.read_bytes()
    parts = [(opcode, data[start:end]) for opcode, start, end in records(data)]
    chunk = next(part for part in parts if part[0] == Opcode.CHUNK)
    end = next(k for k, (opcode, _) in enumerate(parts) if opcode == Opcode.DATA_END)
    body = b"".join(record for _, record in [*parts[: end + 1], chunk, *parts[end + 1 :]])
    path.write_bytes(data[:8] + body + data[:8])
    result = recover(path, tmp_path / "b.mcap")
    assert result.messages > 7
    assert not result.whole
