"""Summarize a catalogue: recordings by camera and source of labels, and their errors."""

from collections import Counter
from collections.abc import Iterable
from typing import Any

import pyarrow as pa

from dmrl.html_report.html import table, text

MOST_WRONG = 12
"""Recordings that are listed with their errors, at most."""


def listed(name: str, catalogue: pa.Table) -> str:
    """Build the section of one catalogue, HTML."""
    return "".join(
        (
            f"<h3>{text(name)}</h3><p>{text(_total(catalogue))}</p>",
            table(("camera", "recordings", "images"), _cameras(catalogue["cameras"])),
            table(("camera", "labels from", "OK", "all"), _labels(catalogue["labels"])),
            table(("made by", "recordings"), _counted(catalogue["stage"])),
            _wrong(catalogue),
        )
    )


def _total(catalogue: pa.Table) -> str:
    hours = sum(s or 0.0 for s in catalogue["duration_s"].to_pylist()) / 3600
    size_gb = sum(catalogue["bytes"].to_pylist()) / 1e9
    unread = catalogue.num_rows - catalogue["error"].null_count
    errors = sum(bool(count) for count in catalogue["errors"].to_pylist())
    words = f"{catalogue.num_rows} recordings, {hours:.1f} h, {size_gb:.2f} GB"
    return f"{words}; {errors} with errors, {unread} cannot be read"


def _cameras(rows: pa.ChunkedArray) -> list[tuple[str, int, int]]:
    recordings: Counter[str] = Counter()
    images: Counter[str] = Counter()
    for one in _each(rows):
        recordings[one["camera"]] += 1
        images[one["camera"]] += one["images"]
    return [(camera, recordings[camera], images[camera]) for camera in sorted(recordings)]


def _labels(rows: pa.ChunkedArray) -> list[tuple[str, str, int, int]]:
    good: Counter[tuple[str, str]] = Counter()
    every: Counter[tuple[str, str]] = Counter()
    for one in _each(rows):
        key = one["camera"], one["source"]
        every[key] += one["count"]
        good[key] += one["count"] * (one["status"] == "OK")
    return [(*key, good[key], every[key]) for key in sorted(every)]


def _each(rows: pa.ChunkedArray) -> Iterable[dict[str, Any]]:
    return (one for some in rows.to_pylist() for one in some or ())


def _counted(column: pa.ChunkedArray) -> list[tuple[str, int]]:
    return Counter(value or "unknown" for value in column.to_pylist()).most_common()


def _wrong(catalogue: pa.Table) -> str:
    columns = (catalogue[name].to_pylist() for name in ("recording", "error", "findings"))
    found = []
    for name, error, findings in zip(*columns, strict=True):
        worst = [one["text"] for one in findings or () if one["level"] == "error"]
        if error or worst:
            found.append((name, error or worst[0]))
    return table(("recording", "error"), found[:MOST_WRONG]) if found else ""
