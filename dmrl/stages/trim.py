"""``dmrl trim``: a stretch of a recording, or some of its topics."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dmrl.errors import SettingError
from dmrl.pipeline.batch import is_many, over_folder
from dmrl.recording import Provenance, provenance, summary, trim
from dmrl.terminal.arguments import Flat, On, Workers
from dmrl.terminal.tables import print_line

LONGEST_S = 9e9
"""Nanoseconds of more do not fit into 64 bits."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What is kept; with it goes the calibration that a camera had then.

    Parameters
    ----------
    from_s
        First time kept, seconds from the recording's start.
    to_s
        First time left out, seconds from the recording's start.
    topic
        Topic to keep, or a pattern such as /*/labels. Repeat for more. Without it, all.
    """

    from_s: Annotated[float | None, Parameter(name=["--from-s", "--from"])] = None
    to_s: Annotated[float | None, Parameter(name=["--to-s", "--to"])] = None
    topic: Annotated[tuple[str, ...], Parameter(negative=(), show_default=False)] = ()


def run(recording: Path, out: Path, settings: Settings) -> int:
    """Messages of ``recording`` kept in ``out``.

    Parameters
    ----------
    recording
        A whole recording.
    out
        Recording to write. Must not exist.
    settings
        See `Settings`.

    Raises
    ------
    SettingError
        If a time is none, or the last is not after the first.
    RecordingError
        If the recording cannot be read, or nothing would be left.
    OutputError
        If ``out`` exists or cannot be written.
    """
    for flag, value in (("--from", settings.from_s), ("--to", settings.to_s)):
        if value is not None and not abs(value) < LONGEST_S:
            raise SettingError(f"{flag} {value} is no time. Give seconds from the start")
    first, last = settings.from_s, settings.to_s
    if first is not None and last is not None and first >= last:
        raise SettingError(f"--from {first:g} is not before --to {last:g}. Exchange them")
    low_ns, high_ns = _kept_ns(recording, settings)
    return trim(recording, out, start_ns=low_ns, end_ns=high_ns, topics=settings.topic)


def origin(recording: Path, settings: Settings) -> Provenance:
    """Provenance of what `run` would write."""
    low_ns, high_ns = _kept_ns(recording, settings)
    kept = {"start_ns": low_ns, "end_ns": high_ns, "topics": list(settings.topic)}
    return provenance("trim", kept, [recording])


def _kept_ns(recording: Path, settings: Settings) -> tuple[int | None, int | None]:
    """First log time that is kept, and the first that is not."""
    start_ns = summary(recording).start_ns
    low, high = (
        None if given is None else start_ns + round(given * 1e9)
        for given in (settings.from_s, settings.to_s)
    )
    return low, high


DEFAULTS = Settings()


def command(
    recording: Path,
    out: Path,
    /,
    *,
    settings: Flat[Settings] = DEFAULTS,
    workers: Workers = None,
    on: On = None,
) -> None:
    """Keep a stretch of a recording, or some of its topics.

    The calibration that a camera had then goes along.

    Parameters
    ----------
    recording
        A recording, or a folder of recordings.
    out
        Recording to write. Must not exist. For a folder: the folder of what is made, under the
        same names.
    workers
        Of a folder: recordings at a time, at most. Without it, as many as there are cores.
        Changes no byte.
    """
    if is_many(recording) or on is not None:
        over_folder("trim", recording, out, settings, workers=workers, on=on)
        return
    print_line(f"{out}: {run(recording, out, settings)} messages")
