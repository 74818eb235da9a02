"""The cache of summaries: when it is used, and when a file is read again."""

import os
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, read_summary
from dmrl.recording.mcap import file_cache


def write_heights(path: Path, heights: int) -> None:
    """Write this many heights."""
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(heights):
            sink.write(k, "/cf1/height", message_class("Height")(height_m=k))


def set_modification_time(path: Path, second: int) -> None:
    """Set the modification time, Unix seconds. Only files older than a second are cached."""
    os.utime(path, (second, second))


def test_summary_is_cached_while_the_file_is_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_heights(path, 3)
    set_modification_time(path, 1_000_000_000)
    assert read_summary(path) is read_summary(path)


def test_rewritten_file_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_heights(path, 3)
    set_modification_time(path, 1_000_000_000)
    assert read_summary(path).count == 3
    path.unlink()
    write_heights(path, 5)
    set_modification_time(path, 1_000_000_001)
    assert read_summary(path).count == 5


def test_recent_file_is_not_cached(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_heights(path, 3)
    # A time in the future keeps the file recent on a slow machine too.
    set_modification_time(path, int(time.time()) + 60)
    assert read_summary(path) is not read_summary(path)


def test_cache_is_keyed_by_file_identity_and_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(file_cache, "_CACHE", {})
    monkeypatch.setattr(file_cache, "CACHE_ENTRIES_MAX", 2)
    now, made = time.time_ns(), list[str]()

    def get_cached_name(
        name: str, age_s: float = 60.0, ranged: object = None, size: int = 7
    ) -> str:
        status = SimpleNamespace(st_ino=1, st_size=size, st_mtime_ns=now - round(age_s * 1e9))
        stream: Any = SimpleNamespace(path=Path(name), status=status, remote_stream=ranged)
        found = file_cache.get_cached("x", stream, lambda: made.append(name) or name)
        return str(found)

    for name in ("a", "a", "b", "a"):
        assert get_cached_name(name) == name
    assert made == ["a", "b"]
    get_cached_name("c")  # evicts the oldest entry, a
    get_cached_name("b")
    get_cached_name("a")
    assert made == ["a", "b", "c", "a"]
    get_cached_name("a", size=8)
    get_cached_name("a", age_s=61.0)
    assert made[4:] == ["a", "a"]
    made.clear()
    for age_s, ranged, times in ((0.0, None, 2), (0.0, "bucket", 1), (30.0, None, 1)):
        for _ in range(2):
            get_cached_name(f"new {age_s} {ranged}", age_s, ranged)
        assert made.count(f"new {age_s} {ranged}") == times
