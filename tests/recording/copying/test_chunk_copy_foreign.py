"""Copying recordings of other writers, in their compression, with and without indexes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.records import MessageIndex
from mcap.writer import ChunkBuilder, CompressionType, Writer

from dmrl.errors import RecordingError
from dmrl.messages import message_class, serialize_schema
from dmrl.recording import Provenance, merge, read_raw, rewrite, trim

from ..mcap_layout import Chunk, Layout, Message
from ..mcap_layout import Writer as FileWriter
from ..records import (
    assert_messages_unchanged,
    read_channel_topics,
    read_chunk_indexes,
    read_chunk_records,
)
from ..walk import walk

MADE = Provenance("test")


def write_foreign_recording(
    path: Path, fill: Callable[[Writer, int], None], **options: Any
) -> Path:
    """Write a file with the mcap package; ``fill`` gets the writer and the schema of heights."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        schema = writer.register_schema("dmrl.v1.Height", "protobuf", serialize_schema("Height"))
        fill(writer, schema)
        writer.finish()
    return path


@pytest.mark.heavy
@pytest.mark.parametrize("compression", list(CompressionType))
def test_chunks_of_other_writers_are_copied_in_their_compression(
    tmp_path: Path, compression: CompressionType
) -> None:
    rng = np.random.default_rng(0)

    def fill(writer: Writer, schema: int) -> None:
        image = serialize_schema("CompressedImage")
        pictures = writer.register_channel(
            "/cam",
            "protobuf",
            writer.register_schema("foxglove.CompressedImage", "protobuf", image),
        )
        heights = writer.register_channel("/cf1/height", "protobuf", schema)
        for k in range(16_000):
            writer.add_message(
                heights, k, message_class("Height")(height_m=k).SerializeToString(), k
            )
        for k in range(40):  # the first chunk has heights and images, the others only images
            data = message_class("CompressedImage")(data=rng.bytes(20_000)).SerializeToString()
            writer.add_message(pictures, k, data, k)

    path = write_foreign_recording(
        tmp_path / "a.mcap", fill, compression=compression, chunk_size=200_000
    )
    out = tmp_path / "out.mcap"
    rewrite(path, out, MADE, without=(), fresh=())
    assert_messages_unchanged(path, out, ["/cf1/height", "/cam"])
    assert len(set(read_chunk_records(path)) & set(read_chunk_records(out))) >= 6
    numbers = {n for n, c in read_channel_topics(out).items() if c != "/cam"}
    assert all(
        len({n in numbers for n in c.message_index_offsets}) == 1 for c in read_chunk_indexes(out)
    )


def test_chunk_that_contradicts_the_summary_is_not_copied(tmp_path: Path) -> None:
    def fill(writer: Writer, schema: int) -> None:
        channel = writer.register_channel("/cf1/height", "protobuf", schema)
        for k in range(5_000):
            writer.add_message(
                channel, k, message_class("Height")(height_m=k).SerializeToString(), k
            )

    path = write_foreign_recording(tmp_path / "a.mcap", fill, compression=CompressionType.NONE)
    data = bytearray(path.read_bytes())
    at = data.index(b"/cf1/height")
    data[at : at + 11] = b"/cf9/height"  # contradicts the summary, which has a CRC and counts
    crc = read_chunk_indexes(path)[0].chunk_start_offset + 9 + 24
    data[crc : crc + 4] = bytes(4)
    path.write_bytes(data)
    with pytest.raises(
        RecordingError, match="the definition of /cf9/height contradicts the summary"
    ):
        rewrite(path, tmp_path / "out.mcap", MADE, without=(), fresh=())
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.heavy
def test_empty_index_of_another_writer_is_not_copied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some writers index every channel in every chunk, even channels without messages there."""
    end = ChunkBuilder.end

    def end_with_empty_indexes(chunk: ChunkBuilder) -> bytes:
        for number in (1, 2):
            chunk.message_indices.setdefault(number, MessageIndex(number, []))
        return end(chunk)

    monkeypatch.setattr(ChunkBuilder, "end", end_with_empty_indexes)

    def fill(writer: Writer, schema: int) -> None:
        for topic in ("/cf1/height", "/cf2/height"):
            writer.register_channel(topic, "protobuf", schema)
        for k in range(20_000):
            data = message_class("Height")(height_m=k).SerializeToString()
            writer.add_message(1 + (k < 10_000), k, data, k)

    path = write_foreign_recording(tmp_path / "a.mcap", fill, chunk_size=100_000)
    out = tmp_path / "out.mcap"
    rewrite(path, out, MADE, without=())
    assert_messages_unchanged(path, out, ["/cf1/height", "/cf2/height"])
    assert {*read_chunk_indexes(path)[0].message_index_offsets} == {1, 2}
    assert {*read_chunk_indexes(out)[0].message_index_offsets} == {2}
    assert read_chunk_records(out)[0] == read_chunk_records(path)[0]


def test_large_chunk_of_definitions_only_is_copied(tmp_path: Path) -> None:
    """Some programs write all schemas to a first chunk that is too large to join to the next."""
    layout = Layout(crcs=False)
    layout.schemas[1] = "Kind", "jsonschema", b" " * 100_000
    layout.channels = {1: ("/a", 1, {}), 2: ("/b", 1, {"k": "v"})}
    layout.parts = [Chunk([], definitions=[1, 2]), Chunk([Message(1, 5, 5, b"x")])]
    path, out = tmp_path / "a.mcap", tmp_path / "out.mcap"
    path.write_bytes(FileWriter(layout).write())
    rewrite(path, out, MADE, without=(), fresh=())
    want = walk(path).comparable()
    assert walk(out).comparable() == want
    assert [topic for topic, *_ in want["channels"]] == ["/a", "/b"]


def test_a_recording_without_index_is_copied(tmp_path: Path) -> None:
    def fill(writer: Writer, schema: int) -> None:
        channel = writer.register_channel("/cf1/height", "protobuf", schema)
        for k in range(300):
            writer.add_message(
                channel, k, message_class("Height")(height_m=k).SerializeToString(), k
            )

    path = write_foreign_recording(tmp_path / "a.mcap", fill, use_chunking=False)
    out = tmp_path / "out.mcap"
    rewrite(path, out, MADE, without=(), fresh=())
    assert list(read_raw(out)) == list(read_raw(path))


def test_calibration_at_time_0_in_its_own_chunk_is_copied(tmp_path: Path) -> None:
    def fill(writer: Writer, schema: int) -> None:
        told = message_class("CameraCalibration")(width=320, distortion_model="x" * 500)
        camera = writer.register_channel(
            "/cf1/camera/calibration",
            "protobuf",
            writer.register_schema(
                "foxglove.CameraCalibration", "protobuf", serialize_schema("CameraCalibration")
            ),
        )
        writer.add_message(camera, 0, told.SerializeToString(), 0)
        height = writer.register_channel("/cf1/height", "protobuf", schema)
        for k in range(60):
            writer.add_message(
                height, k, message_class("Height")(height_m=k).SerializeToString(), k
            )

    path = write_foreign_recording(tmp_path / "a.mcap", fill, chunk_size=400)
    assert read_chunk_indexes(path)[0].message_end_time == 0
    out = tmp_path / "out.mcap"
    assert trim(path, out, start_ns=50, end_ns=55) == 6  # with the calibration
    assert [(r.topic, r.time_ns) for r in read_raw(out)] == [
        ("/cf1/camera/calibration", 50),
        *(("/cf1/height", k) for k in range(50, 55)),
    ]


def test_a_topic_without_messages_is_named_by_trim_and_ignored_by_merge(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def fill(writer: Writer, schema: int) -> None:
        heights = [writer.register_channel(f"/cf{k}/height", "protobuf", schema) for k in (1, 2)]
        writer.add_message(heights[0], 5, b"", 5)

    one = write_foreign_recording(tmp_path / "a.mcap", fill)
    with pytest.raises(RecordingError, match="no message on /cf2/height"):
        trim(one, tmp_path / "out.mcap", topics=["/cf2/*"])

    def fill_other(writer: Writer, schema: int) -> None:
        writer.register_channel("/cf1/height", "protobuf", schema)

    other = write_foreign_recording(tmp_path / "b.mcap", fill_other)
    merge([one, other], tmp_path / "out.mcap")
    assert not capsys.readouterr().err
