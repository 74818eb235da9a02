"""Contents and origin of a recording, as text and JSON: what ``dmrl info`` shows."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dmrl.recording.log_times import read_time_spans
from dmrl.recording.provenance import Provenance
from dmrl.recording.summary import Summary
from dmrl.terminal.tables import print_line, print_table


@dataclass(frozen=True, slots=True)
class Overview:
    """A recording and its summary."""

    path: Path
    summary: Summary

    def to_document(self) -> dict[str, Any]:
        """Return everything that is shown, as JSON values."""
        found = self.summary
        topics = {name: {"message": i.schema, "count": i.count} for name, i in found.topics.items()}
        return {
            "recording": self.path.name,
            "bytes": self.path.stat().st_size,
            "messages": found.count,
            "start_ns": found.start_ns,
            "end_ns": found.end_ns,
            "topics": topics,
            "metadata": found.metadata,
            "attachments": sorted(one.name for one in found.attachments),
            "provenance": found.provenance.to_json() if found.provenance else None,
        }

    def print(self) -> None:
        """Print size and duration, a row for each topic, and the ancestry."""
        path, found = self.path, self.summary
        duration_s, megabytes = (found.end_ns - found.start_ns) / 1e9, path.stat().st_size / 1e6
        size = f"{megabytes:.1f} MB, {found.count} messages over {duration_s:.3f} s"
        print_line(f"{path}: {size}")
        columns = ("topic", "message", "messages", "rate, Hz")
        print_table("", columns, topic_rows(path, found))
        for line in ancestry_lines(found.provenance):
            print_line(line)


def topic_rows(path: Path, found: Summary) -> list[tuple[str, str, int, float | None]]:
    """Return topic, message, count and mean rate of each topic, between its own messages."""
    spans = read_time_spans(path)
    return [
        (topic, info.schema, info.count, _rate_hz(info.count, *spans.get(topic, (0, 0))))
        for topic, info in found.topics.items()
    ]


def _rate_hz(count: int, first_ns: int, last_ns: int) -> float | None:
    return (count - 1) / ((last_ns - first_ns) * 1e-9) if last_ns > first_ns else None


def ancestry_lines(made: Provenance | None) -> list[str]:
    """Return how the recording was made, then its inputs, and theirs, indented."""
    if made is None:
        return ["made by: not known (no dmrl.provenance metadata)"]
    lines = [f"made by: {_origin(made)}"]
    lines += [f"left out: {count} {reason}" for reason, count in made.left_out.items()]
    listed: set[str] = set()
    for depth, source in made.iter_ancestors():
        how = ", as above" if source.sha256 in listed else ""
        if source.provenance is not None:
            listed.add(source.sha256)
            how = f", made by: {_origin(source.provenance)}"
        name = f"{source.name} sha256:{source.sha256[:12]}"
        lines.append(f"{'  ' * (depth + 1)}from {name}{how}")
    return lines


def _origin(made: Provenance) -> str:
    settings = "".join(
        f" {key}={value}" for key, value in made.settings.items() if value is not None
    )
    seed = f" seed={made.seed}" if made.seed is not None and "seed" not in made.settings else ""
    libraries = "".join(f" {name} {version}" for name, version in made.libraries.items())
    return f"dmrl {made.dmrl_version} {made.stage}{settings}{seed}{libraries}"
