"""Resuming an interrupted recording."""

import random
from pathlib import Path

import pytest

from dmrl.errors import OutputError, RecordingError
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, recover_interrupted

MADE = Provenance("test", settings={"range_m": (1.0, 2.0)})
MOMENTS = 3000
# Enough that chunks of the file fill.
PADDING = "x" * 300


def write(sink: RecordingWriter, first: int, last: int) -> None:
    """Two messages at every moment."""
    for k in range(first, last):
        for topic in ("/a", "/b"):
            text = message_class("Log")(message=f"{k * 7919}{topic}{PADDING[k % 300 :]}")
            sink.write(k, topic, text)


@pytest.fixture
def whole(tmp_path: Path) -> Path:
    """What an uninterrupted run writes."""
    path = tmp_path / "whole.mcap"
    with RecordingWriter(path, MADE) as sink:
        write(sink, 0, MOMENTS)
    return path


@pytest.fixture
def stopped(tmp_path: Path) -> Path:
    """Where a run was stopped by an error after most of it."""
    path = tmp_path / "out.mcap"
    with pytest.raises(KeyboardInterrupt), RecordingWriter(path, MADE, keep_on_error=True) as sink:
        write(sink, 0, MOMENTS - 50)
        raise KeyboardInterrupt
    return path


@pytest.mark.heavy
def test_a_stopped_recording_goes_on_to_the_same_bytes(whole: Path, stopped: Path) -> None:
    before = recover_interrupted(stopped, resume=True)
    before.check_provenance(MADE)
    with RecordingWriter(stopped, MADE, keep_on_error=True) as sink:
        done = before.copy_into(sink)
        assert 0 < done < MOMENTS - 50
        write(sink, done, MOMENTS)
    before.delete_file()
    assert stopped.read_bytes() == whole.read_bytes()
    assert sorted(p.name for p in stopped.parent.iterdir()) == ["out.mcap", "whole.mcap"]


@pytest.mark.heavy
def test_stopped_twice_it_keeps_the_longer_part(stopped: Path) -> None:
    kept = recover_interrupted(stopped, resume=True)
    count = sum(1 for _ in kept.iter_moments())
    with (
        pytest.raises(KeyboardInterrupt),
        RecordingWriter(stopped, MADE, keep_on_error=True) as sink,
    ):
        write(sink, 0, 10)
        raise KeyboardInterrupt
    assert sum(1 for _ in recover_interrupted(stopped, resume=True).iter_moments()) == count


def test_other_settings_are_refused(stopped: Path) -> None:
    before = recover_interrupted(stopped, resume=True)
    with pytest.raises(RecordingError, match="other settings"):
        before.check_provenance(Provenance("test", settings={"range_m": (1.0, 3.0)}))


def test_partial_recording_is_not_overwritten(stopped: Path) -> None:
    with pytest.raises(OutputError, match=r"Go on with --resume, or remove it"):
        recover_interrupted(stopped, resume=False)


def test_missing_partial_recording_is_reported(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"to resume\. Run without --resume"):
        recover_interrupted(tmp_path / "none.mcap", resume=True)


def write_pictures(sink: RecordingWriter, first: int, last: int) -> None:
    """At every moment what tells of a picture, then the picture, which does not compress."""
    for k in range(first, last):
        sink.write(k, "/cf1/labels", message_class("PeerLabels")(sources=["truth"]))
        picture = message_class("CompressedImage")(data=random.Random(k).randbytes(20_000))
        sink.write(k, "/cf1/camera/image", picture)


@pytest.mark.heavy
def test_resume_drops_images_without_their_labels(tmp_path: Path) -> None:
    whole, out = tmp_path / "whole.mcap", tmp_path / "out.mcap"
    with RecordingWriter(whole, MADE) as sink:
        write_pictures(sink, 0, 600)
    for stop, least, most in ((8, 0, 0), (50, 25, 49), (550, 520, 549)):
        with (
            pytest.raises(KeyboardInterrupt),
            RecordingWriter(out, MADE, keep_on_error=True) as sink,
        ):
            write_pictures(sink, 0, stop)
            raise KeyboardInterrupt
        before = recover_interrupted(out, resume=True)
        with RecordingWriter(tmp_path / f"{stop}.mcap", MADE) as sink:
            done = before.copy_into(sink)
            assert least <= done <= most
            write_pictures(sink, done, 600)
        assert (tmp_path / f"{stop}.mcap").read_bytes() == whole.read_bytes()


def test_numbers_whose_pictures_were_lost_are_not_whole(tmp_path: Path) -> None:
    """The chunk with the pictures could not be written any more."""
    out = tmp_path / "out.mcap"
    with pytest.raises(KeyboardInterrupt), RecordingWriter(out, MADE, keep_on_error=True) as sink:
        write(sink, 0, MOMENTS)
        raise KeyboardInterrupt
    assert sum(1 for _ in recover_interrupted(out, resume=True).iter_moments()) > 0
    assert list(recover_interrupted(out, resume=True, has_images=True).iter_moments()) == []
