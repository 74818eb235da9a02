"""``dmrl trim``: a stretch of a recording, or some of its topics."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dmrl.errors import SettingError
from dmrl.recording import summary, trim
from dmrl.terminal.tables import print_line


@dataclass(frozen=True, slots=True)
class Settings:
    """What is kept. Camera calibration is kept wherever it stands.

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
        if value is not None and not math.isfinite(value):
            raise SettingError(f"{flag} {value} is no time. Give seconds from the start")
    first, last = settings.from_s, settings.to_s
    if first is not None and last is not None and first >= last:
        raise SettingError(f"--from {first:g} is not before --to {last:g}. Exchange them")
    start_ns = summary(recording).start_ns
    return trim(
        recording,
        out,
        start_ns=None if first is None else start_ns + round(first * 1e9),
        end_ns=None if last is None else start_ns + round(last * 1e9),
        topics=settings.topic,
    )


DEFAULTS = Settings()


def command(
    recording: Path,
    out: Path,
    /,
    *,
    settings: Annotated[Settings, Parameter(name="*")] = DEFAULTS,
) -> None:
    """Keep a stretch of a recording, or some of its topics.

    Camera calibration is kept wherever it stands.

    Parameters
    ----------
    recording
        A recording.
    out
        Recording to write. Must not exist.
    """
    print_line(f"{out}: {run(recording, out, settings)} messages")
