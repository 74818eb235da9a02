"""``dmrl trim``: a stretch of a recording, or some of its topics."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dmrl.errors import SettingError
from dmrl.pipeline.stage_command import stage_command
from dmrl.terminal.arguments import complete_topic
from dmrl.terminal.closing import Closing
from dmrl.terminal.tables import count_things

if TYPE_CHECKING:
    from dmrl.recording import Provenance

LONGEST_S = 9e9
"""Longest time, seconds: nanoseconds of more do not fit into 64 bits."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Parts of a recording to keep.

    Parameters
    ----------
    from_s
        Start of the stretch, seconds from the recording's start. Messages of this time are kept.
    to_s
        End of the stretch, seconds from the recording's start. Messages of this time are not kept.
    topic
        Topic to keep, or a pattern such as /*/labels: * is one part of a name, so that /cf1/* has
        no /cf1/camera/image. Repeat for more. Without it, all.
    """

    from_s: Annotated[float | None, Parameter(name=["--from-s", "--from"])] = None
    to_s: Annotated[float | None, Parameter(name=["--to-s", "--to"])] = None
    topic: Annotated[
        tuple[str, ...], Parameter(negative=(), show_default=False, completer=complete_topic)
    ] = ()


def run(recording: Path, out: Path, settings: Settings) -> int:
    """Cut a time range out of a recording, or keep some of its topics.

    The calibration that a camera had then goes along.

    Parameters
    ----------
    recording
        A recording, or a folder of recordings.
    out
        Recording to write. Must not exist. For a folder: the folder of the outputs, under the
        same names.
    settings
        See `Settings`.

    Returns
    -------
    int
        Messages kept.

    Raises
    ------
    SettingError
        If a time is too large, or the last is not after the first.
    RecordingError
        If the recording cannot be read, or nothing would be left.
    OutputError
        If ``out`` exists or cannot be written.
    """
    from dmrl.recording import trim

    for flag, value in (("--from", settings.from_s), ("--to", settings.to_s)):
        if value is not None and not abs(value) < LONGEST_S:
            raise SettingError(f"{flag} {value} is no time. Give seconds from the start")
    first, last = settings.from_s, settings.to_s
    if first is not None and last is not None and first >= last:
        remedy = "Swap them" if first > last else "Give a later one"
        raise SettingError(f"--from-s {first:g} is not before --to-s {last:g}. {remedy}")
    low_ns, high_ns = _compute_kept_ns(recording, settings)
    return trim(
        recording,
        out,
        start_ns=low_ns,
        end_ns=high_ns,
        topics=settings.topic,
        origin=origin(recording, settings),
    )


def origin(recording: Path, settings: Settings) -> "Provenance":
    """Return the provenance of what `run` would write."""
    from dmrl.recording import build_provenance

    low_ns, high_ns = _compute_kept_ns(recording, settings)
    kept = {**asdict(settings), "start_ns": low_ns, "end_ns": high_ns}
    return build_provenance("trim", kept, [recording])


def _compute_kept_ns(recording: Path, settings: Settings) -> tuple[int | None, int | None]:
    """Return the first log time that is kept, and the first after it that is not."""
    from dmrl.recording import read_summary

    start_ns = read_summary(recording).start_ns
    low, high = (
        None if given is None else start_ns + round(given * 1e9)
        for given in (settings.from_s, settings.to_s)
    )
    return low, high


command = stage_command(
    run,
    Closing(
        lines=lambda kept, given: [f"{given.out}: {count_things(kept, 'message')}"],
        path_key="recording",
        result_key="messages",
    ),
    folder="recording",
)
