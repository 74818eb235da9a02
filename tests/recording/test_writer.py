import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from dmrl.errors import OutputError, RecordingError
from dmrl.messages import message
from dmrl.recording import Provenance, RecordingWriter, read, read_raw, recover, summary

HEIGHT = message("Height")


def write_heights(path: Path, times_ns: list[int]) -> Path:
    with RecordingWriter(path, Provenance("test")) as sink:
        for time_ns in times_ns:
            sink.write(time_ns, "/cf1/height", HEIGHT(height_m=time_ns / 1e9))
    return path


def test_what_was_written_is_read(tmp_path: Path) -> None:
    path = write_heights(tmp_path / "a.mcap", [0, 5, 10])
    got = [(s.time_ns, s.topic, s.message.height_m) for s in read(path)]
    assert got == [(0, "/cf1/height", 0.0), (5, "/cf1/height", 5e-9), (10, "/cf1/height", 1e-8)]


def test_same_messages_same_bytes(tmp_path: Path) -> None:
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


def test_a_topic_of_dmrl_takes_only_its_own_message(tmp_path: Path) -> None:
    with (
        pytest.raises(RecordingError, match=r"/cf1/labels carries dmrl.v1.PeerLabels"),
        RecordingWriter(tmp_path / "a.mcap", Provenance("test")) as sink,
    ):
        sink.write(0, "/cf1/labels", HEIGHT())


def test_a_negative_time_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="negative"):
        write_heights(tmp_path / "a.mcap", [-1])


def test_provenance_and_recipe_stand_before_the_first_message(flight: Path) -> None:
    found = summary(flight)
    assert found.provenance == Provenance("test", {"level": 1}, seed=3)
    assert found.attachments["recipe.toml"] == b'kind = "test"\nlevel = 1\n'
    data = flight.read_bytes()
    assert data.index(b"dmrl.provenance") < 64


def test_publish_time_is_kept_apart_from_log_time(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.write(5, "/cf1/height", HEIGHT(), publish_ns=9)
    (raw,) = read_raw(path)
    assert (raw.time_ns, raw.publish_ns) == (5, 9)


KILLED = """
import sys
from pathlib import Path
from dmrl.messages import message
from dmrl.recording import Provenance, RecordingWriter
with RecordingWriter(Path(sys.argv[1]), Provenance("test")) as sink:
    k = 0
    while True:
        sink.write(k, "/cf1/height", message("Height")(height_m=k * 0.1))
        k += 1
        if k % 1000 == 0:
            print(k, sink._writer._Writer__chunk_builder.count, flush=True)
"""


def test_kill_9_leaves_everything_before_the_open_chunk(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    child = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE, text=True
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
    # A message takes at least 31 bytes in a chunk, so this many may be in the open one.
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
