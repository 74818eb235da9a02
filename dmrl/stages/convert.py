"""``dmrl convert``: foreign files and folders to a recording, and recordings to files.

A new format is one file in ``dmrl/formats`` and one row in ``dmrl.formats.registry``.
"""

import json
import re
from collections import Counter
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter, validators

from dmrl.atomic_output import refuse_existing
from dmrl.errors import SettingError, SourceError
from dmrl.export.csv_parquet import write_tables
from dmrl.export.ros2 import write_bag
from dmrl.formats.base import Content, Options
from dmrl.formats.registry import format_of
from dmrl.geometry.camera_file import camera_named
from dmrl.guards.paths import refuse_pipes
from dmrl.messages import message
from dmrl.pipeline.batch import over_folder, recordings_in
from dmrl.recording import (
    LICENCES_METADATA,
    SPLIT_METADATA,
    RecordingWriter,
    licence_beside,
    licence_words,
    provenance,
    say_findings,
    time_slices,
)
from dmrl.samples.sample import Sample
from dmrl.terminal.arguments import AsJson, Flat, On, Workers
from dmrl.terminal.progress import say, track
from dmrl.terminal.tables import print_json, print_table

ROBOT = re.compile(r"[A-Za-z0-9_-]+")

RATE_MAX_HZ = 1e6
SIDE_MAX_PX = 8192
Positive = Annotated[int, Parameter(validator=validators.Number(gte=1))]


@dataclass(frozen=True, slots=True)
class Settings:
    """How a source becomes a recording.

    Parameters
    ----------
    source_kind
        What SOURCE is, as docs/sources.md names it. Guessed where it can be.
    robot
        Robot that carries the camera, or whose log it is.
    names
        Names of robots by those that the source has for them: 0=cf2,turtle_cap=turtle1. The
        numbers in logs are else cf0, cf1, ...
    rate_hz
        Pictures per second, where the source has no times.
    labels
        images: CSV file with labels. Without it, labels.csv in the folder, if there.
    camera
        Camera that took the pictures as they are stored: aideck, published, or a TOML file.
        Without it, calibration.toml in the folder, if there.
    width_px
        images: crop to the middle and scale to this width. Needs the height too.
    height_px
        images: crop to the middle and scale to this height. Needs the width too.
    columns
        TOML file that says what the columns of a CSV file are, with their units, frames and signs,
        or nanobench.
    raw
        images: grey pictures are as the AI-deck's colour sensor gave them; make them RGB.
    to
        The other way: SOURCE is a recording, OUT a folder of tables (csv, parquet) or a ROS 2
        bag (ros2).
    """

    source_kind: Annotated[str | None, Parameter(name="--from")] = None
    robot: str = "cf1"
    names: str | None = None
    rate_hz: Annotated[float, Parameter(validator=validators.Number(gt=0))] = 10.0
    labels: Path | None = None
    camera: Path | None = None
    width_px: Positive | None = None
    height_px: Positive | None = None
    columns: Path | None = None
    raw: Annotated[bool, Parameter(negative=())] = False
    to: Literal["csv", "parquet", "ros2"] | None = None


def run(source: Path, out: Path, settings: Settings) -> dict[str, int]:
    """Messages per topic of the recording, or rows of the tables, written to ``out``.

    Parameters
    ----------
    source
        A foreign file or folder; with ``settings.to``, a recording.
    out
        Recording, or folder, to write. Must not exist.
    settings
        See `Settings`.

    Raises
    ------
    SourceError
        If the source is not what its format says: names the file, and the line.
    SettingError
        If a setting cannot be met by this source.
    OutputError
        If ``out`` exists or cannot be written.
    """
    refuse_existing(out)
    refuse_pipes(source)
    if settings.to == "ros2":
        return write_bag(source, out)
    if settings.to is not None:
        return write_tables(source, out, settings.to)
    options = _options(settings)
    kind = settings.source_kind or ("columns" if settings.columns else None)
    content = format_of(source, kind).content(source, options)
    given = (settings.labels, settings.camera, settings.columns)
    read = [path for path in given if path and path.is_file()]
    licence = licence_beside(source)
    if licence is not None and source.is_file():
        read.append(licence)
    made = provenance("convert", settings, (source, *read), libraries=("pillow", "numpy"))
    with RecordingWriter(out, made) as sink:
        if licence is not None:
            sink.add_metadata(LICENCES_METADATA, {source.name: licence_words(licence)})
        counts = _write(content, sink)
    say_findings(out)
    return counts


def _write(content: Content, sink: RecordingWriter) -> dict[str, int]:
    counts: Counter[str] = Counter()
    if content.split:
        split = {name: json.dumps(times) for name, times in content.split.items()}
        sink.add_metadata(SPLIT_METADATA, split)
    single = content.others if content.series else content.samples
    samples = iter(track(single, "Converting", content.total))
    waiting = next(samples, None)
    for first_ns, end_ns in time_slices([one.time_ns for one in content.series]):
        for series in content.series:
            part = series.between(first_ns, end_ns)
            sink.write_columns(part.topic, message(part.message), part.time_ns, part.fields)
            counts[part.topic] += len(part.time_ns)
        while waiting is not None and waiting.time_ns < end_ns:
            counts[_put(waiting, sink)] += 1
            waiting = next(samples, None)
    for sample in samples if waiting is None else chain([waiting], samples):
        counts[_put(sample, sink)] += 1
    return dict(sorted((+counts).items()))


def _put(sample: Sample, sink: RecordingWriter) -> str:
    """Write a sample; returns its topic."""
    made = message(sample.message)(**sample.fields)
    sink.write(sample.time_ns, sample.topic, made, publish_ns=sample.publish_ns)
    return sample.topic


def _options(settings: Settings) -> Options:
    if not ROBOT.fullmatch(settings.robot):
        raise SettingError(f"--robot {settings.robot!r} cannot stand in a topic. Try: cf1")
    width_px, height_px = settings.width_px, settings.height_px
    if not 1 / RATE_MAX_HZ <= settings.rate_hz <= RATE_MAX_HZ:
        raise SettingError(f"--rate-hz {settings.rate_hz:g} must be over 0, from 1e-6 to 1e6")
    if any(side is not None and not 1 <= side <= SIDE_MAX_PX for side in (width_px, height_px)):
        raise SettingError(f"--width-px and --height-px must be over 0, {SIDE_MAX_PX} at most")
    if (width_px is None) != (height_px is None):
        raise SettingError("--width-px and --height-px go together. Give both, or neither")
    return Options(
        robot=settings.robot,
        names=_names(settings.names),
        rate_hz=settings.rate_hz,
        labels=settings.labels,
        camera=None if settings.camera is None else camera_named(settings.camera),
        size_px=None if width_px is None or height_px is None else (width_px, height_px),
        raw=settings.raw,
        columns=settings.columns,
    )


def _names(text: str | None) -> dict[str, str]:
    found = {}
    for part in text.split(",") if text else []:
        old, _, new = part.strip().partition("=")
        if not (old and ROBOT.fullmatch(new)):
            raise SettingError(f"--names {part.strip()!r} is not OLD=NEW. Try: 0=cf2,1=cf3")
        found[old] = new
    return found


def _sources(source: Path, settings: Settings) -> dict[Path, Path]:
    """What a folder holds that can be converted, by what is made of it."""
    if settings.to is not None:
        return {name.with_suffix(""): path for name, path in recordings_in(source).items()}
    refuse_pipes(source)
    found: dict[Path, Path] = {}
    for path in sorted(source.iterdir()) if source.is_dir() else [source]:
        try:
            if path.name.startswith(".") or not format_of(path, settings.source_kind):
                continue
        except SourceError as e:
            say(f"left out: {e}")
            continue
        name = Path(path.name if path.is_dir() else path.stem).with_suffix(".mcap")
        if (twin := found.setdefault(name, path)) is not path:
            raise SettingError(f"{twin} and {path} would both be {name}. Rename one")
    if not found:
        raise SourceError(
            f"nothing in {source} is of a known kind. If it is one source, name one recording: "
            "dmrl convert SOURCE OUT.mcap"
        )
    return found


DEFAULTS = Settings()


def command(
    source: Path,
    out: Path,
    /,
    *,
    settings: Flat[Settings] = DEFAULTS,
    workers: Workers = None,
    on: On = None,
    as_json: AsJson = False,
) -> None:
    """Convert a foreign file or folder into a recording, or a recording into files.

    Parameters
    ----------
    source
        A foreign file or folder: pictures, flight logs, dumps of a camera deck, ROS bags. With a
        folder as OUT, each thing in it is a source of its own.
    out
        Recording to write, NAME.mcap; with --to, a folder. Must not exist. Another name: the folder
        of recordings, one for each thing in SOURCE.
    workers
        Of a folder: sources at a time, at most. Without it, as many as there are cores. Changes
        no byte.
    as_json
        Print one JSON document in place of the table.
    """
    many = source.is_dir() and (settings.to is not None or out.suffix != ".mcap")
    if many or on is not None:
        over_folder(
            "convert",
            source,
            out if many else out.parent,
            settings,
            workers=workers,
            on=on,
            as_json=as_json,
            role="source",
            found=_sources(source, settings) if many else {Path(out.name): source},
        )
        return
    counts = run(source, out, settings)
    if as_json:
        print_json({"recording": str(out), "messages": counts})
        return
    print_table(str(out), ("topic", "rows" if settings.to else "messages"), list(counts.items()))
