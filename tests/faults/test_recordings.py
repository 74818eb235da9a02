"""Mutated recordings are read, or refused in one line, quickly and in little memory."""

import io
import os
import resource
import signal
import sys
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, TypeVar

import numpy as np
import pytest
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer

import dmrl.recording
from dmrl.errors import DmrlError
from dmrl.messages import message_class, serialize_schema
from dmrl.recording import (
    Provenance,
    RecordingWriter,
    check,
    iter_topic_batches,
    read,
    read_log_times,
    read_raw,
    read_summary,
    recover,
    sample_topics,
)

from .conftest import SEED, Count, scale_cases
from .mutate import mutate, mutate_record

HANG_S = 20
MEMORY_BYTES = 500_000_000
TRACED_EVERY = 3
"""Line coverage is traced in every third case only, as it takes three times as long."""
TOPICS = ("/cf1/height", "/cf1/labels")
Result = TypeVar("Result")
RECORDING_FOLDER = str(Path(dmrl.recording.__file__).parent)
FOREIGN: tuple[dict[str, Any], ...] = (
    {"compression": CompressionType.NONE, "enable_crcs": False},
    {"compression": CompressionType.NONE, "enable_crcs": False, "use_statistics": False},
    {"compression": CompressionType.NONE, "enable_crcs": False, "index_types": IndexType.CHUNK},
    {"compression": CompressionType.NONE, "enable_crcs": False, "index_types": IndexType.NONE},
    {"use_chunking": False},
    {"compression": CompressionType.LZ4, "enable_crcs": False},
)


def write_messages(write: Callable[[int, str, Any], None]) -> None:
    """Write six heights and six labels."""
    for k in range(6):
        write(10 * k, TOPICS[0], message_class("Height")(height_m=k))
        peer = {"peer": "cf2", "u_px": 5.0 * k, "v_px": 7.0, "depth_m": 1.0, "source": "truth"}
        write(
            10 * k,
            TOPICS[1],
            message_class("PeerLabels")(peers=[peer] * (k % 3), sources=["truth"]),
        )


def write_own_recording(path: Path) -> bytes:
    """Write a recording with dmrl and return its bytes."""
    with RecordingWriter(path, Provenance("test")) as sink:
        write_messages(sink.write)
        sink.flush()
        sink.write(70, TOPICS[0], message_class("Height")(height_m=7))
        sink.add_metadata("dmrl.split", {"train": "[[0, 10]]"})
        sink.add_attachment("note.txt", "text/plain", b"seven")
    return path.read_bytes()


def write_foreign_recording(path: Path, options: dict[str, Any]) -> bytes:
    """Write a recording with the mcap package and return its bytes."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=200, **options)
        writer.start()
        numbers = {}
        for topic, kind in zip(TOPICS, ("Height", "PeerLabels"), strict=True):
            schema = writer.register_schema(f"dmrl.v1.{kind}", "protobuf", serialize_schema(kind))
            numbers[topic] = writer.register_channel(topic, "protobuf", schema)
        write_messages(
            lambda t, topic, m: writer.add_message(numbers[topic], t, m.SerializeToString(), t)
        )
        writer.add_metadata("dmrl.split", {"train": "[[0, 10]]"})
        writer.finish()
    return path.read_bytes()


def read_all(path: Path) -> None:
    """Read a recording with every function that reads one."""
    read_summary(path)
    for _ in read(path):
        pass
    wanted = dict.fromkeys(TOPICS)
    for _ in iter_topic_batches(path, wanted):
        pass
    sample_topics(path, wanted, start_ns=0, end_ns=100)
    read_log_times(path, TOPICS)
    check(path)


class LineCoverage:
    """Records which steps from line to line within dmrl.recording the readers have taken."""

    def __init__(self) -> None:
        self.steps: set[tuple[CodeType, int, int]] = set()

    def _call(self, frame: FrameType, _event: str, _: object) -> Any:
        code, steps, before = frame.f_code, self.steps, 0
        if not _is_in_recording(code):
            return None

        def line(frame: FrameType, event: str, _: object) -> Any:
            nonlocal before
            if event == "line":
                steps.add((code, before, frame.f_lineno))
                before = frame.f_lineno
            return line

        return line

    def trace(self, work: Callable[[], Result]) -> Result:
        """Run the work with tracing and return its result."""
        before = sys.gettrace()
        sys.settrace(self._call)
        try:
            return work()
        finally:
            sys.settrace(before)


@cache
def _is_in_recording(code: CodeType) -> bool:
    return code.co_filename.startswith(RECORDING_FOLDER)


Messages = Counter[tuple[str, int, int, bytes]]


def read_messages_by_dmrl(path: Path) -> Messages:
    """Return the messages of a recording, as dmrl reads them."""
    return Counter((m.topic, m.time_ns, m.publish_ns, m.data) for m in read_raw(path))


def read_messages_by_mcap(data: bytes) -> Messages | None:
    """Return the messages as mcap's own reader reads them, or None if it fails."""
    try:
        return Counter(
            (channel.topic, message.log_time, message.publish_time, message.data)
            for _, channel, message in NonSeekingReader(io.BytesIO(data)).iter_messages()
        )
    except Exception:  # the mcap package raises many kinds on damaged files
        return None


def check_reading(path: Path) -> bool:
    """Return whether a recording can be read; assert that errors have one line.

    Recover it too, with the same requirement.
    """
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


def fuzz_readers(folder: Path, cases: int, seed: int, count: Count) -> None:
    """Read mutated recordings; mutate those again that reach new code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)  # slow, and needed only for power loss
        _fuzz_readers(folder, cases, seed, count)


def _fuzz_readers(folder: Path, cases: int, seed: int, count: Count) -> None:
    """Run `fuzz_readers`; assert that readers are also compared and new code is reached."""
    path = folder / "a.mcap"
    corpus = [
        write_own_recording(path),
        *(write_foreign_recording(path, options) for options in FOREIGN),
    ]
    path.write_bytes(corpus[0])
    sound = read_messages_by_dmrl(path)
    rng, reach = np.random.default_rng(seed), LineCoverage()
    for data in corpus:
        path.write_bytes(data)
        reach.trace(lambda: read_all(path))
    first, begun = len(reach.steps), len(corpus)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused = compared = 0
    wrong: list[str] = []
    for k in range(cases):
        chosen = int(rng.integers(len(corpus)))
        within = rng.random(1 + int(rng.geometric(0.7)) // 2) < 0.8
        data = corpus[chosen]
        for one in within:
            data = (mutate_record if one else mutate)(data, rng)
        path.write_bytes(data)
        known = len(reach.steps)
        try:
            good = (
                check_reading(path)
                if k % TRACED_EVERY
                else reach.trace(lambda: check_reading(path))
            )
            compared += good and compare_with_mcap(
                path, sound if not chosen + within.any() else None
            )
        except Exception as e:
            kept = folder / f"found-{k}.mcap"
            kept.write_bytes(data)
            wrong.append(f"case {k}, {kept}: {type(e).__name__}: {str(e)[:300]}")
            good = False
        refused += not good
        if len(reach.steps) > known and len(data) < 20_000:
            corpus.append(data)
    assert not wrong, "\n".join(wrong)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    assert grown < MEMORY_BYTES, f"{grown / 1e6:.0f} MB"
    assert len(reach.steps) > first
    assert len(corpus) > begun
    assert compared
    count("mutated recordings", cases=cases, refused=refused, right=cases - refused)


def compare_with_mcap(path: Path, sound: Messages | None) -> bool:
    """Assert that mcap's own reader finds no further message; return whether it can read the file.

    Parameters
    ----------
    path
        A recording that was read without an error.
    sound
        The messages before the damage if every byte has a checksum, else None.
    """
    found, theirs = read_messages_by_dmrl(path), read_messages_by_mcap(path.read_bytes())
    if sound is not None:
        assert found == sound, "damage passed the checksums"
    if theirs is not None:
        assert not theirs - found, f"lost without an error: {list(theirs - found)[:3]}"
    return theirs is not None


@pytest.mark.heavy
def test_mutated_recordings_are_read_or_refused(tmp_path: Path, count: Count) -> None:
    fuzz_readers(tmp_path, 60, 1, count)


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_ten_thousand_mutated_recordings_are_read_or_refused(tmp_path: Path, count: Count) -> None:
    fuzz_readers(tmp_path, scale_cases(10_000), SEED, count)
