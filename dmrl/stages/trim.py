"""trim: a stretch of a recording, or some of its topics."""

import math
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dmrl.errors import SettingError
from dmrl.recording import summary, trim


def command(
    recording: Path,
    out: Path,
    /,
    *,
    from_s: Annotated[float | None, Parameter(name=["--from-s", "--from"])] = None,
    to_s: Annotated[float | None, Parameter(name=["--to-s", "--to"])] = None,
    topic: Annotated[list[str] | None, Parameter(negative=())] = None,
) -> None:
    """Keep a stretch of a recording, or some of its topics.

    Camera calibration is kept wherever it stands.

    Parameters
    ----------
    recording
        A recording.
    out
        Recording to write. Must not exist.
    from_s
        First time kept, seconds from the recording's start.
    to_s
        First time left out, seconds from the recording's start.
    topic
        Topic to keep, or a pattern such as /*/labels. Repeat for more. Without it, all.
    """
    for flag, value in (("--from", from_s), ("--to", to_s)):
        if value is not None and not math.isfinite(value):
            raise SettingError(f"{flag} {value} is no time. Give seconds from the start")
    start_ns = summary(recording).start_ns
    count = trim(
        recording,
        out,
        start_ns=None if from_s is None else start_ns + round(from_s * 1e9),
        end_ns=None if to_s is None else start_ns + round(to_s * 1e9),
        topics=topic or (),
    )
    print(f"{out}: {count} messages")
