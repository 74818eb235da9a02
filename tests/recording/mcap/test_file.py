"""Recording files: magic bytes, reads beyond the end, and changes after hashing."""

import os
from pathlib import Path

import pytest

from dmrl.errors import RecordingError
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, read_summary
from dmrl.recording.mcap.file import MAGIC, expect_unchanged, open_mcap


def write_height(path: Path, height_m: float) -> Path:
    """Write one height; replace the file if it exists."""
    path.unlink(missing_ok=True)
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.write(0, "/cf1/height", message_class("Height")(height_m=height_m))
    return path


def test_error_of_a_missing_recording_suggests_a_similar_name(tmp_path: Path) -> None:
    write_height(tmp_path / "flight_tracks.mcap", 1.0)
    with pytest.raises(RecordingError, match=r"Did you mean flight_tracks\.mcap\?"):
        read_summary(tmp_path / "flight_track.mcap")
    with pytest.raises(RecordingError, match=r"no recording .*zzz\. Check the name"):
        read_summary(tmp_path / "zzz")


def test_error_of_a_folder_lists_the_recordings_in_it(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"not a recording\. Name a \.mcap file$"):
        read_summary(tmp_path)
    for name in "abcd":
        write_height(tmp_path / f"{name}.mcap", 1.0)
    with pytest.raises(RecordingError, match=r"Name one in it: .*a\.mcap, .*c\.mcap, \.\.\.$"):
        read_summary(tmp_path)


def test_hashed_input_must_stay_unchanged_until_an_output_is_done(tmp_path: Path) -> None:
    path = write_height(tmp_path / "a.mcap", 1.0)
    expect_unchanged(path)
    assert read_summary(path).count == 1
    os.utime(path, (5, 5))
    with pytest.raises(RecordingError, match=r"a\.mcap was changed while it was read"):
        read_summary(path)
    write_height(tmp_path / "b.mcap", 2.0)  # completes an output, so inputs may change again
    assert read_summary(path).count == 1
    expect_unchanged(path)
    other = path.with_name("c.mcap")
    other.write_bytes(path.read_bytes())
    os.utime(other, (5, 5))
    other.replace(path)  # another file of equal size and modification time
    with pytest.raises(RecordingError, match="was changed"):
        read_summary(path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (MAGIC[:5], r"is not an MCAP file: it begins with b'\\x89MCAP'"),
        (b"\x89PNG\r\n\x1a\n" * 4, r"is not an MCAP file.* rename it, such as \.csv; then"),
        (MAGIC, "is cut short"),
        (MAGIC[:8] + MAGIC[1:], "is cut short"),
        (MAGIC + b"much more" + MAGIC[:-1], "is cut short"),
    ],
)
def test_file_without_both_magic_numbers_is_refused(
    tmp_path: Path, content: bytes, words: str
) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(RecordingError, match=words), open_mcap(tmp_path / "a.mcap"):
        pass


def test_reading_beyond_the_end_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(MAGIC + b"12" + MAGIC)
    with open_mcap(tmp_path / "a.mcap") as stream:
        assert (stream.tell(), stream.size) == (0, 18)
        assert stream.read(18) == MAGIC + b"12" + MAGIC
        stream.seek(8)
        assert stream.read(None) == b"12" + MAGIC  # None reads to the end, as in any file
    beyond = pytest.raises(RecordingError, match="a record at byte 1 runs beyond the end")
    with beyond, open_mcap(tmp_path / "a.mcap") as stream:
        stream.seek(1)
        stream.read(18)
    for wrong, words in ((tmp_path, "is a folder"), (tmp_path / "none", "no recording")):
        with pytest.raises(RecordingError, match=words), open_mcap(wrong):
            pass
