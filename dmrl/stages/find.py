"""``dmrl find``: recordings that a query is true of, from the table that `dmrl index` writes."""

from pathlib import Path
from typing import Annotated, Any

import pyarrow as pa
from cyclopts import Parameter

from dmrl.catalogue import open_catalogue
from dmrl.catalogue.query import find
from dmrl.terminal.arguments import AsJson
from dmrl.terminal.tables import print_json, print_line, print_table

HEADS = ("recording", "MB", "s", "messages", "cameras", "images", "labels", "findings", "made by")


def command(
    query: str,
    folder: Path = Path(),
    /,
    *,
    paths: Annotated[bool, Parameter(negative=())] = False,
    as_json: AsJson = False,
) -> None:
    """Find recordings by what they hold: what dmrl index wrote, asked in SQL.

    Parameters
    ----------
    query
        What is to be true, such as 'camera = "cf1" and ok_labels > 100'. docs/catalogue.md has
        the columns.
    folder
        Folder that was indexed. Without it, this one.
    paths
        Print their paths alone, a line each.
    as_json
        Print one JSON document in place of the table.
    """
    found = find(open_catalogue(folder), query)
    if as_json:
        print_json({"folder": str(folder), "recordings": found.to_pylist()})
    elif paths:
        for name in found["recording"].to_pylist():
            print_line(str(folder / name))
    else:
        print_table(f"{found.num_rows} recordings in {folder}", HEADS, rows(found))


def rows(found: pa.Table) -> list[tuple[Any, ...]]:
    """Rows of the table, a recording each."""
    return [
        (
            one["recording"],
            f"{one['bytes'] / 1e6:.1f}",
            one["duration_s"],
            one["messages"],
            ", ".join(camera["camera"] for camera in one["cameras"] or ()),
            sum(camera["images"] for camera in one["cameras"] or ()),
            _labels(one["labels"] or ()),
            one["error"] or _findings(one),
            one["stage"],
        )
        for one in found.to_pylist()
    ]


def _labels(counted: Any) -> str:
    """Labels by source, those that are OK of all."""
    by_source: dict[str, list[int]] = {}
    for one in counted:
        both = by_source.setdefault(one["source"], [0, 0])
        both[0] += one["count"] * (one["status"] == "OK")
        both[1] += one["count"]
    return ", ".join(f"{source} {ok} of {every}" for source, (ok, every) in by_source.items())


def _findings(one: Any) -> str:
    kinds = [kind for kind in ("error", "warning") if one[f"{kind}s"]]
    counts = {kind: one[f"{kind}s"] for kind in kinds}
    return ", ".join(f"{count} {kind}{'s' * (count > 1)}" for kind, count in counts.items())
