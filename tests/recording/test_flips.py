"""A changed byte of a small recording is an error, or changes nothing that is read."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Metadata
from mcap.writer import Writer

from dmrl.errors import RecordingError
from dmrl.recording import (
    check,
    iter_topic_batches,
    read_log_times,
    read_raw,
    read_summary,
    read_table,
    recover,
    sample_topics,
    trim,
)

from .records import TOPICS, iter_records, write_small_recording

PATTERNS = (0x01, 0x80, 0xFF)
OPCODES = (0x00, Opcode.FOOTER, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.METADATA, 0x7F, 0x90)


def read_everything(path: Path) -> list[Any]:
    """Return what every function that reads a recording returns."""
    wanted = dict.fromkeys(TOPICS)
    return [
        read_summary(path),
        [(raw.time_ns, raw.publish_ns, raw.channel, raw.data) for raw in read_raw(path)],
        [(raw.time_ns, raw.data) for raw in read_raw(path, start_ns=15, end_ns=26)],
        {topic: read_table(path, topic).to_pydict() for topic in TOPICS},
        {topic: times.tolist() for topic, times in read_log_times(path, TOPICS).items()},
        [{t: b.to_pydict() for t, b in seen.items()} for seen in iter_topic_batches(path, wanted)],
        {
            topic: batch.to_pydict()
            for topic, batch in sample_topics(path, wanted, start_ns=0, end_ns=100).items()
        },
        check(path),
    ]


def iter_flips(data: bytes, patterns: tuple[int, ...], step: int = 1) -> Iterator[tuple[int, int]]:
    """Yield offset and new value of every ``step``-th byte, XORed with each pattern."""
    for at in range(0, len(data), step):
        for pattern in patterns:
            yield at, data[at] ^ pattern


def iter_opcode_changes(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield offset and new value of each byte that looks like the opcode of a short record."""
    for at, byte in enumerate(data):
        if 0x01 <= byte <= 0x0F and data[at + 3 : at + 9] == bytes(6):
            yield from ((at, int(code)) for code in OPCODES if code != byte)


def count_harmless_changes(
    path: Path, changes: Iterator[tuple[int, int]], read: Callable[[Path], Any]
) -> int:
    """Read the file once per change of one byte; return how many changes gave no error.

    Assert that those change nothing that is read, and that the errors name a way out.
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
@pytest.mark.heavy
def test_every_flipped_byte_is_noticed_or_changes_nothing(step: int, tmp_path: Path) -> None:
    """Every third byte touches each number of a record, since those have four or eight bytes."""
    path = write_small_recording(tmp_path / "a.mcap")
    data = path.read_bytes()
    unseen = count_harmless_changes(path, iter_flips(data, (0xFF,), step), read_everything)
    # Harmless are, for example, the names in the header and the CRC of the data section.
    assert unseen < 100 / step


@pytest.mark.slow
def test_every_pattern_of_flips_is_noticed_or_changes_nothing(tmp_path: Path) -> None:
    path = write_small_recording(tmp_path / "a.mcap")
    data = path.read_bytes()
    count_harmless_changes(path, iter_flips(data, PATTERNS), read_everything)


@pytest.mark.heavy
def test_every_substituted_opcode_is_noticed_or_changes_nothing(tmp_path: Path) -> None:
    path = write_small_recording(tmp_path / "a.mcap")
    data = path.read_bytes()
    changes = list(iter_opcode_changes(data))
    assert len(changes) > 20 * len(OPCODES)
    count_harmless_changes(path, iter(changes), read_everything)


@pytest.mark.heavy
@pytest.mark.parametrize("step", [7, pytest.param(1, marks=pytest.mark.slow)])
def test_recover_reports_a_whole_file_only_if_nothing_was_lost(step: int, tmp_path: Path) -> None:
    path = write_small_recording(tmp_path / "a.mcap")
    data = path.read_bytes()
    sound = [(raw.time_ns, raw.topic, raw.data) for raw in read_raw(path)]
    for at in range(8, len(data), step):
        path.write_bytes(data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :])
        out = tmp_path / "b.mcap"
        try:
            result = recover(path, out)
        except RecordingError:
            continue
        found = read_summary(out)
        got = [(raw.time_ns, raw.topic, raw.data) for raw in read_raw(out)]
        assert result.messages == len(got)
        assert set(got) <= set(sound), at
        if result.whole:
            assert got == sound, at
            assert found.metadata["dmrl.split"] == [{"train": "[[0, 10]]"}], at
            assert found.attachments[-1].data == b"seven", at
        elif result.counted:
            assert len(got) + sum(result.missing.values()) == len(sound), at
        out.unlink()


def remove_chunk(data: bytes, number: int) -> bytes:
    """Return the file without its ``number``-th chunk and the message indexes of that chunk."""
    found = list(iter_records(data))
    chunks = [k for k, (opcode, _, _) in enumerate(found) if opcode == Opcode.CHUNK]
    first = last = chunks[number]
    while found[last + 1][0] == Opcode.MESSAGE_INDEX:
        last += 1
    return data[: found[first][1]] + data[found[last][2] :]


def test_removed_chunk_is_reported_with_its_losses_by_topic(tmp_path: Path) -> None:
    path = write_small_recording(tmp_path / "a.mcap")
    path.write_bytes(remove_chunk(path.read_bytes(), 1))
    for use in (
        read_summary,
        check,
        lambda p: list(read_raw(p)),
        lambda p: trim(p, tmp_path / "c"),
    ):
        with pytest.raises(RecordingError, match="dmrl recover"):
            use(path)
    result = recover(path, tmp_path / "b.mcap")
    assert (result.messages, result.whole, result.counted) == (3, False, True)
    assert result.missing == {"/cf1/height": 2, "/cf1/range/cf2": 2}


def test_messages_of_a_damaged_chunk_are_counted_even_without_the_end(tmp_path: Path) -> None:
    path = write_small_recording(tmp_path / "a.mcap")
    data = bytearray(path.read_bytes())
    second = [at for opcode, at, _ in iter_records(data) if opcode == Opcode.CHUNK][1]
    data[second + 70] ^= 0xFF
    path.write_bytes(data[:-100])
    result = recover(path, tmp_path / "b.mcap")
    assert (result.messages, result.damaged_chunks, result.counted) == (3, 1, False)
    assert result.missing == {"/cf1/height": 2, "/cf1/range/cf2": 2}


def test_checksums_copied_by_other_programs_are_ignored(tmp_path: Path) -> None:
    """`mcap filter --include-metadata` copies dmrl's checksums, which do not fit its output."""
    path, copy = write_small_recording(tmp_path / "a.mcap"), tmp_path / "b.mcap"
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
    assert read_summary(copy).metadata["mine"] == [{"a": "1"}]
    assert read_log_times(copy, ["/cf1/height"]).keys() == {"/cf1/height"}
    assert not [finding for finding in check(copy) if finding.level == "error"]
    assert recover(copy, tmp_path / "c.mcap").whole


def test_recover_reports_repeated_chunks_as_not_whole(tmp_path: Path) -> None:
    path = write_small_recording(tmp_path / "a.mcap")
    data = path.read_bytes()
    parts = [(opcode, data[start:end]) for opcode, start, end in iter_records(data)]
    chunk = next(part for part in parts if part[0] == Opcode.CHUNK)
    end = next(k for k, (opcode, _) in enumerate(parts) if opcode == Opcode.DATA_END)
    body = b"".join(record for _, record in [*parts[: end + 1], chunk, *parts[end + 1 :]])
    path.write_bytes(data[:8] + body + data[:8])
    result = recover(path, tmp_path / "b.mcap")
    assert result.messages > 7
    assert not result.whole
