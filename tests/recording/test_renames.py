"""Lost, repeated and contradictory records are detected even in files without checksums."""

import struct
import zlib
from pathlib import Path
from typing import Any

import pytest
from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType, Writer

from dmrl.errors import RecordingError
from dmrl.messages import message_class, serialize_schema
from dmrl.recording import (
    check,
    read_log_times,
    read_raw,
    read_summary,
    read_table,
    sample_topics,
    trim,
)
from dmrl.recording.mcap.file import MAGIC

from .records import iter_records, write_small_recording


def write_foreign_heights(path: Path, **options: Any) -> Path:
    """Write seven messages on one topic with the mcap package."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=100, **options)
        writer.start()
        schema = writer.register_schema("dmrl.v1.Height", "protobuf", serialize_schema("Height"))
        channel = writer.register_channel("/cf1/height", "protobuf", schema)
        for k in range(7):
            writer.add_message(
                channel, k, message_class("Height")(height_m=k).SerializeToString(), k
            )
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
def test_optional_records_of_other_writers_may_be_missing(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    path = write_foreign_heights(tmp_path / "a.mcap", **options)
    assert [raw.time_ns for raw in read_raw(path)] == list(range(7))
    assert read_summary(path).topics["/cf1/height"].count == 7
    assert read_log_times(path, ["/cf1/height"])["/cf1/height"].tolist() == list(range(7))
    assert not [finding for finding in check(path) if finding.level == "error"]


def test_lost_channel_is_detected_without_crc(tmp_path: Path) -> None:
    """Statistics and chunk indexes reveal the loss if the file has no checksums."""
    path = write_foreign_heights(tmp_path / "a.mcap", enable_crcs=False)
    data = path.read_bytes()
    starts = {opcode: at for opcode, at, _ in iter_records(data)}
    channel = starts[Opcode.CHANNEL]
    path.write_bytes(data[:channel] + b"\x7f" + data[channel + 1 :])
    # The file has only one channel, so all messages are still read.
    assert len(list(read_raw(path))) == 7
    index = starts[Opcode.CHUNK_INDEX]
    path.write_bytes(data[:index] + b"\x7f" + data[index + 1 :])
    with pytest.raises(RecordingError, match=r"lists \d of \d chunks.*dmrl recover"):
        list(read_raw(path))


def write_records(path: Path, parts: list[tuple[int, bytes]]) -> None:
    """Write a file of these records; its footer locates the summary and has no CRC."""
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
        (Opcode.SCHEMA, Opcode.FOOTER, "two different schemas"),
        (Opcode.CHUNK_INDEX, Opcode.FOOTER, r"lists 3 of 2 chunks"),
        (Opcode.CHUNK, Opcode.DATA_END, "lacks the chunk"),
    ],
)
def test_repeated_record_is_detected_without_crc(
    tmp_path: Path, kind: Opcode, place: Opcode, complaint: str
) -> None:
    path = write_small_recording(tmp_path / "a.mcap")
    data = path.read_bytes()
    parts = [(opcode, data[start:end]) for opcode, start, end in iter_records(data)]
    twin = next(part for part in reversed(parts) if part[0] == kind)
    other = (kind, twin[1].replace(b"cf1", b"cf9").replace(b"Range", b"Ranje"))
    at = next(k for k, (opcode, _) in enumerate(parts) if opcode == place)
    write_records(path, parts)
    assert len(list(read_raw(path))) == 7
    write_records(path, [*parts[:at], other, *parts[at:]])
    with pytest.raises(RecordingError, match=complaint):
        list(read_raw(path))


def test_a_summary_with_a_crc_that_renames_a_topic_is_noticed(tmp_path: Path) -> None:
    """Every CRC is correct, as in a forged file, and other readers would see another topic."""
    path = write_foreign_heights(tmp_path / "a.mcap", compression=CompressionType.NONE)
    data = bytearray(path.read_bytes())
    end = next(start for opcode, start, _ in iter_records(bytes(data)) if opcode == Opcode.DATA_END)
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
        with pytest.raises(RecordingError, match=r"the definition of .* contradicts the summary"):
            read()


@pytest.mark.parametrize("renamed", ["summary", "messages"])
def test_contradictory_channel_definitions_are_refused_without_an_index(
    renamed: str, tmp_path: Path
) -> None:
    """A file without an index is read from front to back, where the last definition would win."""
    options = {"compression": CompressionType.NONE, "index_types": IndexType.NONE}
    path = write_foreign_heights(tmp_path / "a.mcap", enable_crcs=False, **options)
    data = path.read_bytes()
    end = next(start for opcode, start, _ in iter_records(data) if opcode == Opcode.DATA_END)
    halves = {"messages": data[:end], "summary": data[end:]}
    assert halves[renamed].count(b"/cf1/height") == 1
    halves[renamed] = halves[renamed].replace(b"/cf1/height", b"/cf1/heigst")
    path.write_bytes(halves["messages"] + halves["summary"])
    for read in (read_summary, check, lambda path: list(read_raw(path))):
        with pytest.raises(RecordingError, match="is defined twice"):
            read(path)


def test_a_summary_without_crc_that_renames_a_topic_is_noticed(tmp_path: Path) -> None:
    """The definition in the chunk contradicts the summary."""
    path = write_foreign_heights(
        tmp_path / "a.mcap", enable_crcs=False, compression=CompressionType.NONE
    )
    data = path.read_bytes()
    end = next(start for opcode, start, _ in iter_records(data) if opcode == Opcode.DATA_END)
    assert data[:end].count(b"/cf1/height") == data[end:].count(b"/cf1/height") == 1
    path.write_bytes(data[:end] + data[end:].replace(b"/cf1/height", b"/cf1/heigst"))
    complaint = "the definition of /cf1/height contradicts the summary"
    for read in (
        lambda: list(read_raw(path)),
        lambda: trim(path, tmp_path / "b.mcap"),
        lambda: read_table(path, "/cf1/heigst"),
        lambda: sample_topics(path, {"/cf1/heigst": None}, start_ns=0, end_ns=10),
    ):
        with pytest.raises(RecordingError, match=complaint):
            read()
