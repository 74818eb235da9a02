"""``dmrl info``: contents and origin of a recording."""

from pathlib import Path
from typing import TYPE_CHECKING

from dmrl.pipeline.stage_command import stage_command
from dmrl.terminal.closing import Closing

if TYPE_CHECKING:
    from dmrl.recording.overview import Overview


def run(recording: Path) -> "Overview":
    """Show the contents and the origin of a recording.

    Parameters
    ----------
    recording
        A recording.
    """
    from dmrl.recording import read_summary
    from dmrl.recording.overview import Overview

    return Overview(recording, read_summary(recording))


command = stage_command(
    run,
    Closing(
        show=lambda overview, _: overview.print(),
        document=lambda overview, _: overview.to_document(),
    ),
)
