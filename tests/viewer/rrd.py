"""Contents of an .rrd file."""

from collections import Counter
from operator import itemgetter
from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader


def logged(path: Path) -> dict[tuple[str, str], int]:
    """Rows by entity and archetype; what is static counts as "static"."""
    rows: Counter[tuple[str, str]] = Counter()
    for chunk in RrdReader(path).stream():
        kinds = {n.partition(":")[0] for n in chunk.to_record_batch().schema.names if ":" in n}
        for kind in kinds:
            rows[str(chunk.entity_path), f"static {kind}" if chunk.is_static else kind] += (
                chunk.num_rows
            )
    return dict(rows)


def column(path: Path, entity: str, component: str) -> list[Any]:
    """Values of a component, row by row."""
    values: list[Any] = []
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if str(chunk.entity_path) == entity and component in batch.schema.names:
            values += batch[component].to_pylist()
    return values


def columns(path: Path) -> dict[tuple[str, str], list[Any]]:
    """Values of every component of every entity, by log time."""
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


def panels(path: Path) -> set[str]:
    """Names of the views of the layout."""
    reader = RrdReader(path)
    names: set[str] = set()
    for chunk in reader.stream(store=reader.blueprints()[0]):
        batch = chunk.to_record_batch()
        if "ViewBlueprint:display_name" in batch.schema.names:
            names |= {name for (name,) in batch["ViewBlueprint:display_name"].to_pylist()}
    return names


def queries(path: Path) -> list[list[str]]:
    """What each view of the layout shows, line by line."""
    reader = RrdReader(path)
    found: list[list[str]] = []
    for chunk in reader.stream(store=reader.blueprints()[0]):
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name == "ViewContents:query":
                found += batch[name].to_pylist()
    return found
