"""Resume the writing of an interrupted recording; the result has the same bytes."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from dmrl.atomic_output import to_partial_path
from dmrl.errors import OutputError, RecordingError
from dmrl.recording.log_times import read_time_spans
from dmrl.recording.mcap.channel import RawMessage, is_image_type
from dmrl.recording.provenance import Provenance
from dmrl.recording.reader import read_raw
from dmrl.recording.recover import recover
from dmrl.recording.summary import read_summary
from dmrl.recording.writer import RecordingWriter


@dataclass(frozen=True, slots=True)
class InterruptedRecording:
    """The recovered part of a recording whose writing was interrupted.

    Parameters
    ----------
    path
        Recording with every recovered message. None: there is none.
    has_images
        Whether every moment must have images.
    """

    path: Path | None
    has_images: bool = False

    def iter_moments(self) -> Iterator[tuple[int, list[RawMessage]]]:
        """Yield time and messages of every complete moment, numbers before images.

        The last moment of either kind may be incomplete, as they are in different chunks.
        """
        if self.path is None:
            return
        end_ns = _find_complete_until_ns(self.path, has_images=self.has_images)
        messages = read_raw(self.path, end_ns=end_ns)
        for time_ns, group in groupby(messages, key=lambda raw: raw.time_ns):
            yield time_ns, sorted(group, key=lambda raw: raw.channel.carries_images)

    def check_provenance(self, made: Provenance) -> None:
        """Raise RecordingError unless it was made with the same settings, inputs and versions."""
        if self.path is None:
            return
        known = read_summary(self.path).provenance
        source = known.inputs[0].provenance if known is not None and known.inputs else None
        # Converted to text and back, as in the file: tuples become lists.
        same = Provenance.from_metadata(made.to_metadata())
        if source is None or source.to_metadata() != same.to_metadata():
            raise RecordingError(
                f"{self.path} was made with other settings, inputs or versions. "
                "Use those, or remove it and start again"
            )

    def copy_into(self, sink: RecordingWriter) -> int:
        """Copy every complete moment into the new recording, and return how many."""
        count = 0
        for _, messages in self.iter_moments():
            for raw in messages:
                sink.write_raw(raw)
            count += 1
        return count

    def delete_file(self) -> None:
        """Delete the recovered file, once the new recording contains all of it."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


def recover_interrupted(
    out: Path, *, resume: bool, has_images: bool = False
) -> InterruptedRecording:
    """Recover the interrupted recording of ``out`` as ``<out>.kept``.

    Parameters
    ----------
    out
        The recording that was being written.
    resume
        Whether to continue it.
    has_images
        Whether every moment must have images; one without counts as incomplete.

    Raises
    ------
    OutputError
        If an interrupted recording exists and ``resume`` is false.
    RecordingError
        If ``resume`` is true and there is nothing to continue.
    """
    partial, kept = to_partial_path(out), out.with_name(out.name + ".kept")
    if not resume:
        if left := [path for path in (partial, kept) if path.exists()]:
            raise OutputError(
                f"{left[0]} is left from an interrupted run. Go on with --resume, or remove it"
            )
        return InterruptedRecording(None)
    if not partial.exists() and not kept.exists():
        raise RecordingError(f"no {partial} to resume. Run without --resume")
    _recover_partial(partial, kept)
    return InterruptedRecording(kept if kept.exists() else None, has_images)


def _recover_partial(partial: Path, kept: Path) -> None:
    """Recover ``partial`` into ``kept``, unless that already contains more messages."""
    if not partial.exists():
        return
    recovered = kept.with_name(kept.name + ".new")
    recovered.unlink(missing_ok=True)
    try:
        recover(partial, recovered)
    except RecordingError:
        return  # it ends before its first complete chunk
    if not kept.exists() or read_summary(recovered).count > read_summary(kept).count:
        recovered.replace(kept)
    recovered.unlink(missing_ok=True)


def _find_complete_until_ns(path: Path, *, has_images: bool) -> int:
    """Return the log time before which no message, image or number, is missing."""
    last: dict[bool, int] = {}
    topics = read_summary(path).topics
    spans = read_time_spans(path)
    for topic, info in topics.items():
        picture = is_image_type(info.schema)
        last[picture] = max(last.get(picture, 0), spans.get(topic, (0, 0))[1])
    # Images come with numbers that describe them, so a file with images alone has lost numbers.
    return min(last.values()) if False in last and (True in last or not has_images) else 0
