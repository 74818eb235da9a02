"""Recordings of foreign files and folders, whose formats `dmrl.formats` reads."""

import json
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from itertools import chain
from pathlib import Path

from dmrl.errors import SettingError, SourceError
from dmrl.formats.base import Content, Format, Names, Options
from dmrl.formats.registry import find_format
from dmrl.guards.paths import refuse_pipes
from dmrl.ingest import foreign_recording, mapped_topics
from dmrl.recording import (
    LICENCES_METADATA,
    SPLIT_METADATA,
    RecordingWriter,
    build_provenance,
    extract_licence_title,
    find_licence_file,
    iter_time_slices,
    print_findings,
)
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import say, track


def record_source(
    source: Path,
    out: Path,
    kind: str | None,
    options: Options,
    *,
    settings: object,
    files: Iterable[Path | None],
) -> dict[str, int]:
    """Write a foreign source as a recording; return the number of messages by topic.

    Parameters
    ----------
    source
        A file or folder.
    out
        Recording to write.
    kind
        Name of its format. None: the first one that recognises it.
    options
        Options of the format.
    settings
        Settings that the recording's provenance lists.
    files
        Files that the settings name; those that exist become inputs.

    Raises
    ------
    SourceError
        If the source is not what its format says: names the file, and the line.
    SettingError
        If an option has no effect on the source.
    """
    form = _find_format(source, kind)
    form.refuse_unused(options)
    names = Names(options.names)
    content = form.content(source, replace(options, names=names))
    read = [path for path in files if path and path.is_file()]
    licence = find_licence_file(source)
    if licence is not None and source.is_file():
        read.append(licence)
    made = build_provenance("convert", settings, (source, *read), libraries=("pillow", "numpy"))
    with RecordingWriter(out, made) as sink:
        if licence is not None:
            sink.add_metadata(LICENCES_METADATA, {source.name: extract_licence_title(licence)})
        counts = write_content(content, sink)
        if not counts:
            raise SourceError(f"{source}: nothing in it can be used. The lines above say why")
        _report_unused(names, source)
    print_findings(out, values=True)
    return counts


def _report_unused(names: Names, source: Path) -> None:
    """Report the old names that a source does not have; raise SettingError if it has none."""
    unused = ", ".join(sorted(names.unused))
    if unused and len(names.unused) == len(names):
        raise SettingError(f"--names has no effect: {source} has no {unused}. Leave it out")
    if unused:
        say(f"{source}: --names has names that are not in it: {unused}")


def _find_format(source: Path, kind: str | None) -> Format:
    """Return the format of a source; raise as `find_format`."""
    mapped, adopted = mapped_topics.FORMAT, foreign_recording.FORMAT
    if kind == "columns" and source.exists() and mapped.recognises(source):
        return mapped
    if kind == adopted.name or (kind is None and adopted.recognises(source)):
        return adopted
    return find_format(source, kind)


def write_content(content: Content, sink: RecordingWriter) -> dict[str, int]:
    """Write samples and series in time order; return the number of messages by topic."""
    counts: Counter[str] = Counter()
    if content.split:
        split = {name: json.dumps(times) for name, times in content.split.items()}
        sink.add_metadata(SPLIT_METADATA, split)
    single = content.others if content.series else content.samples
    samples = iter(track(single, "Converting", content.total))
    waiting = next(samples, None)
    for first_ns, end_ns in iter_time_slices([one.time_ns for one in content.series]):
        for series in content.series:
            part = series.crop_to_time(first_ns, end_ns)
            sink.write_series(part)
            counts[part.topic] += len(part.time_ns)
        while waiting is not None and waiting.time_ns < end_ns:
            sink.write_sample(waiting)
            counts[waiting.topic] += 1
            waiting = next(samples, None)
    for sample in samples if waiting is None else chain([waiting], samples):
        sink.write_sample(sample)
        counts[sample.topic] += 1
    return dict(sorted((+counts).items()))


def find_sources(source: Path, kind: str | None) -> dict[Path, Path]:
    """Return the sources in a folder by the names of their recordings.

    Raises
    ------
    SourceError
        If there is none.
    SettingError
        If two recordings would have the same name, or each would hold one picture.
    """
    refuse_pipes(source)
    found: dict[Path, Path] = {}
    single_pictures = 0
    for path in sorted(source.iterdir()) if source.is_dir() else [source]:
        try:
            if path.name.startswith("."):
                continue
            form = _find_format(path, kind)
        except SourceError:
            leave_out("files and folders of no known kind", path)
            continue
        name = Path(path.name if path.is_dir() else path.stem).with_suffix(".mcap")
        single_pictures += path.is_file() and form.name == "images"
        if (twin := found.setdefault(name, path)) is not path:
            raise SettingError(f"{twin} and {path} would both be {name}. Rename one")
    if not found:
        raise SourceError(
            f"nothing in {source} is of a known kind. If it is one source, name one recording: "
            "dmrl convert SOURCE OUT.mcap"
        )
    if single_pictures == len(found) > 1:
        raise SettingError(
            f"{source} is a folder of pictures. For one recording of all: dmrl convert {source} "
            "OUT.mcap"
        )
    return found
