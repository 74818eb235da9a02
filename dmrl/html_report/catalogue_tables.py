"""Summarize a catalogue: recordings by camera and source of labels, and their errors."""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

import pyarrow as pa

from dmrl.html_report.blocks import Block, Heading, Table, Text

MAX_LISTED = 12
"""Recordings that are listed with their errors or causes, at most."""


def build_catalogue_section(catalogues: Mapping[str, pa.Table]) -> list[Block]:
    """Build the section of all catalogues."""
    return [block for one in catalogues.items() for block in _show_catalogue(*one)]


def _show_catalogue(name: str, catalogue: pa.Table) -> list[Block]:
    listed = {"error": _list_errors(catalogue), "causes": _list_causes(catalogue)}
    return [
        Heading(name),
        Text(_summarize(catalogue)),
        Table(("camera", "recordings", "images"), _count_by_camera(catalogue["cameras"])),
        Table(("camera", "labels from", "OK", "all"), _count_labels(catalogue["labels"])),
        Table(("made by", "recordings"), _count_values(catalogue["stage"])),
        *(block for what, rows in listed.items() for block in _show_first(what, rows)),
    ]


def _show_first(what: str, rows: list[tuple[str, str]]) -> Iterable[Block]:
    """Yield the table of the first rows, and how many more there are."""
    if rows:
        yield Table(("recording", what), rows[:MAX_LISTED])
    if len(rows) > MAX_LISTED:
        yield Text(f"and {len(rows) - MAX_LISTED} more recordings: dmrl find")


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


def _list_causes(catalogue: pa.Table) -> list[tuple[str, str]]:
    """List the sensor errors that `dmrl label` found, worst recordings first."""
    found = []
    columns = (catalogue[name].to_pylist() for name in ("recording", "findings"))
    for name, findings in zip(*columns, strict=True):
        causes = [one["text"] for one in findings or () if one["topic"].endswith("/causes")]
        found += [(len(causes), name, "; ".join(causes))] if causes else []
    return [(name, text) for _, name, text in sorted(found, key=lambda one: -one[0])]


def _list_errors(catalogue: pa.Table) -> list[tuple[str, str]]:
    columns = (catalogue[name].to_pylist() for name in ("recording", "error", "findings"))
    found = []
    for name, error, findings in zip(*columns, strict=True):
        worst = [one["text"] for one in findings or () if one["level"] == "error"]
        if error or worst:
            found.append((name, error or worst[0]))
    return found
