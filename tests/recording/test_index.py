import os
import time
from pathlib import Path

from dmrl.messages import message
from dmrl.recording import Provenance, RecordingWriter, summary


def write(path: Path, heights: int) -> None:
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(heights):
            sink.write(k, "/cf1/height", message("Height")(height_m=k))


def settled(path: Path, second: int) -> None:
    """As if it had been written long ago, at that second."""
    os.utime(path, (second, second))


def test_a_summary_is_not_made_again_while_the_file_is_the_same(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path, 3)
    settled(path, 1_000_000_000)
    assert summary(path) is summary(path)


def test_a_file_written_anew_under_its_name_is_read_anew(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path, 3)
    settled(path, 1_000_000_000)
    assert summary(path).count == 3
    path.unlink()
    write(path, 5)
    settled(path, 1_000_000_001)
    assert summary(path).count == 5


def test_a_file_of_this_second_is_always_read_again(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path, 3)
    settled(path, int(time.time()) + 60)  # a slow machine must not let the second pass
    assert summary(path) is not summary(path)
