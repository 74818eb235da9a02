"""Number of passes of each command over a recording: decompressed chunks over all chunks."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import ChunkIndex

from dmrl import topics
from dmrl.messages import message_class
from dmrl.recording import RecordingWriter, build_provenance, check, merge, read_summary, trim
from dmrl.recording.copying.chunk_copy import TopicSelection, copy_messages
from dmrl.recording.mcap.chunks import chunk_builder, chunk_reader
from dmrl.recording.mcap.file import BoundedReader
from dmrl.stages import dataset, evaluate, fly, label, track

pytestmark = pytest.mark.heavy

Passes = Callable[[Path], float]


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a flight of two robots over 30 s with images and detections of one, in many chunks."""
    folder = tmp_path_factory.mktemp("passes")
    flown, out = folder / "flown.mcap", folder / "flight.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunk_builder, "CHUNK_BYTES", 16 * 1024)  # many chunks of a short flight
        fly.run(
            flown,
            fly.Settings(2, 30.0, seed=1001, camera=True, cameras_max=1, camera_rate_hz=4.0),
        )
        with RecordingWriter(out, build_provenance("test", inputs=[flown])) as sink:
            copy_messages(flown, TopicSelection(frozenset(read_summary(flown).topics)), sink)
            rng = np.random.default_rng(0)
            for time_ns in _read_times(flown, "/cf1/camera/image"):
                found = {"u_px": rng.uniform(0, 320), "v_px": 100.0, "depth_m": 1.0}
                seen = [{**found, "confidence": 0.9}]
                made = message_class("Detections")(detections=seen, threshold=0.5)
                sink.write(time_ns, topics.DETECTIONS("cf1"), made)
    return out


def _read_times(path: Path, topic: str) -> list[int]:
    """Return the log times of a topic, nanoseconds."""
    with path.open("rb") as stream:
        return [m.log_time for _, _, m in make_reader(stream).iter_messages([topic])]


def _count_chunks(path: Path) -> int:
    """Return the number of chunks of a recording."""
    with path.open("rb") as stream:
        found = make_reader(stream).get_summary()
    assert found is not None
    return len(found.chunk_indexes)


@pytest.fixture
def passes(monkeypatch: pytest.MonkeyPatch) -> Passes:
    """Return a function that returns the passes over a recording since its last call."""
    opened: Counter[str] = Counter()
    load = chunk_reader._load_chunk

    def load_counted(stream: BoundedReader, index: ChunkIndex) -> object:
        opened[stream.path.name] += 1
        return load(stream, index)

    monkeypatch.setattr(chunk_reader, "_load_chunk", load_counted)

    def count(path: Path) -> float:
        found = opened[path.name] / _count_chunks(path)
        opened.clear()
        return found

    return count


def test_a_check_is_one_pass(flight: Path, passes: Passes) -> None:
    assert _count_chunks(flight) > 40
    check(flight)
    assert passes(flight) == 1.0


def test_a_trim_is_less_than_one_pass(flight: Path, passes: Passes, tmp_path: Path) -> None:
    trim(flight, tmp_path / "a.mcap", end_ns=read_summary(flight).start_ns + 10**10)
    assert 0.2 < passes(flight) < 0.5
    trim(flight, tmp_path / "b.mcap", topics=["/cf2/*"])
    assert passes(flight) <= 1.0


def test_a_merge_is_one_pass_over_each(flight: Path, passes: Passes, tmp_path: Path) -> None:
    parts = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    middle_ns = read_summary(flight).start_ns + 15 * 10**9
    trim(flight, parts[0], end_ns=middle_ns)
    trim(flight, parts[1], start_ns=middle_ns)
    passes(flight)
    merge(parts, tmp_path / "out.mcap")
    assert passes(parts[0]) == 1.0
    merge(parts, tmp_path / "again.mcap")
    assert passes(parts[1]) == 1.0


def test_a_dataset_is_one_pass(flight: Path, passes: Passes, tmp_path: Path) -> None:
    dataset.run([flight], tmp_path / "out", dataset.Settings())
    assert passes(flight) <= 1.0


def test_evaluating_is_one_pass(flight: Path, passes: Passes) -> None:
    evaluate.run([flight], None, evaluate.Settings(draws=2))
    assert passes(flight) <= 1.0


def test_labelling_is_two_passes_one_of_them_the_copy(
    flight: Path, passes: Passes, tmp_path: Path
) -> None:
    out = tmp_path / "out.mcap"
    label.run(flight, out, label.Settings(gate_m=0.5))
    assert passes(flight) <= 2.0
    evaluate.run([out], None, evaluate.Settings("positions"))
    assert passes(out) <= 1.0


def test_tracking_is_two_passes(flight: Path, passes: Passes, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    track.run(flight, out, track.Settings())
    assert passes(flight) <= 2.0
    evaluate.run([out], None, evaluate.Settings("tracks"))
    assert passes(out) <= 1.0
