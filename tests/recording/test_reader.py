"""Reading recordings: order, time spans, columns, samples, and errors of damaged files."""

import io
import struct
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from mcap.writer import CompressionType, IndexType, Writer

from dmrl.errors import MissingTopic, RecordingError
from dmrl.messages import message_class, serialize_schema
from dmrl.recording import (
    Provenance,
    RecordingWriter,
    iter_columns,
    iter_topic_batches,
    read,
    read_log_times,
    read_raw,
    read_summary,
    read_table,
    sample_topics,
)
from dmrl.recording.mcap import batch_reader
from dmrl.recording.mcap.chunks import chunk_builder, chunk_reader

HEIGHT = message_class("Height")


def write_foreign_heights(path: Path, times_ns: list[int], **options: object) -> Path:
    """Write heights in metres equal to their times in ns, with the mcap package."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=200, **options)  # type: ignore[arg-type]
        writer.start()
        schema = writer.register_schema("dmrl.v1.Height", "protobuf", serialize_schema("Height"))
        channel = writer.register_channel("/cf1/height", "protobuf", schema)
        for t in times_ns:
            writer.add_message(channel, t, HEIGHT(height_m=t).SerializeToString(), t)
        writer.finish()
    return path


SHUFFLED = np.random.default_rng(0).permutation(500).tolist()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK},
        {"use_chunking": False},
        {"use_statistics": False, "use_summary_offsets": False, "repeat_channels": False,
         "repeat_schemas": False, "index_types": IndexType.NONE},
    ],
    ids=["indexed", "lz4", "uncompressed", "no index", "chunk index", "unchunked", "no summary"],
)  # fmt: skip
@pytest.mark.heavy
def test_any_complete_file_is_read_in_time_order(
    tmp_path: Path, options: dict[str, object]
) -> None:
    path = write_foreign_heights(tmp_path / "a.mcap", SHUFFLED, **options)
    assert [s.message.height_m for s in read(path)] == list(range(500))
    assert read_table(path, "/cf1/height")["height_m"].to_pylist() == list(range(500))
    assert read_summary(path).topics["/cf1/height"].count == 500
    seen = sample_topics(path, {"/cf1/height": None}, start_ns=100, end_ns=400)["/cf1/height"]
    found = seen["height_m"].to_pylist()
    assert found == sorted(found)
    assert 100 <= found[0] < found[-1] < 400


def test_time_spans_are_half_open(flight: Path) -> None:
    got = list(read(flight, "/cf1/range/cf2", start_ns=100_000_000, end_ns=300_000_000))
    assert [s.time_ns for s in got] == [100_000_000, 200_000_000]
    (batch,) = iter_columns(flight, "/cf1/range/cf2", start_ns=100_000_000, end_ns=300_000_000)
    assert batch["log_time"].to_pylist() == [100_000_000, 200_000_000]


@pytest.mark.parametrize("times_ns", [SHUFFLED, [400, *range(400), *range(401, 500)]])
@pytest.mark.heavy
def test_time_spans_of_overlapping_chunks_are_read_completely(
    tmp_path: Path, times_ns: list[int]
) -> None:
    path = write_foreign_heights(tmp_path / "a.mcap", times_ns)
    for low, high in ((0, 1), (17, 18), (100, 399), (399, 402), (499, 500), (500, 900), (30, 30)):
        found = read_table(path, "/cf1/height", start_ns=low, end_ns=high)
        assert found["log_time"].to_pylist() == list(range(low, min(high, 500)))


@pytest.mark.heavy
def test_equal_times_keep_their_order_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(30_000):
            sink.write(k // 10_000, "/cf1/height", HEIGHT(height_m=k))
    assert [s.message.height_m for s in read(path)] == list(range(30_000))


def test_columns_equal_messages(flight: Path) -> None:
    table = read_table(flight, "/cf1/attitude")
    got = [
        (s.time_ns, s.message.roll_rad, s.message.pitch_rad) for s in read(flight, "/cf1/attitude")
    ]
    assert (
        list(
            zip(*(table[c].to_pylist() for c in ("log_time", "roll_rad", "pitch_rad")), strict=True)
        )
        == got
    )
    assert table.schema.names[:2] == ["log_time", "publish_time"]


def test_only_the_fields_asked_for_are_decoded(flight: Path) -> None:
    assert read_table(flight, "/cf1/attitude", fields=["roll_rad"]).schema.names == [
        "log_time",
        "publish_time",
        "roll_rad",
    ]
    assert read_table(flight, "/cf1/attitude", fields=[]).num_rows == 4000


def test_topics_are_selected_by_pattern(flight: Path) -> None:
    assert {raw.topic for raw in read_raw(flight, "/*/range/*")} == {"/cf1/range/cf2"}


def test_missing_topic_suggests_the_nearest_before_reading(flight: Path) -> None:
    with pytest.raises(
        MissingTopic, match=r"no topic /cf1/range/cf3 .* Did you mean /cf1/range/cf2\?"
    ):
        next(read(flight, "/cf1/range/cf3"))


def test_a_topic_with_another_schema_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("dmrl.v1.Height", "protobuf", serialize_schema("Height"))
        writer.add_message(writer.register_channel("/cf1/labels", "protobuf", schema), 0, b"", 0)
        writer.finish()
    with pytest.raises(
        RecordingError, match=r"/cf1/labels carries dmrl.v1.Height, not dmrl.v1.PeerLabels"
    ):
        list(read(path, "/cf1/labels"))


def test_a_type_unknown_to_dmrl_is_read_by_its_own_schema(tmp_path: Path) -> None:
    path = write_foreign_heights(tmp_path / "a.mcap", [1, 2])
    data = path.read_bytes()
    assert data.count(b"Height") >= 2
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start()
        renamed = (
            serialize_schema("Height").replace(b"Height", b"Weight").replace(b"dmrl.v1", b"else.v1")
        )
        schema = writer.register_schema("else.v1.Weight", "protobuf", renamed)
        channel = writer.register_channel("/scale", "protobuf", schema)
        writer.add_message(channel, 3, HEIGHT(height_m=2.5).SerializeToString(), 3)
        writer.finish()
    assert read_table(path, "/scale")["height_m"].to_pylist() == [2.5]
    assert [s.message.height_m for s in read(path)] == [2.5]


def test_a_json_channel_is_copied_but_not_decoded(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel(
            "/note", "json", writer.register_schema("Note", "jsonschema", b"{}")
        )
        writer.add_message(channel, 0, b"{}", 0)
        writer.finish()
    assert [raw.data for raw in read_raw(path)] == [b"{}"]
    with pytest.raises(RecordingError, match=r"/note is json, not protobuf"):
        list(read(path))


def test_memory_stays_bounded_when_chunks_touch_in_time(tmp_path: Path) -> None:
    """Chunks that share only their border time are not read as one block."""
    path = write_foreign_heights(tmp_path / "a.mcap", [t for k in range(300) for t in (k, k)])
    assert max(len(batch) for batch in iter_columns(path, "/cf1/height")) < 50


@pytest.mark.parametrize("share", [0.9, 0.5, 0.1])
def test_error_of_a_truncated_file_names_the_way_out(
    flight: Path, tmp_path: Path, share: float
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(flight.read_bytes()[: int(flight.stat().st_size * share)])
    for use in (
        read_summary,
        lambda p: list(read(p)),
        lambda p: list(iter_columns(p, "/cf1/attitude")),
    ):
        with pytest.raises(RecordingError, match=r"cut short.*dmrl recover"):
            use(cut)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "is empty"),
        (b"\x89MCAP0\r", "is not an MCAP file"),
        (b"\x89MCAP0\r\n", "cut short"),
        (b"\x89PNG\r\n\x1a\n" + bytes(50), r"is not an MCAP file: it begins with b'\\x89PNG"),
    ],
    ids=["zero bytes", "7 bytes", "8 bytes", "a PNG"],
)
def test_invalid_recording_is_reported(tmp_path: Path, content: bytes, complaint: str) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=complaint):
        list(read(path))


def test_missing_files_and_folders_are_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no recording"):
        read_summary(tmp_path / "none.mcap")
    with pytest.raises(RecordingError, match="is a folder"):
        read_summary(tmp_path)


@pytest.mark.heavy
def test_every_flipped_byte_is_an_error_or_changes_nothing(flight: Path, tmp_path: Path) -> None:
    """A flipped byte raises RecordingError or changes no message."""
    data = flight.read_bytes()
    good = list(read_raw(flight))
    path = tmp_path / "bad.mcap"
    rng = np.random.default_rng(1)
    for at in rng.integers(8, len(data), 400):
        path.write_bytes(data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :])
        try:
            got = list(read_raw(path))
        except RecordingError:
            continue
        # A flip in metadata, or in an unused part of the summary, changes no message.
        assert [(r.time_ns, r.data) for r in got] == [(r.time_ns, r.data) for r in good], at


def test_error_of_a_damaged_message_names_its_topic(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("dmrl.v1.Height", "protobuf", serialize_schema("Height"))
        channel = writer.register_channel("/cf1/height", "protobuf", schema)
        writer.add_message(channel, 0, struct.pack("<Bf", 9, 1.0), 0)  # a double cut in half
        writer.finish()
    with pytest.raises(RecordingError, match="/cf1/height"):
        list(iter_columns(path, "/cf1/height"))
    with pytest.raises(RecordingError, match="/cf1/height"):
        list(read(path))


def test_an_empty_recording_has_no_messages(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, Provenance("test")):
        pass
    assert list(read(path)) == []
    assert read_summary(path).count == 0
    assert io.BytesIO(path.read_bytes()).read(8) == b"\x89MCAP0\r\n"


def test_span_without_messages_gives_an_empty_table(flight: Path) -> None:
    table = read_table(flight, "/cf1/attitude", start_ns=10**15)
    assert table.num_rows == 0
    assert table.schema == read_table(flight, "/cf1/attitude").schema
    assert read_table(flight, "/cf1/attitude", fields=["roll_rad"], end_ns=0).num_rows == 0


@pytest.mark.heavy
def test_topics_read_in_one_pass_equal_those_read_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch_reader, "JOINED_BYTES", 10_000)
    path = tmp_path / "two.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(20_000):
            sink.write(k * 10, "/cf1/height", message_class("Height")(height_m=k))
            if k % 3 == 0:
                sink.write(k * 10, "/cf1/range/cf2", message_class("UwbRange")(range_m=-k))
    wanted = {"/cf1/height": None, "/cf1/range/cf2": ("range_m",), "/cf9/height": None}
    found: dict[str, list[pa.RecordBatch]] = {}
    for stretch in iter_topic_batches(path, wanted, start_ns=100, end_ns=190_000):
        for topic, batch in stretch.items():
            found.setdefault(topic, []).append(batch)
    assert sorted(found) == ["/cf1/height", "/cf1/range/cf2"]
    for topic, batches in found.items():
        alone = read_table(path, topic, start_ns=100, end_ns=190_000)
        assert pa.Table.from_batches(batches).equals(alone)
    times = read_log_times(path, wanted, start_ns=100, end_ns=190_000)
    assert sorted(times) == ["/cf1/height", "/cf1/range/cf2"]
    for topic, ns in times.items():
        assert ns.tolist() == [t for b in found[topic] for t in b["log_time"].to_pylist()]


def test_topic_samples_cover_the_recording_in_few_chunks(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "chunks.mcap"
    monkeypatch.setattr(chunk_builder, "CHUNK_BYTES", 1000)
    with RecordingWriter(path, Provenance("test")) as sink:
        for raw in read_raw(flight):
            sink.write_raw(raw)
        # The message is last in the file, but its time lies inside the recording.
        sink.write(39_000_000_000, "/cf2/height", HEIGHT(height_m=2.0))
    unpacked, chunks = chunk_reader.decompress, set()
    monkeypatch.setattr(
        chunk_reader,
        "decompress",
        lambda chunk, at: chunks.add(at) or unpacked(chunk, at),
    )
    wanted = {"/cf1/attitude": ("roll_rad",), "/cf1/range/cf2": None, "/cf2/height": None}
    seen = sample_topics(path, {**wanted, "/cf9/height": None}, start_ns=0, end_ns=10**12)
    assert seen.keys() == wanted.keys()
    assert seen["/cf2/height"]["height_m"].to_pylist() == [2.0]
    times = seen["/cf1/attitude"]["log_time"].to_numpy()
    assert times[[0, -1]].tolist() == [0, 39_990_000_000]
    assert np.diff(times).max() < 40_000_000_000 / 12
    assert len(chunks) <= 33


@pytest.mark.heavy
def test_topic_samples_include_topics_of_other_chunks(tmp_path: Path) -> None:
    # Every chunk has few messages but spans the whole recording.
    times = [time for k in range(1, 499) for time in (0, k, 499)]
    path = write_foreign_heights(tmp_path / "a.mcap", times)
    (time_ns,) = sample_topics(path, {"/cf1/height": None}, start_ns=251, end_ns=252)[
        "/cf1/height"
    ][0]
    assert time_ns.as_py() == 251
