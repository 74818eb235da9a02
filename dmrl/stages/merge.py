"""merge: several recordings into one."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dmrl.errors import SettingError
from dmrl.recording import merge


def command(
    *recordings: Annotated[Path, Parameter(help="Two or more recordings, then OUT.")],
) -> None:
    """Merge recordings into one, by time.

    The last name is the recording to write: dmrl merge A.mcap B.mcap OUT.mcap. Of equal
    times, messages of the earlier named recording come first.
    """
    if len(recordings) < 3:
        raise SettingError(
            "merge wants two recordings or more and OUT: dmrl merge A.mcap B.mcap OUT.mcap"
        )
    *inputs, out = recordings
    count = merge(inputs, out)
    print(f"{out}: {count} messages of {len(inputs)} recordings")
