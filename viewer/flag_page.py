"""Write the label desk: one offline page to check, correct and flag labels of images.

The page is ``desk/desk.html`` with the images and labels of a dataset or of recordings. It saves
corrections as recordings of source ``hand`` and flags as a CSV file; ``dmrl dataset`` reads both.
"""

import json
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from hashlib import sha256
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl import topics
from dmrl.atomic_output import atomic_file
from dmrl.colours import RGB
from dmrl.datasets import layout
from dmrl.datasets.writing.exclusions import REQUIRED_COLUMNS
from dmrl.errors import DmrlError, SettingError, to_one_line
from dmrl.images.codec import crop_and_scale, decode, encode_jpeg
from dmrl.messages import (
    STATUS_OK,
    find_descriptor,
    message_class,
    serialize_schema,
    to_status_name,
)
from dmrl.recording import Provenance, build_input, read, read_summary
from dmrl.recording.provenance import METADATA_NAME, Input
from dmrl.recording.provenance_inputs import read_provenance
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import track
from dmrl.viewer.browse import RankedRows, image_size, rank_dataset
from dmrl.viewer.content.faint_detections import DETECTION_FIELDS, GRID_FIELDS, find_faint
from dmrl.viewer.label_suspicion import NEAR_PX, score_suspicion
from dmrl.viewer.settings import Settings

WIDE_PX, QUALITY = 320, 75
"""Width of an image on the page, pixels, and quality of its JPEG."""
DEFAULT_THRESHOLD = 0.5
"""Threshold of detections that name none."""
LABEL_FIELDS = [f.name for f in find_descriptor("PeerLabel").fields]
STATUSES = {number: to_status_name(number) for number in range(3)}


@dataclass(slots=True)
class DeskRow:
    """An image on the desk.

    Parameters
    ----------
    source, robot, time_ns
        Recording, robot and log time of the image.
    image
        JPEG as the address of an image.
    labels, found
        Fields of its PeerLabel and Detection messages.
    faint
        Detections that only its confidence map holds; they are not shown.
    error_px
        Error of the worst label; None if unknown.
    suspicion
        Suspicion that a label is wrong or missing, 0 to 1.
    """

    source: str
    robot: str
    time_ns: int
    image: str
    labels: list[dict[str, Any]]
    found: list[dict[str, Any]] = field(default_factory=list)
    faint: list[dict[str, float]] = field(default_factory=list)
    error_px: float | None = None
    suspicion: float = 0.0


@dataclass(frozen=True, slots=True)
class Desk:
    """Rows of a desk, the size of its images, and what its recordings were made from."""

    title: str
    size_px: tuple[int, int]
    rows: list[DeskRow]
    inputs: Mapping[str, Input]
    threshold: float = DEFAULT_THRESHOLD


def write_flag_page(paths: Sequence[Path], out: Path, settings: Settings) -> int:
    """Write the label desk of a dataset or of recordings, and return the number of images.

    Parameters
    ----------
    paths
        A dataset, and optionally recordings with a model's detections; or recordings with images
        and labels, and detections if they have any.
    out
        Page to write. Must not exist.
    settings
        Selects the rows and their number.

    Raises
    ------
    DatasetError
        If the dataset or the rows do not exist.
    SettingError
        If no recording has images.
    OutputError
        If ``out`` exists or cannot be written.
    """
    found = any(path.is_dir() for path in paths)
    desk = _read_dataset(paths, settings) if found else _read_recordings(paths, settings)
    seen = [(row.labels, [*row.found, *row.faint]) for row in desk.rows]
    scores = score_suspicion(seen, desk.size_px)
    for row, suspicion in zip(desk.rows, scores.tolist(), strict=True):
        row.suspicion = suspicion
    with atomic_file(out) as partial:
        partial.write_text(build_page(desk), encoding="utf-8")
    return len(desk.rows)


def build_page(desk: Desk) -> str:
    """Build the page, HTML; names from files are escaped."""
    parts = {name: _read_text(name) for name in ("desk.html", "desk.css", "desk.js")}
    script = parts["desk.js"].strip()
    provenance = {
        name: Provenance("desk", {"page": desk.title}, inputs=(source,)).to_metadata()
        for name, source in desk.inputs.items()
    }
    data = {
        "size": desk.size_px,
        "threshold": desk.threshold,
        "near_px": NEAR_PX,
        "colours": {name: f"rgb{rgb}" for name, rgb in RGB.items()},
        "ok": STATUS_OK,
        "statuses": STATUSES,
        "peers": sorted({label["peer"] for row in desk.rows for label in row.labels}),
        "fields": [_describe_field(one) for one in find_descriptor("PeerLabel").fields],
        "schema_name": find_descriptor("PeerLabels").full_name,
        "schema": b64encode(serialize_schema("PeerLabels")).decode(),
        "metadata_name": METADATA_NAME,
        "provenance": provenance,
        "flag_columns": REQUIRED_COLUMNS,
        "rows": [
            asdict(replace(row, faint=[])) | {"time_ns": str(row.time_ns)} for row in desk.rows
        ],
    }
    # A closing tag inside a text would end the script that holds the data.
    plain = json.dumps(_without_infinities(data)).replace("<", "\\u003c")
    return Template(parts["desk.html"]).substitute(
        title=escape(to_one_line(desk.title)),
        style=parts["desk.css"],
        data=plain,
        script=script,
        hash=b64encode(sha256(script.encode()).digest()).decode(),
    )


def _read_text(name: str) -> str:
    return files("dmrl.viewer").joinpath("desk", name).read_text(encoding="utf-8")


def _describe_field(one: Any) -> tuple[str, int, str]:
    """Return name, number and kind of a field, as the page encodes it."""
    kind = {one.TYPE_STRING: "string", one.TYPE_DOUBLE: "double"}.get(one.type, "number")
    return one.name, one.number, "doubles" if one.is_repeated else kind


def _without_infinities(value: Any) -> Any:
    """Return JSON values; an infinite or unknown number becomes None."""
    if isinstance(value, Mapping):
        return {str(key): _without_infinities(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_without_infinities(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _read_dataset(paths: Sequence[Path], settings: Settings) -> Desk:
    folder, ranked = rank_dataset(paths, settings)
    size_px = image_size(ranked.rows)
    made = read_provenance(folder)
    inputs = {source.name: source for source in (made.inputs if made else ())}
    threshold, found, faint = _read_found(ranked)
    rows = []
    for k in track(range(len(ranked.rows)), "Drawing"):
        row = ranked.rows.slice(k, 1).to_pylist()[0]
        error = float(ranked.error_px[k])
        rows.append(
            DeskRow(
                row["source"],
                row["robot"],
                row["log_time"],
                _to_address(_pixels(row, *size_px), size_px),
                [_fill_label(peer) for peer in row["peers"]],
                found[k],
                faint[k],
                None if np.isnan(error) else min(error, 1e9),
            )
        )
    named = {name: inputs.get(name, Input(name, "")) for name in {row.source for row in rows}}
    return Desk(folder.name, size_px, rows, named, threshold)


def _read_found(
    ranked: RankedRows,
) -> tuple[float, list[list[dict[str, Any]]], list[list[dict[str, float]]]]:
    """Return the threshold of a model, its detections of each row, and those of its map alone."""
    faint: list[list[dict[str, float]]] = [[] for _ in range(len(ranked.rows))]
    if ranked.found is None:
        return DEFAULT_THRESHOLD, [[] for _ in faint], faint
    batch = ranked.found.to_detections()
    threshold = max(batch["threshold"].to_pylist(), default=0.0) or DEFAULT_THRESHOLD
    found = batch["detections"].to_pylist()
    for row, grid in ranked.found.iter_maps():
        faint[row] = find_faint(grid.to_pylist()[0], found[row])
    return threshold, found, faint


def _fill_label(peer: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a PeerLabel from a dataset's peer."""
    label = {name: peer[name] for name in LABEL_FIELDS if name in peer}
    return label | {"status": next(n for n, name in STATUSES.items() if name == peer["status"])}


def _read_recordings(paths: Sequence[Path], settings: Settings) -> Desk:
    rows: list[DeskRow] = []
    size_px, threshold = (0, 0), DEFAULT_THRESHOLD
    for path in paths:
        robots = topics.list_robots(list(read_summary(path).topics))
        for robot in robots if settings.robot is None else [settings.robot]:
            for row, told, size in track(_iter_rows(path, robot), f"Reading {path.name}"):
                size_px, threshold = size, told or threshold
                rows.append(row)
    if not rows:
        raise SettingError(f"{paths[0]} has no images. Name a dataset or a recording with images")
    rows = rows[:: settings.every][: settings.most]
    inputs = {path.name: build_input(path) for path in paths}
    return Desk(" + ".join(path.stem for path in paths), size_px, rows, inputs, threshold)


def _iter_rows(path: Path, robot: str) -> Iterator[tuple[DeskRow, float, tuple[int, int]]]:
    """Yield the images of a robot, the threshold of their detections, and their size."""
    kinds = {topics.LABELS: "PeerLabels", topics.DETECTIONS: "Detections", topics.GRID: "GridMap"}
    present = read_summary(path).topics
    messages: list[tuple[dict[int, Any], Any]] = []
    for topic, kind in ((of(robot), kind) for of, kind in kinds.items()):
        told = read(path, topic) if topic in present else ()
        messages.append(({one.time_ns: one.message for one in told}, message_class(kind)()))
    for stamped in read(path, topics.CAMERA_IMAGE(robot)):
        labels, found, grid = (held.get(stamped.time_ns, none) for held, none in messages)
        try:
            pixels = decode(stamped.message.data, f"{path}: image at {stamped.time_ns} ns")
        except DmrlError as e:
            leave_out("images that cannot be decoded", e)
            continue
        high, wide = pixels.shape[:2]
        detections = [_message_fields(one, DETECTION_FIELDS) for one in found.detections]
        row = DeskRow(
            path.name,
            robot,
            stamped.time_ns,
            _to_address(pixels, (wide, high)),
            [_message_fields(one, LABEL_FIELDS) for one in labels.peers],
            detections,
            find_faint(_message_fields(grid, GRID_FIELDS), detections),
        )
        yield row, float(found.threshold), (wide, high)


def _message_fields(message: Any, names: Sequence[str]) -> dict[str, Any]:
    values = {name: getattr(message, name) for name in names}
    return {k: list(v) if k == "box_px" else v for k, v in values.items()}


def _to_address(pixels: NDArray[np.uint8], size_px: tuple[int, int]) -> str:
    """Return an image, scaled, as the address that a page can hold."""
    wide, high = size_px
    size = (min(WIDE_PX, wide), max(1, round(high * min(WIDE_PX, wide) / wide)))
    small = encode_jpeg(crop_and_scale(pixels, (0, 0, wide, high), *size), QUALITY)
    return f"data:image/jpeg;base64,{b64encode(small).decode()}"


def _pixels(row: Mapping[str, Any], wide: int, high: int) -> NDArray[np.uint8]:
    if layout.PIXELS in row:
        return np.frombuffer(row[layout.PIXELS], np.uint8).reshape(high, wide, 3)
    return decode(row[layout.IMAGE]["bytes"], "a row's image")
