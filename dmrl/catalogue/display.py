"""Rows of a catalogue as a table for people."""

from typing import Any

import pyarrow as pa

HEADS = ("recording", "MB", "s", "messages", "cameras", "images", "labels", "findings", "made by")


def display_rows(found: pa.Table) -> list[tuple[Any, ...]]:
    """Return a row of `HEADS` for each recording that was found."""
    return [
        (
            one["recording"],
            f"{one['bytes'] / 1e6:.1f}",
            one["duration_s"],
            one["messages"],
            ", ".join(camera["camera"] for camera in one["cameras"] or ()),
            sum(camera["images"] for camera in one["cameras"] or ()),
            _label_counts(one["labels"] or ()),
            one["error"] or _finding_counts(one),
            one["stage"],
        )
        for one in found.to_pylist()
    ]


def _label_counts(counted: Any) -> str:
    """Return the number of labels by source: those that are OK, of all."""
    by_source: dict[str, list[int]] = {}
    for one in counted:
        both = by_source.setdefault(one["source"], [0, 0])
        both[0] += one["count"] * (one["status"] == "OK")
        both[1] += one["count"]
    return ", ".join(f"{source} {ok} of {every}" for source, (ok, every) in by_source.items())


def _finding_counts(one: Any) -> str:
    kinds = [kind for kind in ("error", "warning") if one[f"{kind}s"]]
    counts = {kind: one[f"{kind}s"] for kind in kinds}
    return ", ".join(f"{count} {kind}{'s' * (count > 1)}" for kind, count in counts.items())
