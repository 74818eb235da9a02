"""Contents and origin of a recording, as text and JSON: what ``dmrl info`` shows."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dmrl.guards.safe_names import truncate_middle
from dmrl.recording.log_times import read_time_spans
from dmrl.recording.mcap.extra_records import read_header
from dmrl.recording.mcap.file import open_mcap
from dmrl.recording.mcap.summary_section import read_summary_section
from dmrl.recording.protobuf.message_types import iter_wrong_types
from dmrl.recording.provenance import METADATA_NAME, Provenance
from dmrl.recording.summary import Summary
from dmrl.recording.writer import RECIPE_NAME
from dmrl.terminal.tables import count_things, format_size, print_line, print_table


@dataclass(frozen=True, slots=True)
class Overview:
    """A recording and its summary."""

    path: Path
    summary: Summary

    def to_document(self) -> dict[str, Any]:
        """Return everything that is shown, as JSON values."""
        found = self.summary
        topics = {
            name: {"message": i.schema, "encoding": i.encoding, "count": i.count}
            for name, i in found.topics.items()
        }
        return {
            "recording": self.path.name,
            "bytes": self.path.stat().st_size,
            "messages": found.count,
            "start_ns": found.start_ns,
            "end_ns": found.end_ns,
            **asdict(read_container(self.path)),
            "topics": topics,
            "warnings": self._list_warnings(),
            "metadata": found.metadata,
            "attachments": sorted(one.name for one in found.attachments),
            "provenance": found.provenance.to_json() if found.provenance else None,
        }

    def print(self) -> None:
        """Print size and duration, a row for each topic, attached data, and the ancestry."""
        path, found = self.path, self.summary
        duration_s = (found.end_ns - found.start_ns) / 1e9
        messages = f"{count_things(found.count, 'message')} over {duration_s:.3f} s"
        print_line(f"{path}: {format_size(path.stat().st_size)}, {messages}")
        print_line(_describe_container(read_container(path)))
        columns = ("topic", "message", "encoding", "messages", "rate, Hz")
        print_table("", columns, topic_rows(path, found))
        lines = [*_iter_attached(found), *ancestry_lines(found.provenance)]
        for line in [*lines, *(f"warning: {why}" for why in self._list_warnings())]:
            print_line(line)

    def _list_warnings(self) -> list[str]:
        """Return why commands that decode a topic refuse it, and the way out."""
        topics, command = self.summary.topics, f"dmrl convert {self.path} OUT.mcap"
        return [
            f"{topic} {why}: commands that read it refuse it. Convert the recording: {command}"
            for topic, why in iter_wrong_types(topics, topics)
        ]


@dataclass(frozen=True, slots=True)
class Container:
    """How the MCAP file was written: its profile and library, and how its chunks are compressed."""

    profile: str
    library: str
    compression: list[str]


def read_container(path: Path) -> Container:
    """Read how an MCAP file was written. Without an index, no compression is known."""
    with open_mcap(path) as stream:
        header, section = read_header(stream), read_summary_section(stream)
    chunks = section.chunk_indexes if section is not None else []
    return Container(header.profile, header.library, sorted({c.compression for c in chunks}))


def _describe_container(found: Container) -> str:
    kinds = ", ".join(kind or "not compressed" for kind in found.compression) or "no index"
    profile = f"profile {found.profile}" if found.profile else "no profile"
    return f"chunks: {kinds}; {profile}; written by {found.library or 'an unnamed library'}"


def _iter_attached(found: Summary) -> Iterator[str]:
    """Yield a line for each attachment and metadata record, but for those of every recording."""
    own = {RECIPE_NAME} if found.provenance is not None else set()
    for one in (one for one in found.attachments if one.name not in own):
        yield f"attachment: {one.name}, {one.media_type or 'no type'}, {format_size(len(one.data))}"
    for name, records in found.metadata.items():
        for values in records if name != METADATA_NAME else ():
            shown = ", ".join(f"{key}{_show_value(value)}" for key, value in values.items())
            yield truncate_middle(f"metadata: {name}: {shown}")


def _show_value(value: str) -> str:
    """Return a value of one line; of a text such as a camera file, the number of its lines."""
    lines = value.strip().splitlines()
    return f"={value}" if len(lines) < 2 else f" ({count_things(len(lines), 'line')})"


def topic_rows(path: Path, found: Summary) -> list[tuple[str, str, str, int, float | None]]:
    """Return topic, message, encoding, count and mean rate of each topic, in its own span."""
    spans = read_time_spans(path)
    return [
        (
            *(topic, info.schema or "no schema", info.encoding or "no encoding", info.count),
            _rate_hz(info.count, *spans.get(topic, (0, 0))),
        )
        for topic, info in found.topics.items()
    ]


def _rate_hz(count: int, first_ns: int, last_ns: int) -> float | None:
    return (count - 1) / ((last_ns - first_ns) * 1e-9) if last_ns > first_ns else None


def ancestry_lines(made: Provenance | None) -> list[str]:
    """Return how the recording was made, then its inputs, and theirs, indented."""
    if made is None:
        return ["made by: not known (no dmrl.provenance metadata)"]
    lines = [f"made by: {_origin(made)}"]
    lines += [f"left out: {reason}: {count}" for reason, count in made.left_out.items()]
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
    settings = "".join(f" {name}={text}" for name, text in made.list_settings())
    seed = f" seed={made.seed}" if made.seed is not None and "seed" not in made.settings else ""
    libraries = "".join(f" {name} {version}" for name, version in made.libraries.items())
    return f"dmrl {made.dmrl_version} {made.stage}{settings}{seed}{libraries}"
