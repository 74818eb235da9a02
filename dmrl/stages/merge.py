"""``dmrl merge``: several recordings into one."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dmrl.errors import SettingError
from dmrl.pipeline.batch import find_all_recordings
from dmrl.terminal.arguments import AsJson
from dmrl.terminal.tables import count_things, print_json, print_line


def run(recordings: Sequence[Path], out: Path) -> int:
    """Merge recordings into ``out``; return the number of messages. See `dmrl.recording.merge`."""
    from dmrl.recording import merge, print_findings

    count = merge(recordings, out)
    print_findings(out)
    return count


def command(
    *recordings: Annotated[
        Path,
        Parameter(
            name="IN... OUT",
            help="Two recordings or more, or a folder of them; then the one to write.",
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Merge recordings into one, by time.

    Chunks are copied whole, so messages of equal times may come in any order.
    """
    *named, out = recordings or [Path()]
    inputs = find_all_recordings(named)
    if len(inputs) < 2:
        raise SettingError(
            "merge wants two recordings or more and OUT: dmrl merge A.mcap B.mcap OUT.mcap"
        )
    count = run(inputs, out)
    if as_json:
        print_json({"recording": str(out), "messages": count, "recordings": len(inputs)})
    else:
        print_line(f"{out}: {count_things(count, 'message')} of {len(inputs)} recordings")
