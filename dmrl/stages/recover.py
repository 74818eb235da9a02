"""recover: bring back the messages of a recording that was cut short."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dmrl.recording import Recovery, recover
from dmrl.terminal.tables import print_json


def run(recording: Path, out: Path) -> Recovery:
    """What was brought back of ``recording`` into ``out``; see `dmrl.recording.recover`."""
    return recover(recording, out)


def command(
    recording: Path,
    out: Path,
    /,
    *,
    as_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> None:
    """Bring back the messages of a recording that was cut short.

    Every message before the damage is kept, bit for bit; a chunk that fails its CRC is left
    out, and what follows it is kept.

    Parameters
    ----------
    recording
        A damaged recording, or the .partial file of a killed run.
    out
        Recording to write. Must not exist.
    as_json
        Print one JSON document instead of a line.
    """
    result = run(recording, out)
    if as_json:
        print_json(asdict(result))
        return
    lost = "nothing was lost"
    if not result.whole:
        nameless = f"{result.nameless} messages left out whose topic they defined, "
        lost = (
            f"{result.damaged_chunks} damaged chunks left out, {nameless * bool(result.nameless)}"
            f"{result.lost_bytes} bytes after the last whole record lost"
        )
    print(f"{out}: {result.messages} messages brought back; {lost}")
