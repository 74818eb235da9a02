"""Going on with a recording whose writing was interrupted, to the same bytes."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from dmrl.atomic_output import partial_of
from dmrl.errors import OutputError, RecordingError
from dmrl.recording.log_times import log_times
from dmrl.recording.mcap.channel import RawMessage, holds_pictures
from dmrl.recording.provenance import Provenance
from dmrl.recording.reader import read_raw
from dmrl.recording.recover import recover
from dmrl.recording.summary import summary
from dmrl.recording.writer import RecordingWriter


@dataclass(frozen=True, slots=True)
class Interrupted:
    """What an interrupted writing of a recording left, mended and set aside.

    Parameters
    ----------
    path
        Recording with every message that was kept; None: there is none.
    pictured
        Whether pictures belong to every moment.
    """

    path: Path | None
    pictured: bool = False

    def moments(self) -> Iterator[tuple[int, list[RawMessage]]]:
        """Time and messages of every moment that is whole, numbers before pictures.

        The last one of either may lack some: they stand in other chunks.
        """
        if self.path is None:
            return
        end_ns = _whole_until_ns(self.path, pictured=self.pictured)
        messages = read_raw(self.path, end_ns=end_ns)
        for time_ns, group in groupby(messages, key=lambda raw: raw.time_ns):
            yield time_ns, sorted(group, key=lambda raw: raw.channel.pictured)

    def check(self, made: Provenance) -> None:
        """Nothing, if it was made as ``made`` says.

        Raises
        ------
        RecordingError
            If it was made otherwise.
        """
        if self.path is None:
            return
        found = summary(self.path).provenance
        source = found.inputs[0].provenance if found is not None and found.inputs else None
        # Through text and back, as the file has it: tuples are lists there.
        same = Provenance.from_metadata(made.to_metadata())
        if source is None or source.to_metadata() != same.to_metadata():
            raise RecordingError(
                f"{self.path} was made with other settings, inputs or versions. "
                "Use those, or remove it and start anew"
            )

    def copy(self, sink: RecordingWriter) -> int:
        """Write every whole moment into the recording anew: how many there were."""
        count = 0
        for _, messages in self.moments():
            for raw in messages:
                sink.write_raw(raw)
            count += 1
        return count

    def forget(self) -> None:
        """Remove it, once the new recording holds all of it."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


def interrupted(out: Path, *, resume: bool, pictured: bool = False) -> Interrupted:
    """What is left of an interrupted writing of ``out``, mended as ``<out>.kept``.

    Parameters
    ----------
    out
        The recording that was being written.
    resume
        Whether to go on with it.
    pictured
        Whether every moment of it has pictures: one without is not whole.

    Raises
    ------
    OutputError
        If something is left and it is not to be gone on with.
    RecordingError
        If nothing is left that could be gone on with.
    """
    partial, kept = partial_of(out), out.with_name(out.name + ".kept")
    if not resume:
        if left := [path for path in (partial, kept) if path.exists()]:
            raise OutputError(
                f"{left[0]} is of an interrupted run. Go on with --resume, or remove it"
            )
        return Interrupted(None)
    if not partial.exists() and not kept.exists():
        raise RecordingError(f"no {partial} to resume. Run without --resume")
    _mend(partial, kept)
    return Interrupted(kept if kept.exists() else None, pictured)


def _mend(partial: Path, kept: Path) -> None:
    """Recover ``partial`` into ``kept``, unless that holds more from an earlier time."""
    if not partial.exists():
        return
    mended = kept.with_name(kept.name + ".new")
    mended.unlink(missing_ok=True)
    try:
        recover(partial, mended)
    except RecordingError:
        return  # it was cut before its first chunk: nothing to keep
    if not kept.exists() or _count(mended) > _count(kept):
        mended.replace(kept)
    mended.unlink(missing_ok=True)


def _count(path: Path) -> int:
    return sum(info.count for info in summary(path).topics.values())


def _whole_until_ns(path: Path, *, pictured: bool) -> int:
    """Log time before which nothing is missing, of pictures or of numbers."""
    last: dict[bool, int] = {}
    held = summary(path).topics
    for topic, times in log_times(path, held).items():
        picture = holds_pictures(held[topic].schema)
        last[picture] = max(last.get(picture, 0), int(times.max(initial=0)))
    # Where there are pictures, there are numbers that tell of them: those of none were lost.
    return min(last.values()) if False in last and (True in last or not pictured) else 0
