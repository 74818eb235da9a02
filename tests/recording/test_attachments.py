"""Metadata, attachments, statistics and index times of recordings."""

import struct
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import IndexType, Writer

from dmrl.errors import RecordingError
from dmrl.messages import message_class, serialize_schema
from dmrl.recording import (
    Provenance,
    RecordingWriter,
    check,
    merge,
    read_raw,
    read_splits,
    read_summary,
    trim,
)
from dmrl.recording.licences import (
    LICENCES_METADATA,
    extract_licence_title,
    find_licence_file,
    licences_in,
)
from dmrl.recording.log_times import read_log_times
from dmrl.recording.mcap.batch_reader import (
    count_messages,
    iter_batches,
    iter_batches_in_file_order,
)
from dmrl.recording.mcap.message_index import MESSAGE_INDEX_STRUCT, parse_index_entries
from dmrl.recording.summary import read_channel

from .records import iter_records

MADE = Provenance("test")


def write_recording(path: Path, *metadata: tuple[str, dict[str, str]]) -> Path:
    """Write ten heights at 0, 10, ... 90 ns, a recipe, an attachment and this metadata."""
    with RecordingWriter(path, MADE, recipe="kind = 'test'\n") as sink:
        for k in range(10):
            sink.write(10 * k, "/cf1/height", message_class("Height")(height_m=k))
        for name, values in metadata:
            sink.add_metadata(name, values)
        sink.add_attachment("notes", "text/plain", b"hello")
    return path


def test_split_has_all_intervals_of_its_name(tmp_path: Path) -> None:
    path = write_recording(
        tmp_path / "a.mcap",
        ("dmrl.split", {"train": "[[0, 10], [30, 40]]", "test": "[[20, 25]]"}),
        ("dmrl.split", {"train": "[[50, 60]]"}),
    )
    assert read_splits(path, read_summary(path)) == {
        "train": [(0, 10), (30, 40), (50, 60)],
        "test": [(20, 25)],
    }


@pytest.mark.parametrize("text", ["[[1]]", "[1, 2]", '[["a", 2]]', "{", "[[null, 3]]"])
def test_invalid_split_gives_one_line_error(text: str, tmp_path: Path) -> None:
    path = write_recording(tmp_path / "a.mcap", ("dmrl.split", {"train": text}))
    with pytest.raises(RecordingError, match=r"a\.mcap: its split is not a list") as e:
        read_splits(path, read_summary(path))
    assert "\n" not in str(e.value)


def test_metadata_and_attachments_are_copied_without_provenance_and_recipe(tmp_path: Path) -> None:
    one = write_recording(tmp_path / "a.mcap", ("own", {"k": "v"}), ("own", {"k": "w"}))
    other = tmp_path / "b.mcap"
    with RecordingWriter(other, Provenance("other")) as sink:
        sink.copy_extras(read_summary(one))
    found = read_summary(other)
    assert found.metadata["own"] == [{"k": "v"}, {"k": "w"}]
    assert found.provenance is not None and found.provenance.stage == "other"
    assert len(found.metadata["dmrl.provenance"]) == 1
    assert [a.name for a in found.attachments] == ["recipe.toml", "notes"]
    assert found.attachments[-1] == read_summary(one).attachments[-1]
    assert (found.attachments[-1].media_type, found.attachments[-1].data) == (
        "text/plain",
        b"hello",
    )


def test_licence_title_is_the_first_line_of_the_licence_file(tmp_path: Path) -> None:
    source = tmp_path / "photo.jpg"
    source.write_bytes(b"x")
    assert find_licence_file(source) is None
    (tmp_path / "LICENSES").write_text("no")
    (tmp_path / "LICENCE.md").mkdir()
    assert find_licence_file(tmp_path) is None
    found = tmp_path / "LICENSE.txt"
    found.write_text("\n## " + "CC BY 4.0" + "x" * 200 + "\nmore\n")
    assert find_licence_file(source) == find_licence_file(tmp_path) == found
    assert extract_licence_title(found) == ("CC BY 4.0" + "x" * 200)[:100]
    found.write_text(" \n")
    assert extract_licence_title(found) == "empty"


def test_licences_of_several_recordings_are_combined(tmp_path: Path) -> None:
    paths = [
        write_recording(tmp_path / "a.mcap", (LICENCES_METADATA, {"b": "MIT"})),
        write_recording(tmp_path / "b.mcap", (LICENCES_METADATA, {"a": "CC0"})),
        write_recording(tmp_path / "c.mcap"),
    ]
    found = dict(pair for path in paths for pair in licences_in(read_summary(path)))
    assert found == {"a": "CC0", "b": "MIT"}


@pytest.mark.parametrize("indexed", [True, False])
def test_two_channels_of_one_topic_are_one_topic(indexed: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        kinds = IndexType.ALL if indexed else IndexType.NONE
        writer = Writer(stream, index_types=kinds, use_statistics=indexed)
        writer.start()
        schema = writer.register_schema("dmrl.v1.Height", "protobuf", serialize_schema("Height"))
        for number, count in ((0, 3), (1, 4)):
            metadata = {"n": str(number)}
            channel = writer.register_channel("/cf1/height", "protobuf", schema, metadata)
            for k in range(count):
                data = message_class("Height")(height_m=1.0).SerializeToString()
                writer.add_message(channel, 5 + 10 * k + number, data, 0)
        writer.finish()
    found = read_summary(path)
    assert (found.count, found.topics["/cf1/height"].count) == (7, 7)
    assert (found.start_ns, found.end_ns) == (5, 36)
    assert read_channel(path, "/cf1/height").metadata == (("n", "0"),)
    times = [5, 6, 15, 16, 25, 26, 36]
    assert read_log_times(path, ["/cf1/height", "/none"]) == {"/cf1/height": pytest.approx(times)}


@pytest.mark.parametrize("indexed", [True, False])
@pytest.mark.parametrize("publish_ns", [2**64 - 1, 2**63])
def test_time_beyond_int64_is_reported(publish_ns: int, indexed: bool, tmp_path: Path) -> None:
    """Read from a message index as int64, such a time would be negative."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, index_types=IndexType.ALL if indexed else IndexType.NONE)
        writer.start()
        schema = writer.register_schema("dmrl.v1.Height", "protobuf", serialize_schema("Height"))
        channel = writer.register_channel("/cf1/height", "protobuf", schema)
        writer.add_message(channel, 5, b"", publish_ns)
        writer.finish()
    with pytest.raises(RecordingError, match="beyond the year 2262"):
        list(read_raw(path))


@pytest.mark.parametrize("log_ns", [2**64 - 1, 2**63, 2**63 - 1])
def test_time_beyond_2262_is_reported_by_every_reader(log_ns: int, tmp_path: Path) -> None:
    """Every command reports the same error for such a file."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("dmrl.v1.Height", "protobuf", serialize_schema("Height"))
        writer.add_message(
            writer.register_channel("/cf1/height", "protobuf", schema), log_ns, b"", 5
        )
        writer.finish()
    out = tmp_path / "out.mcap"
    for read in (
        read_summary,
        check,
        lambda p: list(read_raw(p)),
        lambda p: read_log_times(p, ["/cf1/height"]),
        lambda p: trim(p, out),
        lambda p: merge([p], out),
    ):
        with pytest.raises(RecordingError, match=r"beyond the year 2262.*dmrl recover"):
            read(path)


def test_log_times_are_half_open(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "a.mcap")
    found = read_log_times(path, ["/cf1/height"], start_ns=20, end_ns=50)
    assert found["/cf1/height"].tolist() == [20, 30, 40]
    assert read_log_times(path, ["/cf1/height"])["/cf1/height"].tolist() == list(range(0, 100, 10))


def test_messages_of_a_span_come_in_batches(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "a.mcap")
    for start, end, times in (
        (20, 50, [20, 30, 40]),
        (None, 21, [0, 10, 20]),
        (71, None, [80, 90]),
    ):
        found = iter_batches(path, start_ns=start, end_ns=end)
        assert [t for block, _ in found for t in block.time_ns.tolist()] == times
    assert [len(block) for block, _ in iter_batches_in_file_order(path)] == [10]
    held: Counter[int] = Counter()
    for block, _ in iter_batches(path):
        count_messages(held, block)
    assert list(held.values()) == [10]


def test_message_index_of_another_channel_or_length_is_refused() -> None:
    pairs = np.array([[5, 0], [7, 40]], "<i8").tobytes()
    raw = b"xy" + MESSAGE_INDEX_STRUCT.pack(7, 6 + len(pairs), 3, len(pairs)) + pairs
    found = parse_index_entries(raw, {3: 2})
    assert [column.tolist() for column in found] == [[3, 3], [5, 7], [0, 40], [2]]
    for wrong, at, number in (
        (raw, 2, 4),
        (raw, 3, 3),
        (raw, -len(raw) + 2, 3),
        (raw[:-1], 2, 3),
        (b"xy" + MESSAGE_INDEX_STRUCT.pack(8, 6 + len(pairs), 3, len(pairs)) + pairs, 2, 3),
        (b"xy" + MESSAGE_INDEX_STRUCT.pack(7, 7 + len(pairs), 3, len(pairs)) + pairs, 2, 3),
        (b"xy" + MESSAGE_INDEX_STRUCT.pack(7, 6 + 15, 3, 15) + pairs, 2, 3),
    ):
        with pytest.raises(McapError, match="message index"):
            parse_index_entries(wrong, {number: at})


@pytest.mark.parametrize("times", [[], [0], [5, 3, 9]])
def test_statistics_count_the_written_records(times: list[int], tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, MADE) as sink:
        for time_ns in times:
            sink.write(time_ns, "/cf1/height", message_class("Height")())
        sink.add_attachment("notes", "text/plain", b"hello")
    with path.open("rb") as stream:
        found = make_reader(stream).get_summary()
    assert found is not None and found.statistics is not None
    said = found.statistics
    assert (said.message_count, said.chunk_count) == (len(times), int(bool(times)))
    assert (said.message_start_time, said.message_end_time) == (
        min(times, default=0),
        max(times, default=0),
    )
    assert (said.channel_count, said.schema_count) == (len(found.channels), len(found.schemas))
    assert (said.channel_count, said.schema_count) == (int(bool(times)),) * 2
    assert said.attachment_count == len(found.attachment_indexes) == 2  # the other is the recipe
    assert said.metadata_count == len(found.metadata_indexes) >= 1
    assert list(said.channel_message_counts.values()) == [len(times)] * bool(times)


@pytest.mark.parametrize("time_ns", [2**64 - 1, 2**63, 99])
def test_message_index_times_must_lie_within_the_chunk(time_ns: int, tmp_path: Path) -> None:
    """Without a CRC nothing else reveals it, and readers would silently omit the message."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("dmrl.v1.Height", "protobuf", serialize_schema("Height"))
        channel = writer.register_channel("/cf1/height", "protobuf", schema)
        for log_ns in (5, 6, 7):
            writer.add_message(channel, log_ns, b"", log_ns)
        writer.finish()
    assert read_log_times(path, ["/cf1/height"])["/cf1/height"].tolist() == [5, 6, 7]
    data = bytearray(path.read_bytes())
    (at,) = (start for opcode, start, _ in iter_records(data) if opcode == Opcode.MESSAGE_INDEX)
    struct.pack_into("<Q", data, at + MESSAGE_INDEX_STRUCT.size, time_ns)
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=r"index of the chunk at byte .* is wrong"):
        read_log_times(path, ["/cf1/height"])
