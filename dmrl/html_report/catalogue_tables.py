"""Summarize a catalogue: recordings by camera and source of labels, and their errors."""

from collections import Counter
from collections.abc import Iterable
from typing import Any

import pyarrow as pa

from dmrl.html_report.html import build_table, to_html_text

MAX_LISTED_ERRORS = 12
"""Recordings that are listed with their errors, at most."""


def build_catalogue_section(name: str, catalogue: pa.Table) -> str:
    """Build the section of one catalogue, HTML."""
    return "".join(
        (
            f"<h3>{to_html_text(name)}</h3><p>{to_html_text(_summarize(catalogue))}</p>",
            build_table(("camera", "recordings", "images"), _count_by_camera(catalogue["cameras"])),
            build_table(("camera", "labels from", "OK", "all"), _count_labels(catalogue["labels"])),
            build_table(("made by", "recordings"), _count_values(catalogue["stage"])),
            _list_errors(catalogue),
            _list_causes(catalogue),
        )
    )


def _summarize(catalogue: pa.Table) -> str:
    hours = sum(s or 0.0 for s in catalogue["duration_s"].to_pylist()) / 3600
    size_gb = sum(catalogue["bytes"].to_pylist()) / 1e9
    unread = catalogue.num_rows - catalogue["error"].null_count
    errors = sum(bool(count) for count in catalogue["errors"].to_pylist())
    words = f"{catalogue.num_rows} recordings, {hours:.1f} h, {size_gb:.2f} GB"
    return f"{words}; {errors} with errors, {unread} cannot be read"


def _count_by_camera(rows: pa.ChunkedArray) -> list[tuple[str, int, int]]:
    recordings: Counter[str] = Counter()
    images: Counter[str] = Counter()
    for one in _flatten_rows(rows):
        recordings[one["camera"]] += 1
        images[one["camera"]] += one["images"]
    return [(camera, recordings[camera], images[camera]) for camera in sorted(recordings)]


def _count_labels(rows: pa.ChunkedArray) -> list[tuple[str, str, int, int]]:
    good: Counter[tuple[str, str]] = Counter()
    every: Counter[tuple[str, str]] = Counter()
    for one in _flatten_rows(rows):
        key = one["camera"], one["source"]
        every[key] += one["count"]
        good[key] += one["count"] * (one["status"] == "OK")
    return [(*key, good[key], every[key]) for key in sorted(every)]


def _flatten_rows(rows: pa.ChunkedArray) -> Iterable[dict[str, Any]]:
    return (one for some in rows.to_pylist() for one in some or ())


def _count_values(column: pa.ChunkedArray) -> list[tuple[str, int]]:
    return Counter(value or "unknown" for value in column.to_pylist()).most_common()


def _list_causes(catalogue: pa.Table) -> str:
    """Return a table of the sensor errors that `dmrl label` found, worst recordings first."""
    found = []
    columns = (catalogue[name].to_pylist() for name in ("recording", "findings"))
    for name, findings in zip(*columns, strict=True):
        causes = [one["text"] for one in findings or () if one["topic"].endswith("/causes")]
        found += [(len(causes), name, "; ".join(causes))] if causes else []
    rows = [(name, text) for _, name, text in sorted(found, key=lambda one: -one[0])]
    return build_table(("recording", "causes"), rows[:MAX_LISTED_ERRORS]) if rows else ""


def _list_errors(catalogue: pa.Table) -> str:
    columns = (catalogue[name].to_pylist() for name in ("recording", "error", "findings"))
    found = []
    for name, error, findings in zip(*columns, strict=True):
        worst = [one["text"] for one in findings or () if one["level"] == "error"]
        if error or worst:
            found.append((name, error or worst[0]))
    return build_table(("recording", "error"), found[:MAX_LISTED_ERRORS]) if found else ""
