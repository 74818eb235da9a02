"""Mutated recordings: read as something, or refused in one line; quickly and in little memory."""

import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType, Writer

import dmrl.recording
from dmrl.errors import DmrlError
from dmrl.messages import message, schema_bytes
from dmrl.recording import (
    Provenance,
    RecordingWriter,
    check,
    glance,
    log_times,
    read,
    recover,
    stretches,
    summary,
)

from .conftest import Count, cases_of
from .mutate import mutated, mutated_within

HANG_S = 20
MEMORY_BYTES = 500_000_000
TOPICS = ("/cf1/height", "/cf1/labels")
Result = TypeVar("Result")
ROOM = str(Path(dmrl.recording.__file__).parent)
FOREIGN: tuple[dict[str, Any], ...] = (
    {"compression": CompressionType.NONE, "enable_crcs": False},
    {"compression": CompressionType.NONE, "enable_crcs": False, "use_statistics": False},
    {"compression": CompressionType.NONE, "enable_crcs": False, "index_types": IndexType.CHUNK},
    {"compression": CompressionType.NONE, "enable_crcs": False, "index_types": IndexType.NONE},
    {"use_chunking": False},
    {"compression": CompressionType.LZ4, "enable_crcs": False},
)


def fill(write: Callable[[int, str, Any], None]) -> None:
    for k in range(6):
        write(10 * k, TOPICS[0], message("Height")(height_m=k))
        peer = {"peer": "cf2", "u_px": 5.0 * k, "v_px": 7.0, "depth_m": 1.0, "source": "truth"}
        write(10 * k, TOPICS[1], message("PeerLabels")(peers=[peer] * (k % 3), sources=["truth"]))


def ours(path: Path) -> bytes:
    with RecordingWriter(path, Provenance("test")) as sink:
        fill(sink.write)
    return path.read_bytes()


def foreign(path: Path, options: dict[str, Any]) -> bytes:
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=200, **options)
        writer.start()
        numbers = {}
        for topic, kind in zip(TOPICS, ("Height", "PeerLabels"), strict=True):
            schema = writer.register_schema(f"dmrl.v1.{kind}", "protobuf", schema_bytes(kind))
            numbers[topic] = writer.register_channel(topic, "protobuf", schema)
        fill(lambda t, topic, m: writer.add_message(numbers[topic], t, m.SerializeToString(), t))
        writer.add_metadata("dmrl.split", {"train": "[[0, 10]]"})
        writer.finish()
    return path.read_bytes()


def read_all(path: Path) -> None:
    """Every way to read."""
    summary(path)
    for _ in read(path):
        pass
    wanted = dict.fromkeys(TOPICS)
    for _ in stretches(path, wanted):
        pass
    glance(path, wanted, start_ns=0, end_ns=100)
    log_times(path, TOPICS)
    check(path)


class Reach:
    """Lines of the recording room that a reading came by."""

    def __init__(self) -> None:
        self.lines: set[tuple[str, int]] = set()

    def _line(self, frame: FrameType, event: str, _: object) -> Any:
        if event == "line":
            self.lines.add((frame.f_code.co_filename, frame.f_lineno))
        return self._line

    def _call(self, frame: FrameType, _event: str, _: object) -> Any:
        return self._line if frame.f_code.co_filename.startswith(ROOM) else None

    def of(self, work: Callable[[], Result]) -> Result:
        """What the work gives."""
        before = sys.gettrace()
        sys.settrace(self._call)
        try:
            return work()
        finally:
            sys.settrace(before)


def survived(path: Path) -> bool:
    """Whether it is read. Else it is refused, in one line; `recover` always ends as well."""
    out = path.with_name("mended.mcap")
    signal.alarm(HANG_S)  # ends this process
    try:
        read_all(path)
        good = True
    except DmrlError as e:
        assert "\n" not in str(e)
        good = False
    try:
        recover(path, out)
        read_all(out)
    except DmrlError as e:
        assert "\n" not in str(e)
    finally:
        out.unlink(missing_ok=True)
        signal.alarm(0)
    return good


def hunt(folder: Path, cases: int, seed: int, count: Count) -> None:
    """Mutate, and mutate again what reached new lines of code."""
    path = folder / "a.mcap"
    corpus = [ours(path), *(foreign(path, options) for options in FOREIGN)]
    path.unlink()
    rng, reach = np.random.default_rng(seed), Reach()
    for data in corpus:
        path.write_bytes(data)
        reach.of(lambda: read_all(path))
    first, begun = len(reach.lines), len(corpus)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused = 0
    for k in range(cases):
        data = corpus[int(rng.integers(len(corpus)))]
        for _ in range(int(rng.integers(1, 4))):
            data = (mutated if rng.random() < 0.4 else mutated_within)(data, rng)
        path.write_bytes(data)
        known = len(reach.lines)
        try:
            good = reach.of(lambda: survived(path))
        except BaseException as e:
            kept = folder / "found.mcap"
            kept.write_bytes(data)
            raise AssertionError(f"case {k}, {kept}: {type(e).__name__}: {e}") from e
        refused += not good
        if len(reach.lines) > known and len(data) < 20_000:
            corpus.append(data)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    assert grown < MEMORY_BYTES, f"{grown / 1e6:.0f} MB"
    assert len(reach.lines) > first
    assert len(corpus) > begun
    count("mutated recordings", cases=cases, refused=refused, right=cases - refused)


def test_mutated_recordings_are_read_or_refused(tmp_path: Path, count: Count) -> None:
    hunt(tmp_path, 200, 1, count)


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_ten_thousand_mutated_recordings_are_read_or_refused(tmp_path: Path, count: Count) -> None:
    hunt(tmp_path, cases_of(9_800), 2, count)
