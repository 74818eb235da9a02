"""``dmrl recover``: bring back the messages of a recording that was cut short."""

from dataclasses import asdict
from pathlib import Path

from dmrl.pipeline.batch import is_many, over_folder
from dmrl.recording import Recovery, recover
from dmrl.terminal.arguments import AsJson, On, Workers
from dmrl.terminal.tables import print_json, print_line


def run(recording: Path, out: Path) -> Recovery:
    """What was brought back of ``recording`` into ``out``; see `dmrl.recording.recover`."""
    return recover(recording, out)


def command(
    recording: Path,
    out: Path,
    /,
    *,
    workers: Workers = None,
    on: On = None,
    as_json: AsJson = False,
) -> None:
    """Bring back the messages of a recording that was cut short.

    Every message that can be read is kept, bit for bit; a chunk that fails its CRC is left
    out, and what follows it is kept. The line says how many messages are missing, by topic.

    Parameters
    ----------
    recording
        A damaged recording, or the .partial file of a killed run; or a folder of recordings.
    out
        Recording to write. Must not exist. For a folder: the folder of what is made, under the
        same names.
    workers
        Of a folder: recordings at a time, at most. Without it, as many as there are cores.
        Changes no byte.
    as_json
        Print one JSON document instead of a line.
    """
    if is_many(recording) or on is not None:
        over_folder("recover", recording, out, workers=workers, on=on, as_json=as_json)
        return
    result = run(recording, out)
    if as_json:
        print_json(asdict(result))
        return
    print_line(f"{out}: {result.messages} messages brought back; {_lost(result)}")


def _lost(result: Recovery) -> str:
    """What was lost, in words."""
    if result.whole:
        sure = "" if result.counted else " as far as can be told: it does not say what it had"
        return f"nothing was lost{sure}"
    missing = ", ".join(f"{topic} {count}" for topic, count in result.missing.items())
    unknown = "it does not say how many messages there were"
    parts = (
        f"{sum(result.missing.values())} messages missing ({missing})" * bool(missing),
        f"{result.damaged_chunks} damaged chunks left out" * bool(result.damaged_chunks),
        f"{result.nameless} messages left out whose topic they defined" * bool(result.nameless),
        f"{result.timeless} messages left out whose time is impossible" * bool(result.timeless),
        f"{result.lost_bytes} bytes that are no whole record lost" * bool(result.lost_bytes),
        "metadata or attachments missing, or damaged and kept as they stand" * result.doubtful,
        unknown * (not result.counted),
    )
    return ", ".join(part for part in parts if part)
