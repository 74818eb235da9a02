"""``dmrl convert``: foreign files and folders to a recording.

A new format is one file in ``dmrl/formats`` and one row in ``KINDS``.
"""

import json
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter, validators

from dmrl.errors import SettingError, SourceError
from dmrl.formats import flight_csv, image_folder, locanet, uwb_tiers
from dmrl.formats.camera_toml import read_camera
from dmrl.formats.sample import Content
from dmrl.geometry import AIDECK, PUBLISHED_RENDER, Camera
from dmrl.messages import message
from dmrl.output import refuse_existing
from dmrl.progress import track
from dmrl.recording import SPLIT_METADATA, RecordingWriter, provenance
from dmrl.tables import print_json, print_table

CAMERAS = {"aideck": AIDECK, "published": PUBLISHED_RENDER}
ROBOT = re.compile(r"[A-Za-z0-9_-]+")

Positive = Annotated[int, Parameter(validator=validators.Number(gte=1))]


@dataclass(frozen=True, slots=True)
class Settings:
    """How a source becomes a recording.

    Parameters
    ----------
    source_kind
        What SOURCE is: locanet, csv, uwb-tiers or images. Guessed where it can be.
    robot
        Robot that carries the camera.
    rate_hz
        images: pictures per second, where their names are not times in nanoseconds.
    labels
        images: CSV file with labels. Without it, labels.csv in the folder, if there.
    camera
        images: camera that took the pictures as they are stored: aideck, published, or a
        TOML file. Without it, calibration.toml in the folder, if there.
    width_px
        images: crop to the middle and scale to this width. Needs the height too.
    height_px
        images: crop to the middle and scale to this height. Needs the width too.
    """

    source_kind: Annotated[str | None, Parameter(name="--from")] = None
    robot: str = "cf1"
    rate_hz: Annotated[float, Parameter(validator=validators.Number(gt=0))] = 10.0
    labels: Path | None = None
    camera: Path | None = None
    width_px: Positive | None = None
    height_px: Positive | None = None


@dataclass(frozen=True, slots=True)
class Kind:
    """One row of the table of formats: how to know it, how to read it."""

    recognises: Callable[[Path], bool]
    content: Callable[[Path, Settings], Content]


def _locanet(source: Path, settings: Settings) -> Content:
    return locanet.content(source, settings.robot)


def _images(source: Path, settings: Settings) -> Content:
    size_px = (settings.width_px, settings.height_px)
    if (size_px[0] is None) != (size_px[1] is None):
        raise SettingError("--width-px and --height-px go together. Give both, or neither")
    options = image_folder.Options(
        robot=settings.robot,
        rate_hz=settings.rate_hz,
        labels=settings.labels,
        camera=_camera(source, settings.camera),
        size_px=None if size_px[0] is None or size_px[1] is None else (size_px[0], size_px[1]),
    )
    content = image_folder.content(source, options)
    read = (path for path in (settings.labels, settings.camera) if path and path.is_file())
    return replace(content, inputs=tuple(read))


def _camera(source: Path, name: Path | None) -> Camera | None:
    if name is None:
        own = source / image_folder.CALIBRATION
        return read_camera(own) if own.is_file() else None
    return CAMERAS.get(str(name)) or read_camera(name)


# Looked at in this order: the published set is a folder of pictures too.
KINDS = {
    "locanet": Kind(locanet.recognises, _locanet),
    "csv": Kind(flight_csv.recognises, lambda source, _: flight_csv.content(source)),
    "uwb-tiers": Kind(uwb_tiers.recognises, lambda source, _: uwb_tiers.content(source)),
    "images": Kind(image_folder.recognises, _images),
}


def kind_of(source: Path, name: str | None) -> Kind:
    """The row of ``KINDS`` for a source.

    Parameters
    ----------
    source
        A file or folder.
    name
        Its kind; None: guess.

    Raises
    ------
    SourceError
        If there is no such source or kind, or none fits: lists the kinds.
    """
    known = ", ".join(KINDS)
    if not source.exists():
        raise SourceError(f"no file or folder {source}. Name one to convert")
    if name is None:
        for kind in KINDS.values():
            if kind.recognises(source):
                return kind
        raise SourceError(f"{source} looks like no kind that is known. Say --from: {known}")
    if name not in KINDS:
        near = get_close_matches(name, KINDS, n=1)
        hint = f"Did you mean {near[0]}? " if near else ""
        raise SourceError(f"--from {name}: no such kind. {hint}Kinds: {known}")
    return KINDS[name]


def run(source: Path, out: Path, settings: Settings) -> dict[str, int]:
    """Messages per topic of the recording written to ``out``.

    Parameters
    ----------
    source
        A foreign file or folder.
    out
        Recording to write. Must not exist.
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
    _check(settings)
    content = kind_of(source, settings.source_kind).content(source, settings)
    made = provenance("convert", settings, (source, *content.inputs), libraries=("pillow", "numpy"))
    counts: Counter[str] = Counter()
    with RecordingWriter(out, made) as sink:
        if content.split:
            split = {name: json.dumps(times) for name, times in content.split.items()}
            sink.add_metadata(SPLIT_METADATA, split)
        for sample in track(content.samples, "Converting", content.total):
            sink.write(sample.time_ns, sample.topic, message(sample.message)(**sample.fields))
            counts[sample.topic] += 1
    return dict(sorted(counts.items()))


def _check(settings: Settings) -> None:
    if not ROBOT.fullmatch(settings.robot):
        raise SettingError(f"--robot {settings.robot!r} cannot stand in a topic. Try: cf1")
    sizes = [size for size in (settings.width_px, settings.height_px) if size is not None]
    if settings.rate_hz <= 0 or min(sizes, default=1) < 1:
        raise SettingError("--rate-hz, --width-px and --height-px must be over 0. Raise them")


DEFAULTS = Settings()


def command(
    source: Path,
    out: Path,
    /,
    *,
    settings: Annotated[Settings, Parameter(name="*")] = DEFAULTS,
    as_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> None:
    """Convert SOURCE, a foreign file or folder, into a recording.

    Parameters
    ----------
    source
        A folder of the published synthetic set, a folder of flight logs, ranges with motion
        capture, or a folder of pictures.
    out
        Recording to write. Must not exist.
    as_json
        Print one JSON document in place of the table.
    """
    counts = run(source, out, settings)
    if as_json:
        print_json({"recording": str(out), "messages": counts})
        return
    print_table(str(out), ("topic", "messages"), list(counts.items()))
