"""Resuming an interrupted recording."""

import random
from pathlib import Path

import pytest

from dmrl.errors import OutputError, RecordingError
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, recover_interrupted

MADE = Provenance("test", settings={"range_m": (1.0, 2.0)})
MOMENTS = 3000
# Long texts, so that several chunks of the file fill.
PADDING = "x" * 300


def write_texts(sink: RecordingWriter, first: int, last: int) -> None:
    """Write two texts at every moment from ``first`` to before ``last``."""
    for k in range(first, last):
        for topic in ("/a", "/b"):
            text = message_class("Log")(message=f"{k * 7919}{topic}{PADDING[k % 300 :]}")
            sink.write(k, topic, text)


@pytest.fixture
def uninterrupted(tmp_path: Path) -> Path:
    """Return the recording of an uninterrupted run."""
    path = tmp_path / "whole.mcap"
    with RecordingWriter(path, MADE) as sink:
        write_texts(sink, 0, MOMENTS)
    return path


@pytest.fixture
def interrupted(tmp_path: Path) -> Path:
    """Return the path of a run that was interrupted 50 moments before its end."""
    path = tmp_path / "out.mcap"
    with pytest.raises(KeyboardInterrupt), RecordingWriter(path, MADE, keep_on_error=True) as sink:
        write_texts(sink, 0, MOMENTS - 50)
        raise KeyboardInterrupt
    return path


@pytest.mark.heavy
def test_resumed_recording_equals_an_uninterrupted_one(
    uninterrupted: Path, interrupted: Path
) -> None:
    before = recover_interrupted(interrupted, resume=True)
    before.check_provenance(MADE)
    with RecordingWriter(interrupted, MADE, keep_on_error=True) as sink:
        done = before.copy_into(sink)
        assert 0 < done < MOMENTS - 50
        write_texts(sink, done, MOMENTS)
    before.delete_file()
    assert interrupted.read_bytes() == uninterrupted.read_bytes()
    assert sorted(p.name for p in interrupted.parent.iterdir()) == ["out.mcap", "whole.mcap"]


@pytest.mark.heavy
def test_recording_interrupted_twice_keeps_its_longer_part(interrupted: Path) -> None:
    kept = recover_interrupted(interrupted, resume=True)
    count = sum(1 for _ in kept.iter_moments())
    with (
        pytest.raises(KeyboardInterrupt),
        RecordingWriter(interrupted, MADE, keep_on_error=True) as sink,
    ):
        write_texts(sink, 0, 10)
        raise KeyboardInterrupt
    assert sum(1 for _ in recover_interrupted(interrupted, resume=True).iter_moments()) == count


def test_other_settings_are_refused(interrupted: Path) -> None:
    before = recover_interrupted(interrupted, resume=True)
    with pytest.raises(RecordingError, match="other settings"):
        before.check_provenance(Provenance("test", settings={"range_m": (1.0, 3.0)}))


def test_partial_recording_is_not_overwritten(interrupted: Path) -> None:
    with pytest.raises(OutputError, match=r"Go on with --resume, or remove it"):
        recover_interrupted(interrupted, resume=False)


def test_missing_partial_recording_is_reported(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"to resume\. Run without --resume"):
        recover_interrupted(tmp_path / "none.mcap", resume=True)


def write_labelled_images(sink: RecordingWriter, first: int, last: int) -> None:
    """Write labels and then their incompressible image at every moment."""
    for k in range(first, last):
        sink.write(k, "/cf1/labels", message_class("PeerLabels")(sources=["truth"]))
        picture = message_class("CompressedImage")(data=random.Random(k).randbytes(20_000))
        sink.write(k, "/cf1/camera/image", picture)


@pytest.mark.heavy
def test_resume_drops_images_without_their_labels(tmp_path: Path) -> None:
    uninterrupted, out = tmp_path / "whole.mcap", tmp_path / "out.mcap"
    with RecordingWriter(uninterrupted, MADE) as sink:
        write_labelled_images(sink, 0, 600)
    for stop, least, most in ((8, 0, 0), (50, 25, 49), (550, 520, 549)):
        with (
            pytest.raises(KeyboardInterrupt),
            RecordingWriter(out, MADE, keep_on_error=True) as sink,
        ):
            write_labelled_images(sink, 0, stop)
            raise KeyboardInterrupt
        before = recover_interrupted(out, resume=True)
        with RecordingWriter(tmp_path / f"{stop}.mcap", MADE) as sink:
            done = before.copy_into(sink)
            assert least <= done <= most
            write_labelled_images(sink, done, 600)
        assert (tmp_path / f"{stop}.mcap").read_bytes() == uninterrupted.read_bytes()


def test_moments_whose_images_were_lost_are_dropped(tmp_path: Path) -> None:
    """Interrupted before the chunk of its images was written, a recording has only numbers."""
    out = tmp_path / "out.mcap"
    with pytest.raises(KeyboardInterrupt), RecordingWriter(out, MADE, keep_on_error=True) as sink:
        write_texts(sink, 0, MOMENTS)
        raise KeyboardInterrupt
    assert sum(1 for _ in recover_interrupted(out, resume=True).iter_moments()) > 0
    assert list(recover_interrupted(out, resume=True, has_images=True).iter_moments()) == []
