"""Mutated recordings: read, or refused in one line, quickly and in little memory."""

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

from .conftest import SEED, Count, cases_of
from .mutate import mutated, mutated_within

HANG_S = 20
MEMORY_BYTES = 500_000_000
TRACED = 3
"""Every so many cases are watched: it takes three times as long."""
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
        write(10 * k, TOPICS[0], message_class("Height")(height_m=k))
        peer = {"peer": "cf2", "u_px": 5.0 * k, "v_px": 7.0, "depth_m": 1.0, "source": "truth"}
        write(
            10 * k,
            TOPICS[1],
            message_class("PeerLabels")(peers=[peer] * (k % 3), sources=["truth"]),
        )


def ours(path: Path) -> bytes:
    with RecordingWriter(path, Provenance("test")) as sink:
        fill(sink.write)
        sink.flush()
        sink.write(70, TOPICS[0], message_class("Height")(height_m=7))
        sink.add_metadata("dmrl.split", {"train": "[[0, 10]]"})
        sink.add_attachment("note.txt", "text/plain", b"seven")
    return path.read_bytes()


def foreign(path: Path, options: dict[str, Any]) -> bytes:
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=200, **options)
        writer.start()
        numbers = {}
        for topic, kind in zip(TOPICS, ("Height", "PeerLabels"), strict=True):
            schema = writer.register_schema(f"dmrl.v1.{kind}", "protobuf", serialize_schema(kind))
            numbers[topic] = writer.register_channel(topic, "protobuf", schema)
        fill(lambda t, topic, m: writer.add_message(numbers[topic], t, m.SerializeToString(), t))
        writer.add_metadata("dmrl.split", {"train": "[[0, 10]]"})
        writer.finish()
    return path.read_bytes()


def read_all(path: Path) -> None:
    """Every way to read."""
    read_summary(path)
    for _ in read(path):
        pass
    wanted = dict.fromkeys(TOPICS)
    for _ in iter_topic_batches(path, wanted):
        pass
    sample_topics(path, wanted, start_ns=0, end_ns=100)
    read_log_times(path, TOPICS)
    check(path)


class Reach:
    """Steps from line to line of the recording room that readings came by."""

    def __init__(self) -> None:
        self.steps: set[tuple[CodeType, int, int]] = set()

    def _call(self, frame: FrameType, _event: str, _: object) -> Any:
        code, steps, before = frame.f_code, self.steps, 0
        if not _is_ours(code):
            return None

        def line(frame: FrameType, event: str, _: object) -> Any:
            nonlocal before
            if event == "line":
                steps.add((code, before, frame.f_lineno))
                before = frame.f_lineno
            return line

        return line

    def of(self, work: Callable[[], Result]) -> Result:
        """What the work gives."""
        before = sys.gettrace()
        sys.settrace(self._call)
        try:
            return work()
        finally:
            sys.settrace(before)


@cache
def _is_ours(code: CodeType) -> bool:
    return code.co_filename.startswith(ROOM)


Held = Counter[tuple[str, int, int, bytes]]


def held(path: Path) -> Held:
    """Its messages, as dmrl reads them."""
    return Counter((m.topic, m.time_ns, m.publish_ns, m.data) for m in read_raw(path))


def held_by_mcap(data: bytes) -> Held | None:
    """The same as mcap's own reader reads them; None, where it does not."""
    try:
        return Counter(
            (channel.topic, message.log_time, message.publish_time, message.data)
            for _, channel, message in NonSeekingReader(io.BytesIO(data)).iter_messages()
        )
    except Exception:  # it leaks many kinds
        return None


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
    """Mutate, and mutate again what came by new steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)  # nobody pulls the plug here
        _hunt(folder, cases, seed, count)


def _hunt(folder: Path, cases: int, seed: int, count: Count) -> None:
    path = folder / "a.mcap"
    corpus = [ours(path), *(foreign(path, options) for options in FOREIGN)]
    path.write_bytes(corpus[0])
    sound = held(path)
    rng, reach = np.random.default_rng(seed), Reach()
    for data in corpus:
        path.write_bytes(data)
        reach.of(lambda: read_all(path))
    first, begun = len(reach.steps), len(corpus)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused = compared = 0
    wrong: list[str] = []
    for k in range(cases):
        chosen = int(rng.integers(len(corpus)))
        within = rng.random(1 + int(rng.geometric(0.7)) // 2) < 0.8
        data = corpus[chosen]
        for one in within:
            data = (mutated_within if one else mutated)(data, rng)
        path.write_bytes(data)
        known = len(reach.steps)
        try:
            good = survived(path) if k % TRACED else reach.of(lambda: survived(path))
            compared += good and nothing_is_lost(path, sound if not chosen + within.any() else None)
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


def nothing_is_lost(path: Path, sound: Held | None) -> bool:
    """Whether there was another reader to compare with: it found no message that we did not.

    Parameters
    ----------
    path
        A recording that was read without an error.
    sound
        What it held before it was damaged, where every byte of that has a checksum.
    """
    found, theirs = held(path), held_by_mcap(path.read_bytes())
    if sound is not None:
        assert found == sound, "damage that every sum should show"
    if theirs is not None:
        assert not theirs - found, f"lost without a word: {list(theirs - found)[:3]}"
    return theirs is not None


@pytest.mark.heavy
def test_mutated_recordings_are_read_or_refused(tmp_path: Path, count: Count) -> None:
    hunt(tmp_path, 60, 1, count)


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_ten_thousand_mutated_recordings_are_read_or_refused(tmp_path: Path, count: Count) -> None:
    hunt(tmp_path, cases_of(10_000), SEED, count)
