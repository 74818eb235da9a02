"""``dmrl recover``: bring back the messages of a recording that was cut short."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from dmrl.pipeline.stage_command import stage_command
from dmrl.terminal.closing import Closing
from dmrl.terminal.tables import count_things

if TYPE_CHECKING:
    from dmrl.recording import Recovery


def run(recording: Path, out: Path) -> "Recovery":
    """Recover the messages of a damaged or unfinished recording.

    Every message that can be read is kept, bit for bit; a chunk that fails its CRC is left
    out, and what follows it is kept. The line says how many messages are missing, by topic.

    Parameters
    ----------
    recording
        A damaged recording, or the .partial file of a killed run; or a folder of recordings.
    out
        Recording to write. Must not exist. For a folder: the folder of the outputs, under the
        same names.
    """
    from dmrl.recording import recover

    return recover(recording, out)


def describe_losses(result: "Recovery") -> str:
    """Describe everything that could not be brought back."""
    if result.whole:
        sure = "" if result.counted else " as far as can be told: it does not say what it had"
        return f"nothing was lost{sure}"
    missing = ", ".join(f"{topic} {count}" for topic, count in result.missing.items())
    unknown = "it does not say how many messages there were"
    parts = (
        _count(sum(result.missing.values()), "message", f"missing ({missing})"),
        _count(result.damaged_chunks, "damaged chunk", "left out"),
        _count(result.nameless, "message", "left out whose topic they defined"),
        _count(result.timeless, "message", "left out whose time is after the year 2262"),
        _count(result.lost_bytes, "byte", "that are no whole record lost"),
        "metadata or attachments missing, or damaged and kept as they stand" * result.doubtful,
        *result.contradictions,
        unknown * (not result.counted),
    )
    return ", ".join(part for part in parts if part)


def _count(count: int, thing: str, what: str) -> str:
    return f"{count_things(count, thing)} {what}" if count else ""


command = stage_command(
    run,
    Closing(
        lines=lambda result, given: [
            f"{given.out}: {count_things(result.messages, 'message')} brought back; "
            f"{describe_losses(result)}"
        ],
        document=lambda result, _: asdict(result),
    ),
    folder="recording",
)
