"""Building chunks message by message and in batches gives equal results."""

import zlib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Channel as McapChannel
from mcap.records import Schema

from dmrl.errors import RecordingError
from dmrl.messages import message_class, serialize_schema
from dmrl.recording import Provenance, RawMessage, RecordingWriter, read_raw
from dmrl.recording.mcap.batch_reader import iter_batches
from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.channel_registry import ChannelRegistry, _find_free_id
from dmrl.recording.mcap.chunks import chunk_builder as room
from dmrl.recording.mcap.chunks.chunk import ParsedChunk, parse_records
from dmrl.recording.mcap.chunks.chunk_builder import ChunkBuilder
from dmrl.recording.mcap.file_writer import serialize
from dmrl.recording.mcap.message_batch import MESSAGE_PREFIX_BYTES, MessageBatch
from dmrl.recording.mcap.message_index import parse_index_entries

Row = tuple[int, int, int, bytes]
ROWS: list[Row] = [(k % 3, 100 + k, 200 + k, bytes([k]) * (k % 5)) for k in range(12)]


def build_records(rows: list[Row]) -> tuple[np.ndarray, np.ndarray]:
    """Return the bytes of message records, and the start of each and the end of the last."""
    chunk = ChunkBuilder()
    for row in rows:
        chunk.add_message(*row)
    return np.frombuffer(bytes(chunk.data), np.uint8), np.array([*chunk.starts, len(chunk.data)])


@given(st.integers(0, 12), st.integers(0, 12), st.integers(0, 40))
def test_batch_fill_equals_single_messages(alone: int, skipped: int, defined: int) -> None:
    records, at = build_records(ROWS)
    one, many = ChunkBuilder(), ChunkBuilder()
    for chunk in (one, many):
        chunk.add_definition(b"\x03" + defined.to_bytes(8, "little") + bytes(defined))
        for row in ROWS[:alone]:
            chunk.add_message(*row)
    for row in ROWS[skipped:]:
        one.add_message(*row)
    assert many.fill(records, at[skipped:]) == len(ROWS) - skipped
    assert (one.data, one.starts) == (many.data, many.starts)
    assert list(parse_records(np.frombuffer(bytes(one.data), np.uint8)).batch.iter_rows()) == (
        ROWS[:alone] + ROWS[skipped:]
    )


def test_chunk_is_full_when_messages_no_longer_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    records, at = build_records([(1, k, k, b"x") for k in range(5)])
    each = MESSAGE_PREFIX_BYTES + 1
    for room_bytes, count in ((3 * each - 1, 2), (3 * each, 3), (5 * each, 5), (99 * each, 5)):
        monkeypatch.setattr(room, "CHUNK_BYTES", room_bytes)
        chunk = ChunkBuilder()
        first = chunk.fill(records, at)
        # The message that exceeds the limit still goes into the chunk, which is then full.
        assert (first, chunk.full) in ((count, False), (count + 1, True))
        assert len(chunk.data) == first * each
    monkeypatch.setattr(room, "CHUNK_BYTES", each)
    chunk = ChunkBuilder()
    chunk.add_message(1, 2, 3, b"x")
    assert not chunk.full
    chunk.add_definition(b"y")
    assert chunk.full


def test_compressed_chunk_has_a_message_index_and_resets_the_builder() -> None:
    chunk = ChunkBuilder()
    chunk.add_definition(b"\x03" + (2).to_bytes(8, "little") + b"ab")
    for row in ROWS:
        chunk.add_message(*row)
    data, starts = bytes(chunk.data), chunk.starts.tolist()
    chunk.age = 3
    packed = chunk.compress()
    assert zstandard.ZstdDecompressor().decompress(packed.data) == data
    times = [row[1] for row in ROWS]
    assert (packed.uncompressed_size, packed.first_ns, packed.last_ns) == (
        len(data),
        min(times),
        max(times),
    )
    found = parse_index_entries(packed.index.records, packed.index.offsets)
    told = zip(found.offset.tolist(), found.channel.tolist(), found.time_ns.tolist(), strict=True)
    assert sorted(told) == [(k, row[0], row[1]) for k, row in zip(starts, ROWS, strict=True)]
    assert packed.index.counts == Counter(row[0] for row in ROWS)
    assert (len(chunk.data), len(chunk.starts), chunk.age) == (0, 0, 0)


@pytest.mark.parametrize("chunk_bytes", [400, 2000])
def test_appended_batches_equal_appended_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk_bytes: int
) -> None:
    # The smaller size is less than a topic's definition takes, and must still make progress.
    monkeypatch.setattr(room, "CHUNK_BYTES", chunk_bytes)
    paths = [tmp_path / name for name in ("a.mcap", "b.mcap")]
    with RecordingWriter(paths[0], Provenance("test")) as sink:
        for k in range(100):
            sink.write(k, "/cf1/height", message_class("Height")(height_m=k), publish_ns=k + 7)
            if k % 9 == 0:
                image = message_class("CompressedImage")(data=bytes([k]) * 90, format="png")
                sink.write(k, "/cf1/camera/image", image)
                sink.write(k, "/cf2/height", message_class("Height")(height_m=-k))
    with RecordingWriter(paths[1], Provenance("test")) as sink:
        for block, channels in iter_batches(paths[0]):
            sink.chunk_writer.append_batch(block, channels)
    one, other = (
        sorted(read_raw(path), key=lambda raw: (raw.time_ns, raw.topic)) for path in paths
    )
    assert len(one) == 124
    assert one == other


@pytest.mark.parametrize("wrong", [(-5, 1), (1, -5)])
def test_batch_with_a_negative_time_is_refused_by_topic(
    tmp_path: Path, wrong: tuple[int, int]
) -> None:
    channels = {k: Channel(f"/{k}", "dmrl.v1.Height", serialize_schema("Height")) for k in (1, 2)}
    records, at = build_records([(1, 3, 3, b""), (2, 3, 3, b"")])
    one, two = np.array([1, 2]), np.array([[3, 3], wrong])
    block = MessageBatch(records, one, two[:, 0], two[:, 1], at[:-1] + MESSAGE_PREFIX_BYTES, at[1:])
    with (
        pytest.raises(RecordingError, match=r"on /2 is negative"),
        RecordingWriter(tmp_path / "a.mcap", Provenance("test")) as sink,
    ):
        sink.chunk_writer.append_batch(block, channels)


def build_channel(topic: str, schema: str = "a", **more: str) -> Channel:
    """Build a channel whose schema has this name and the same text as data."""
    return Channel(topic, schema, schema.encode(), **more)


def read_definitions(defined: ChannelRegistry, one: Channel) -> list[McapChannel | Schema]:
    """Return the definitions that the writer puts before the first message of a channel."""
    records = defined.definition_records(defined.get_channel_id(one))
    return list(parse_records(np.frombuffer(records, np.uint8)).iter_definitions())


def list_summary_ids(defined: ChannelRegistry) -> tuple[list[int], list[int]]:
    """Return the IDs of the schemas and of the channels that the summary repeats."""
    records = [
        np.frombuffer(b"".join(kind), np.uint8) for kind in defined.list_written_definitions()
    ]
    schemas, channels = ([one.id for one in parse_records(r).iter_definitions()] for r in records)
    return schemas, channels


def test_channels_are_numbered_once_and_defined_once() -> None:
    defined = ChannelRegistry()
    assert [defined.get_channel_id(build_channel(t)) for t in ("/a", "/b", "/a")] == [1, 2, 1]
    schema, own = read_definitions(defined, build_channel("/a"))
    assert isinstance(schema, Schema)
    assert isinstance(own, McapChannel)
    assert (schema.id, schema.name, schema.data) == (1, "a", b"a")
    assert (own.id, own.topic, own.schema_id) == (1, "/a", 1)
    assert read_definitions(defined, build_channel("/a")) == []
    (second,) = read_definitions(defined, build_channel("/b"))  # of the same schema
    assert isinstance(second, McapChannel)
    assert (second.id, second.schema_id) == (2, 1)
    nameless = read_definitions(defined, Channel("/e", "", b"", ""))
    assert [(type(one), one.schema_id) for one in nameless if isinstance(one, McapChannel)] == [
        (McapChannel, 0)
    ]
    assert list_summary_ids(defined) == ([1], [1, 2, 3])


def test_chunk_is_copied_if_definitions_match() -> None:
    """Here channels 4 and 6 of schema 9 are defined in the chunk before their messages."""
    mine = {n: build_channel(topic) for n, topic in ((4, "/a"), (6, "/b"))}
    records = {n: McapChannel(n, c.topic, "protobuf", {}, 9) for n, c in mine.items()}
    schema = Schema(9, b"a", "protobuf", "a")

    def build_parsed(*parts: McapChannel | Schema | int) -> ParsedChunk:
        held = ChunkBuilder()
        for part in parts:
            if isinstance(part, int):
                held.add_message(part, 1, 2, b"x")
            else:
                held.add_definition(serialize(part))
        return parse_records(np.frombuffer(bytes(held.data), np.uint8))

    def can_copy(defined: ChannelRegistry, one: ParsedChunk) -> bool:
        return defined.can_copy_chunk(one.batch, one, mine)

    def adopt_and_copy(*parts: McapChannel | Schema | int) -> tuple[ChannelRegistry, bool]:
        defined = ChannelRegistry()
        defined.adopt_channels(mine, records)
        return defined, can_copy(defined, build_parsed(*parts))

    defined, copied = adopt_and_copy(schema, records[4], 4, records[6], 6, 4)
    assert copied and defined.written == {4, 6}
    assert list_summary_ids(defined) == ([9], [4, 6])
    assert defined.definition_records(4) == defined.definition_records(6) == b""
    assert can_copy(defined, build_parsed(6, 4))  # both were defined by an earlier chunk
    for parts in (
        (records[4], 4),  # without its schema
        (schema, 4),  # not defined
        (schema, records[4], 4, 6),
        (schema, McapChannel(4, "/a", "protobuf", {"k": "v"}, 9), 4),  # other metadata
        (Schema(9, b"b", "protobuf", "a"), records[4], 4),
        (schema, records[4], McapChannel(7, "/c", "protobuf", {}, 9), 4),
    ):
        defined, copied = adopt_and_copy(*parts)
        assert not copied and not defined.written
    defined = ChannelRegistry()
    defined.get_channel_id(mine[6])
    assert not can_copy(defined, build_parsed(schema, records[6], 6))  # has another ID here


def test_copied_channels_keep_their_ids_if_free() -> None:
    defined = ChannelRegistry()
    defined.get_channel_id(build_channel("/a"))
    kept, taken, other = (
        build_channel("/c", "b"),
        build_channel("/d", "c"),
        build_channel("/f", "d"),
    )

    def build_record(number: int, one: Channel, schema_id: int) -> dict[int, McapChannel]:
        return {number: McapChannel(number, one.topic, "protobuf", {}, schema_id)}

    for number, one, schema_id in ((9, kept, 40), (1, taken, 50), (12, other, 40)):
        defined.adopt_channels({number: one}, build_record(number, one, schema_id))
    assert [defined.get_channel_id(one) for one in (kept, other, taken)] == [9, 12, 13]
    ids = []
    for one, name in ((kept, "b"), (other, "d"), (taken, "c")):
        schema, own = read_definitions(defined, one)
        assert isinstance(schema, Schema)
        assert isinstance(own, McapChannel)
        assert (schema.name, own.schema_id) == (name, schema.id)
        ids.append(schema.id)
    assert ids[0] == 40
    assert len({1, *ids}) == 4  # a different schema with the same ID gets a new ID


def test_free_ids_are_reused_when_exhausted() -> None:
    assert [_find_free_id(taken) for taken in ({}, {1: 0}, {7: 0}, {65_534: 0})] == [
        1,
        2,
        8,
        65_535,
    ]
    assert _find_free_id({65_535: 0, 1: 0, 3: 0}) == 2


def test_raw_message_has_its_topic_without_channel_id() -> None:
    assert RawMessage(1, 2, build_channel("/a"), b"x").topic == "/a"


def test_incompressible_chunks_are_stored_uncompressed() -> None:
    noise = np.random.default_rng(0).integers(0, 256, 60_000, np.uint8).tobytes()
    for payload, images, wanted in (
        (noise, True, ""),
        (noise, False, "zstd"),
        (bytes(60_000), True, "zstd"),
    ):
        chunk = ChunkBuilder(images=images)
        for k in range(3):
            chunk.add_message(1, k, k, payload)
        packed = chunk.compress()
        assert packed.compression == wanted
        data = zstandard.ZstdDecompressor().decompress(packed.data) if wanted else packed.data
        assert len(data) == packed.uncompressed_size > 180_000
        assert zlib.crc32(data) == packed.crc
