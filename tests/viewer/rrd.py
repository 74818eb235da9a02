"""Read the contents of an .rrd file."""

from collections import Counter
from operator import itemgetter
from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader


def count_rows(path: Path) -> dict[tuple[str, str], int]:
    """Return the number of rows by entity and archetype; static rows are counted apart."""
    rows: Counter[tuple[str, str]] = Counter()
    for chunk in RrdReader(path).stream():
        kinds = {n.partition(":")[0] for n in chunk.to_record_batch().schema.names if ":" in n}
        for kind in kinds:
            rows[str(chunk.entity_path), f"static {kind}" if chunk.is_static else kind] += (
                chunk.num_rows
            )
    return dict(rows)


def read_column(path: Path, entity: str, component: str) -> list[Any]:
    """Return the values of a component, row by row."""
    values: list[Any] = []
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if str(chunk.entity_path) == entity and component in batch.schema.names:
            values += batch[component].to_pylist()
    return values


def read_columns(path: Path) -> dict[tuple[str, str], list[Any]]:
    """Return log time and value of every row of every component, in the order of log time."""
    rows: dict[tuple[str, str], list[tuple[int, Any]]] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        times = [0] * chunk.num_rows
        if not chunk.is_static:
            times = batch["log_time"].cast("int64").to_pylist()
        for name in batch.schema.names:
            if ":" in name:
                values = zip(times, batch[name].to_pylist(), strict=True)
                rows.setdefault((str(chunk.entity_path), name), []).extend(values)
    return {key: sorted(found, key=itemgetter(0)) for key, found in rows.items()}


def read_panel_names(path: Path) -> set[str]:
    """Return the names of the views of the layout."""
    reader = RrdReader(path)
    names: set[str] = set()
    for chunk in reader.stream(store=reader.blueprints()[0]):
        batch = chunk.to_record_batch()
        if "ViewBlueprint:display_name" in batch.schema.names:
            names |= {name for (name,) in batch["ViewBlueprint:display_name"].to_pylist()}
    return names


def read_queries(path: Path) -> list[list[str]]:
    """Return the query of each view of the layout, line by line."""
    reader = RrdReader(path)
    found: list[list[str]] = []
    for chunk in reader.stream(store=reader.blueprints()[0]):
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name == "ViewContents:query":
                found += batch[name].to_pylist()
    return found
