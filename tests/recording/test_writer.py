"""Writing recordings: order, errors, interrupted writers, and separate chunks for images."""

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import MessageIndex
from mcap.stream_reader import StreamReader

from dmrl.errors import OutputError, RecordingError
from dmrl.messages import message_class
from dmrl.recording import (
    Provenance,
    RecordingWriter,
    read,
    read_raw,
    read_summary,
    read_table,
    recover,
)
from dmrl.recording.mcap.chunks import chunk_reader

HEIGHT = message_class("Height")


def write_heights(path: Path, times_ns: list[int]) -> Path:
    """Write heights in metres equal to their times in seconds."""
    with RecordingWriter(path, Provenance("test")) as sink:
        for time_ns in times_ns:
            sink.write(time_ns, "/cf1/height", HEIGHT(height_m=time_ns / 1e9))
    return path


def test_written_messages_are_read_back(tmp_path: Path) -> None:
    path = write_heights(tmp_path / "a.mcap", [0, 5, 10])
    got = [(s.time_ns, s.topic, s.message.height_m) for s in read(path)]
    assert got == [(0, "/cf1/height", 0.0), (5, "/cf1/height", 5e-9), (10, "/cf1/height", 1e-8)]


def test_same_messages_give_the_same_bytes(tmp_path: Path) -> None:
    a = write_heights(tmp_path / "a.mcap", list(range(1000)))
    b = write_heights(tmp_path / "b.mcap", list(range(1000)))
    assert a.read_bytes() == b.read_bytes()


def test_recordings_are_never_overwritten(tmp_path: Path) -> None:
    path = write_heights(tmp_path / "a.mcap", [0])
    before = path.read_bytes()
    with pytest.raises(OutputError, match="never overwritten"):
        write_heights(path, [1])
    assert path.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap"]


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="mkdir -p"):
        write_heights(tmp_path / "nowhere" / "a.mcap", [0])


def test_an_error_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), RecordingWriter(tmp_path / "a.mcap", Provenance("t")):
        _ = 1 / 0
    assert list(tmp_path.iterdir()) == []


def test_known_topic_accepts_only_its_own_message_type(tmp_path: Path) -> None:
    with (
        pytest.raises(RecordingError, match=r"/cf1/labels carries dmrl.v1.PeerLabels"),
        RecordingWriter(tmp_path / "a.mcap", Provenance("test")) as sink,
    ):
        sink.write(0, "/cf1/labels", HEIGHT())


def test_a_negative_time_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="negative"):
        write_heights(tmp_path / "a.mcap", [-1])


def test_provenance_and_recipe_precede_the_first_message(flight: Path) -> None:
    found = read_summary(flight)
    assert found.provenance == Provenance("test", {"level": 1}, seed=3)
    assert found.attachments[0].data == b'kind = "test"\nlevel = 1\n'
    data = flight.read_bytes()
    assert data.index(b"dmrl.provenance") < 64


def test_publish_time_is_stored_separately_from_log_time(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.write(5, "/cf1/height", HEIGHT(), publish_ns=9)
        sink.write(6, "/cf1/height", HEIGHT(), publish_ns=0)
        sink.write(7, "/cf1/height", HEIGHT())
    times = [(raw.time_ns, raw.publish_ns) for raw in read_raw(path)]
    assert times == [(5, 9), (6, 0), (7, 7)]


WRITE_FOREVER = """
import sys
from dataclasses import replace
from pathlib import Path
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter
with RecordingWriter(Path(sys.argv[1]), Provenance("test")) as sink:
    k = 0
    while True:
        sink.write(k, "/cf1/height", message_class("Height")(height_m=k * 0.1))
        k += 1
        if k % 1000 == 0:
            print(k, len(sink.chunk_writer._numbers.data), flush=True)
"""


@pytest.mark.heavy
def test_kill_9_leaves_everything_before_the_open_chunk(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    child = subprocess.Popen(
        [sys.executable, "-c", WRITE_FOREVER, str(path)], stdout=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    lines = [child.stdout.readline() for _ in range(60)]
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    lines += child.stdout.readlines()
    child.stdout.close()
    written, in_open_chunk = map(int, lines[-1].split())
    assert not path.exists()
    result = recover(tmp_path / "a.mcap.partial", tmp_path / "b.mcap")
    # A message takes at least 31 bytes, which limits the number in the open chunk.
    assert result.messages >= written - in_open_chunk // 31 > 1000
    got = [s.message.height_m for s in read(tmp_path / "b.mcap")]
    assert got == [k * 0.1 for k in range(result.messages)]


def test_flush_closes_the_open_chunk(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.write(7, "/cf1/height", HEIGHT(height_m=1.0))
        sink.flush()
        result = recover(tmp_path / "a.mcap.partial", tmp_path / "b.mcap")
    assert result.messages == 1


@pytest.mark.parametrize(("time_ns", "publish_ns"), [(-1, 0), (0, -1)])
def test_neither_time_may_be_negative(tmp_path: Path, time_ns: int, publish_ns: int) -> None:
    with (
        pytest.raises(RecordingError, match=f"time {time_ns} ns on /cf1/height is negative"),
        RecordingWriter(tmp_path / "a.mcap", Provenance("test")) as sink,
    ):
        sink.write(time_ns, "/cf1/height", HEIGHT(), publish_ns=publish_ns)
    assert list(tmp_path.iterdir()) == []


def write_flight_with_images(path: Path, moments: int = 400) -> Path:
    """Write an attitude each ns, and every 5 ns an incompressible 8 kB image and a grid map."""
    rng = np.random.default_rng(0)
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(moments):
            if k % 5 == 0:
                picture = message_class("CompressedImage")(data=rng.bytes(8000), format="jpeg")
                sink.write(k, "/cf1/camera/image", picture)
                sink.write(k, "/cf1/detections/grid", message_class("GridMap")(rows=k))
            sink.write(k, "/cf1/attitude", message_class("Attitude")(roll_rad=k))
    return path


def test_images_have_separate_chunks_from_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_flight_with_images(tmp_path / "a.mcap")
    read_bytes: list[int] = []
    unpacked = chunk_reader.decompress
    monkeypatch.setattr(
        chunk_reader,
        "decompress",
        lambda *a: read_bytes.append(len(found := unpacked(*a))) or found,
    )
    assert len(read_table(path, "/cf1/attitude")) == 400
    assert sum(read_bytes) < 400 * 60
    read_bytes.clear()
    assert len(read_table(path, "/cf1/camera/image")) == 80
    assert 80 * 8000 < sum(read_bytes) < 80 * 8200


def test_mcap_library_reads_the_same_messages(tmp_path: Path) -> None:
    path = write_flight_with_images(tmp_path / "a.mcap")
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        theirs = [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages()]
        found = reader.get_summary()
    assert [t for _, t, _ in theirs] == sorted(t for _, t, _ in theirs)
    ours = [(raw.topic, raw.time_ns, raw.data) for raw in read_raw(path)]
    for topic in read_summary(path).topics:
        assert [m for m in ours if m[0] == topic] == [m for m in theirs if m[0] == topic]
    assert found is not None
    assert found.statistics is not None
    assert found.statistics.message_count == len(ours) == 560
    with path.open("rb") as stream:  # front to back, as `mcap doctor` does, with every CRC
        records = list(StreamReader(stream, validate_crcs=True).records)
    assert sum(isinstance(record, MessageIndex) for record in records) > 3


@pytest.mark.parametrize(("keep", "chunks"), [(False, 16), (True, 1)])
def test_rare_messages_are_flushed_beside_frequent_images(
    tmp_path: Path, keep: bool, chunks: int
) -> None:
    path, mended = tmp_path / "a.mcap", tmp_path / "b.mcap"
    rng = np.random.default_rng(0)
    with RecordingWriter(path, Provenance("test"), keep_on_error=keep) as sink:
        for k in range(60):
            sink.write(k, "/cf1/labels", message_class("PeerLabels")())
            picture = message_class("CompressedImage")(data=rng.bytes(130_000))
            sink.write(k, "/cf1/camera/image", picture)
        recover(tmp_path / "a.mcap.partial", mended)
    kept = read_summary(mended).topics
    # A chunk holds three images at most; labels are flushed after this many image chunks.
    assert kept["/cf1/camera/image"].count >= 57
    assert kept["/cf1/labels"].count >= 60 - 3 - chunks * 3


@pytest.mark.parametrize(("time_ns", "publish_ns"), [(-1, 0), (0, -1)])
def test_neither_time_of_a_copied_message_may_be_negative(
    tmp_path: Path, flight: Path, time_ns: int, publish_ns: int
) -> None:
    raw = replace(next(read_raw(flight)), time_ns=time_ns, publish_ns=publish_ns)
    with (
        pytest.raises(RecordingError, match=f"time {time_ns} ns on .* is negative"),
        RecordingWriter(tmp_path / "a.mcap", Provenance("test")) as sink,
    ):
        sink.write_raw(raw)
