"""``dmrl merge``: several recordings into one."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dmrl.errors import SettingError
from dmrl.pipeline.batch import all_recordings
from dmrl.recording import merge, say_findings
from dmrl.terminal.tables import print_line


def run(recordings: Sequence[Path], out: Path) -> int:
    """Messages of the recordings merged into ``out``; see `dmrl.recording.merge`."""
    count = merge(recordings, out)
    say_findings(out)
    return count


def command(
    *recordings: Annotated[
        Path,
        Parameter(
            name="IN... OUT",
            help="Two recordings or more, or a folder of them; then the one to write.",
        ),
    ],
) -> None:
    """Merge recordings into one, by time.

    Of equal times, messages of the earlier named recording come first.
    """
    *named, out = recordings or [Path()]
    inputs = all_recordings(named)
    if len(inputs) < 2:
        raise SettingError(
            "merge wants two recordings or more and OUT: dmrl merge A.mcap B.mcap OUT.mcap"
        )
    count = run(inputs, out)
    print_line(f"{out}: {count} messages of {len(inputs)} recordings")
