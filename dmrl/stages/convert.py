"""``dmrl convert``: foreign files and folders to a recording, and recordings to files.

A new format is one file in ``dmrl/formats`` with a ``FORMAT``.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter, validators

from dmrl.atomic_output import refuse_existing
from dmrl.errors import SettingError, SourceError
from dmrl.guards.paths import refuse_pipes
from dmrl.pipeline.batch import find_recordings
from dmrl.pipeline.stage_command import stage_command
from dmrl.terminal.arguments import Count, Strict
from dmrl.terminal.closing import Closing, Given
from dmrl.terminal.tables import print_table

if TYPE_CHECKING:
    from dmrl.formats.base import Options

DATASET_WRITERS = {
    "yolo": ("dmrl.exchange.detection_sets", "write_yolo"),
    "coco": ("dmrl.exchange.detection_sets", "write_coco"),
    "webdataset": ("dmrl.exchange.detection_sets", "write_webdataset"),
    "lerobot": ("dmrl.exchange.lerobot", "write_lerobot"),
}
"""Writers of datasets for other trainers, by ``--to``."""
BOX_SETTINGS = {"camera", "robot_width_m"}
ROBOT = re.compile(r"[A-Za-z0-9_-]+")
NEW_NAME = re.compile(r"[A-Za-z0-9_-]+|(/[A-Za-z0-9_-]+)+")

RATE_MAX_HZ = 1e6
SIDE_MAX_PX = 8192


@dataclass(frozen=True, slots=True)
class Settings:
    """Format of a source, and facts that it does not contain.

    Parameters
    ----------
    source_kind
        Format of SOURCE, as docs/sources.md names it. Guessed where it can be.
    robot
        Robot that carries the camera, or whose log it is.
    names
        Names of robots by those that the source has for them: 0=cf2,turtle_cap=turtle1. The
        numbers in logs are else cf0, cf1, ... ROS bags and MCAP: also robots or topics of dmrl by
        topics: /lab/odom=cf2,/image=/cf1/camera/image.
    rate_hz
        Images per second, where the source has no times.
    labels
        images: CSV file with labels. Without it, labels.csv in the folder, if there.
    camera
        Camera that took the images as they are stored: aideck, published, a TOML file, or a
        YAML, JSON or XML file of ROS, Kalibr or OpenCV.
        Without it, calibration.toml in the folder, if there.
    width_px
        images: crop to the middle and scale to this width. Needs the height too.
    height_px
        images: crop to the middle and scale to this height. Needs the width too.
    columns
        TOML file that describes the columns of a CSV file, or fields of topics of a bag or an MCAP
        file, with their units, frames and signs, or nanobench.
    raw
        images: grey images are as the AI-deck's colour sensor gave them; make them RGB.
    bits
        Significant bits of pixels of 16 bits: 2^bits - 1 becomes 255. 12 for the values of a 12-bit
        sensor.
    as_stored
        images: keep them as they are stored; --upright: turn them as their EXIF orientation says.
        Labels and camera are of such images. Without either, images with neither are turned.
    robot_width_m
        Width of the robots, metres: labels without depth get one from the width of their box.
        Needs the camera.
    unlabelled
        yolo: images without a label file are not labelled. Without it, they show nobody.
    strict
        End with an error if anything of the source cannot be used. Without it, such things are left
        out and counted.
    to
        The other way: SOURCE is a recording, OUT a folder of tables (csv, parquet) or a ROS 2
        bag (ros2); or SOURCE is a dataset, OUT a folder for another trainer (yolo, coco, lerobot,
        webdataset).
    """

    source_kind: Annotated[str | None, Parameter(name="--from")] = None
    robot: str = "cf1"
    names: str | None = None
    rate_hz: Annotated[float, Parameter(validator=validators.Number(gt=0))] = 10.0
    labels: Path | None = None
    camera: Path | None = None
    width_px: Count | None = None
    height_px: Count | None = None
    columns: Path | None = None
    raw: Annotated[bool, Parameter(negative=())] = False
    bits: Annotated[int, Parameter(validator=validators.Number(gte=9, lte=16))] = 16
    as_stored: Annotated[bool | None, Parameter(negative="--upright")] = None
    robot_width_m: Annotated[float | None, Parameter(validator=validators.Number(gt=0))] = None
    unlabelled: Annotated[bool, Parameter(negative=())] = False
    strict: Strict = False
    to: Literal["csv", "parquet", "ros2", "yolo", "coco", "lerobot", "webdataset"] | None = None


def run(source: Path, out: Path, settings: Settings) -> dict[str, int]:
    """Convert a foreign file or folder into a recording, or a recording into files.

    Parameters
    ----------
    source
        A foreign file or folder: images, flight logs, dumps of a camera deck, ROS bags. If OUT is a
        folder, each file or folder in SOURCE is a source of its own.
    out
        Recording to write. Must not exist. If its name does not end in .mcap, a folder is written,
        with a recording for each source in SOURCE. With --to, a folder of files.
    settings
        See `Settings`.

    Returns
    -------
    dict
        Messages per topic of the recording, or rows of the tables.

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
    if settings.to is not None:
        _refuse_source_settings(settings)
    if settings.to in DATASET_WRITERS:
        return _export_dataset(source, out, settings)
    if settings.to == "ros2":
        from dmrl.exchange.ros2 import write_bag

        return write_bag(source, out)
    if settings.to is not None:
        from dmrl.exchange.csv_parquet import write_tables

        return write_tables(source, out, "csv" if settings.to == "csv" else "parquet")
    from dmrl.ingest.foreign_source import record_source

    kind = settings.source_kind or ("columns" if settings.columns else None)
    files = (settings.labels, settings.camera, settings.columns)
    options = _to_options(settings)
    return record_source(source, out, kind, options, settings=settings, files=files)


def _export_dataset(source: Path, out: Path, settings: Settings) -> dict[str, int]:
    """Write a dataset for other trainers; return images by split."""
    from dmrl.atomic_output import atomic_folder
    from dmrl.datasets import open_dataset
    from dmrl.exchange.dataset_rows import BoxOptions, ExportRows
    from dmrl.geometry.camera_file import find_camera
    from dmrl.recording import build_provenance

    camera = None if settings.camera is None else find_camera(settings.camera)
    options = BoxOptions(_parse_names(settings.names), settings.robot_width_m, camera)
    rows = ExportRows(open_dataset(source), options)
    rows.check_options()
    made = build_provenance("convert", settings, (source,), libraries=("pyarrow", "pillow"))
    module, name = DATASET_WRITERS[str(settings.to)]
    write = getattr(import_module(module), name)
    with atomic_folder(out) as folder:
        counts: dict[str, int] = write(rows, folder)
        if not counts:
            raise SourceError(f"{source} has no image that --to {settings.to} can hold")
        made.write(folder)
    return counts


def _refuse_source_settings(settings: Settings) -> None:
    """Raise SettingError if a setting describes a foreign source, but SOURCE is none."""
    default = Settings()
    used = {"to", "strict"} | (BOX_SETTINGS if settings.to in ("yolo", "coco") else set())
    used |= {"names"} if settings.to in DATASET_WRITERS else set()
    for name in (one.name for one in fields(Settings) if one.name not in used):
        if getattr(settings, name) != getattr(default, name):
            flag = "--from" if name == "source_kind" else f"--{name.replace('_', '-')}"
            raise SettingError(f"{flag} has no effect with --to {settings.to}. Leave it out")


def _to_options(settings: Settings) -> "Options":
    """Return the options of a format.

    Raises
    ------
    SettingError
        If a setting is out of range.
    """
    from dmrl.formats.base import Options
    from dmrl.geometry.camera_file import find_camera

    if not ROBOT.fullmatch(settings.robot):
        raise SettingError(f"--robot {settings.robot!r} cannot stand in a topic. Try: cf1")
    width_px, height_px = settings.width_px, settings.height_px
    if not 1 / RATE_MAX_HZ <= settings.rate_hz <= RATE_MAX_HZ:
        raise SettingError(f"--rate-hz {settings.rate_hz:g} must be over 0, from 1e-6 to 1e6")
    if any(side is not None and not 1 <= side <= SIDE_MAX_PX for side in (width_px, height_px)):
        raise SettingError(f"--width-px and --height-px must be over 0, {SIDE_MAX_PX} at most")
    if (width_px is None) != (height_px is None):
        raise SettingError("--width-px and --height-px go together. Give both, or neither")
    given: dict[str, Any] = {f.name: getattr(settings, f.name, None) for f in fields(Options)}
    given["names"] = _parse_names(settings.names)
    given["camera"] = None if settings.camera is None else find_camera(settings.camera)
    given["size_px"] = None if None in (width_px, height_px) else (width_px, height_px)
    return Options(**given)


def _parse_names(text: str | None) -> dict[str, str]:
    """Return the robot, or topic, of every name or topic in ``OLD=NEW,...``."""
    found = {}
    for part in text.split(",") if text else []:
        old, _, new = part.strip().partition("=")
        if not (old and NEW_NAME.fullmatch(new)) or ("/" in new and "/" not in old):
            raise SettingError(f"--names {part.strip()!r} is not OLD=NEW. Try: 0=cf2,1=cf3")
        found[old] = new
    return found


def _find_many(given: Given) -> Mapping[Path, Path] | None:
    """Return the sources in a folder, by the names of the outputs; None: it is one source."""
    source, settings = given.source, given.settings
    if settings.to in DATASET_WRITERS:
        return None
    if not (source.is_dir() and (settings.to is not None or given.out.suffix != ".mcap")):
        return None
    if settings.to is not None:
        return {name.with_suffix(""): path for name, path in find_recordings(source).items()}
    from dmrl.ingest.foreign_source import find_sources

    return find_sources(source, settings.source_kind)


def _show(counts: dict[str, int], given: Given) -> None:
    to = given.settings.to
    split = to in DATASET_WRITERS
    columns = ("split", "images") if split else ("topic", "rows" if to else "messages")
    print_table(str(given.out), columns, list(counts.items()))


command = stage_command(
    run,
    Closing(show=_show, path_key="recording", result_key="messages"),
    folder="source",
    find=_find_many,
)
