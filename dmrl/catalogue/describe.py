"""Description of one recording as a row of the catalogue."""

import json
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Any

import pyarrow.compute as pc

from dmrl import topics
from dmrl.messages import to_status_name
from dmrl.recording import LoadedRecording, Provenance, check
from dmrl.recording.provenance_inputs import hash_file

Row = dict[str, Any]
"""Values of `table.COLUMNS` by name, without those of the file system."""


def describe(path: Path) -> Row:
    """Describe a recording: its contents, its provenance and the findings of `dmrl check`.

    Parameters
    ----------
    path
        A recording.

    Raises
    ------
    RecordingError
        If it is not a complete recording.
    """
    findings = check(path)
    held = LoadedRecording(path, topics.LABELS, topics.CALIBRATION)
    found = held.summary
    return {
        "sha256": hash_file(path),
        "start_ns": found.start_ns,
        "duration_s": (found.end_ns - found.start_ns) / 1e9,
        "messages": found.count,
        "robots": _list_robots(held),
        "topics": [
            {"topic": topic, "message": info.schema, "count": info.count}
            for topic, info in held.topics.items()
        ],
        "cameras": list(_iter_cameras(held)),
        "labels": list(_iter_labels(held)),
        "errors": sum(one.level == "error" for one in findings),
        "warnings": sum(one.level == "warning" for one in findings),
        "findings": [asdict(one) for one in findings],
        **_provenance_columns(found.provenance),
    }


def unreadable_row(why: str) -> Row:
    """Return the row of an unreadable recording."""
    return {"error": why}


def _list_robots(held: LoadedRecording) -> list[str]:
    """List the robots in dmrl's topics."""
    rows = ((topics.find_topic(topic), topic) for topic in held.topics)
    named = (topics.parse_topic(row.pattern, topic) for row, topic in rows if row is not None)
    return sorted({found["robot"] for found in named if found and "robot" in found})


def _iter_cameras(held: LoadedRecording) -> Iterator[Row]:
    """Yield the image count, size and focal length of every camera."""
    for camera in topics.list_robots(list(held.topics)):
        row = {"camera": camera, "images": held.topics[topics.CAMERA_IMAGE(camera)].count}
        if topics.CALIBRATION(camera) in held.topics:
            for one in islice(held.iter_messages(topics.CALIBRATION(camera)), 1):
                said = one.message
                row |= {"width_px": said.width, "height_px": said.height}
                known = len(said.K) == 9 and math.isfinite(said.K[0])
                row["focal_px"] = said.K[0] if known else None
        yield row


def _iter_labels(held: LoadedRecording) -> Iterator[Row]:
    """Yield the label counts by camera, source and status."""
    for topic in held.topics:
        if not (named := topics.parse_topic(topics.LABELS, topic)):
            continue
        peers = held.get_table(topic, ["peers"])["peers"].combine_chunks().flatten()
        sources = pc.struct_field(peers, "source").to_pylist()
        statuses = pc.struct_field(peers, "status").to_pylist()
        counts = Counter(zip(sources, statuses, strict=True))
        for (source, status), count in sorted(counts.items()):
            row = {"camera": named["robot"], "source": source, "status": to_status_name(status)}
            yield {**row, "count": count}


def _provenance_columns(made: Provenance | None) -> Row:
    """Return the columns of the stage, inputs and settings that made a recording."""
    if made is None:
        return {}
    return {
        "stage": made.stage,
        "dmrl_version": made.dmrl_version,
        "settings": json.dumps(dict(made.settings), sort_keys=True, default=str),
        "inputs": [{"name": one.name, "sha256": one.sha256} for one in made.inputs],
    }
