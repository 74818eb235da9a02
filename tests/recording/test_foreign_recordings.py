"""Valid recordings of other writers are read completely; damaged ones are refused."""

import struct
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

import dmrl
from dmrl.errors import RecordingError
from dmrl.recording import check, merge, read_summary, recover, trim
from dmrl.stages import info

from .records import iter_records, write_small_recording
from .test_renames import write_records
from .walk import walk


def find_foreign_recording(data: Path, name: str) -> Path:
    """Return the first recording of a folder of the test data; skip the test without it."""
    for folder in ("strangers", "faults"):
        if found := sorted((data / folder / name).glob("*.mcap")):
            return found[0]
    pytest.skip(f"{name} is not there")


def test_attachments_of_one_name_keep_their_types_and_times(data: Path, tmp_path: Path) -> None:
    path = find_foreign_recording(data, "mcap-attachments")
    want = walk(path).comparable()
    assert [name for name, *_ in want["attachments"]] == ["cal.yaml", "pic.png", "pic.png"]
    trim(path, tmp_path / "a.mcap")
    recover(path, tmp_path / "b.mcap")
    empty = tmp_path / "empty.mcap"
    with dmrl.writer(empty):
        pass
    merge([path, empty], tmp_path / "c.mcap")
    for name in "abc":
        assert walk(tmp_path / f"{name}.mcap").comparable() == want | {
            "schemas": sorted(set(want["schemas"]))
        }


def test_trailing_bytes_of_a_record_are_accepted(data: Path, tmp_path: Path) -> None:
    path = find_foreign_recording(data, "mcap-padded-TenMessages")
    assert not [f for f in check(path) if f.level == "error"]
    trim(path, tmp_path / "out.mcap")
    assert walk(tmp_path / "out.mcap").comparable() == walk(path).comparable()


def test_statistics_with_a_wrong_time_lose_nothing_and_are_reported(
    data: Path, tmp_path: Path
) -> None:
    path = find_foreign_recording(data, "mcap-stat_start_late")
    assert trim(path, tmp_path / "out.mcap") == 20
    assert walk(tmp_path / "out.mcap").comparable() == walk(path).comparable()
    (finding,) = (f for f in check(path) if "statistics" in f.text)
    assert "state times from 1000000000100000000" in finding.text
    assert info.run(path).summary.start_ns == 1_000_000_000_000_000_000


def test_a_chunk_index_that_omits_a_channel_is_an_error(data: Path, tmp_path: Path) -> None:
    path, out = find_foreign_recording(data, "trim-chunk-index-short"), tmp_path / "out.mcap"
    for read in (lambda: trim(path, out), lambda: check(path), lambda: info.run(path)):
        with pytest.raises(RecordingError, match=r"is damaged .*Try: dmrl recover"):
            read()
    assert not out.exists()
    assert recover(path, out).messages == len(walk(path).raw_messages) == 4600


@pytest.mark.parametrize("stated", [True, False])
def test_altered_chunk_index_is_an_error(stated: bool, tmp_path: Path) -> None:
    """Without checksums, the lengths of the message indexes or their records reveal it."""
    path = write_small_recording(tmp_path / "a.mcap")
    data = path.read_bytes()
    parts = [(opcode, data[start:end]) for opcode, start, end in iter_records(data)]
    places = [k for k, (opcode, _) in enumerate(parts) if opcode == Opcode.CHUNK_INDEX]
    index = next(parts[k][1] for k in places if parts[k][1][41] == 20)  # the one with two channels
    cut = index[:41] + struct.pack("<I", 10) + index[45:55] + index[65:]
    short = bytes([Opcode.CHUNK_INDEX]) + struct.pack("<Q", len(cut) - 9) + cut[9:]
    kept = [
        (opcode, short if part == index else part)
        for opcode, part in parts
        if opcode != Opcode.STATISTICS or stated
    ]
    write_records(path, kept)
    with pytest.raises(RecordingError, match=r"lacks a message index of channel \d"):
        read_summary(path)


def test_statistics_without_counts_are_counted(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = find_foreign_recording(data, "statistics-without-counts")
    assert info.run(path).to_document()["messages"] == dmrl.open(path)._summary.count == 87
    assert len(dmrl.open(path)) == 9
    assert not [f for f in check(path) if "no messages" in f.text]
    info.run(path).print()
    assert "87 messages" in capsys.readouterr().out


def test_large_foreign_file_is_not_counted_and_warns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as stream:
        sink = Writer(stream, compression=CompressionType.ZSTD)
        sink.start()
        schema = sink.register_schema("x", "protobuf", b"")
        channel = sink.register_channel("/a", "protobuf", schema)
        for k in range(50):
            sink.add_message(channel, k, b"1234", k)
        sink.finish()
    assert read_summary(path).count == 50
    assert "count" not in capsys.readouterr().err
    monkeypatch.setattr("dmrl.recording.mcap.message_count.COUNTED_BYTES", 100)
    copied = tmp_path / "large.mcap"
    copied.write_bytes(path.read_bytes())
    assert read_summary(copied).count == 50
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{copied} is large or in a bucket" in line
    assert line.endswith("dmrl check counts them all")
