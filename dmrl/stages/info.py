"""``dmrl info``: what a recording holds and where it comes from."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.recording import Provenance, Summary, log_times, summary
from dmrl.terminal.arguments import AsJson
from dmrl.terminal.tables import print_json, print_line, print_table


def command(recording: Path, /, *, as_json: AsJson = False) -> None:
    """Show what a recording holds and where it comes from.

    Parameters
    ----------
    recording
        A recording.
    as_json
        Print one JSON document instead of tables.
    """
    found = summary(recording)
    if as_json:
        print_json(document(recording, found))
        return
    print_line(headline(recording, found))
    print_table("", ("topic", "message", "messages", "rate, Hz"), topic_rows(recording, found))
    for line in ancestry_lines(found.provenance):
        print_line(line)


def document(path: Path, found: Summary) -> dict[str, Any]:
    """Everything ``info`` shows, as plain values."""
    return {
        "recording": path.name,
        "bytes": path.stat().st_size,
        "messages": found.count,
        "start_ns": found.start_ns,
        "end_ns": found.end_ns,
        "topics": {t: {"message": i.schema, "count": i.count} for t, i in found.topics.items()},
        "metadata": found.metadata,
        "attachments": sorted(found.attachments),
        "provenance": found.provenance.to_json() if found.provenance else None,
    }


def headline(path: Path, found: Summary) -> str:
    """Name, size, number of messages and duration, in one line."""
    duration_s = (found.end_ns - found.start_ns) / 1e9
    megabytes = path.stat().st_size / 1e6
    return f"{path}: {megabytes:.1f} MB, {found.count} messages over {duration_s:.3f} s"


def topic_rows(path: Path, found: Summary) -> list[tuple[str, str, int, float | None]]:
    """Topic, message, count and mean rate of each topic, from its own first message to its last."""
    times = log_times(path, found.topics)
    return [
        (topic, info.schema, info.count, _rate_hz(times.get(topic)))
        for topic, info in found.topics.items()
    ]


def _rate_hz(time_ns: NDArray[np.int64] | None) -> float | None:
    if time_ns is None or len(time_ns) < 2 or time_ns[0] == time_ns[-1]:
        return None
    return (len(time_ns) - 1) / float((time_ns[-1] - time_ns[0]) * 1e-9)


def ancestry_lines(made: Provenance | None) -> list[str]:
    """How the recording was made, then its inputs, and theirs, indented."""
    if made is None:
        return ["made by: not known (no dmrl.provenance metadata)"]
    lines = [f"made by: {_made_by(made)}"]
    told: set[str] = set()
    for depth, source in made.ancestry():
        how = ", as above" if source.sha256 in told else ""
        if source.provenance is not None:
            told.add(source.sha256)
            how = f", made by: {_made_by(source.provenance)}"
        name = f"{source.name} sha256:{source.sha256[:12]}"
        lines.append(f"{'  ' * (depth + 1)}from {name}{how}")
    return lines


def _made_by(made: Provenance) -> str:
    settings = "".join(
        f" {key}={value}" for key, value in made.settings.items() if value is not None
    )
    seed = f" seed={made.seed}" if made.seed is not None and "seed" not in made.settings else ""
    libraries = "".join(f" {name} {version}" for name, version in made.libraries.items())
    return f"dmrl {made.dmrl_version} {made.stage}{settings}{seed}{libraries}"
