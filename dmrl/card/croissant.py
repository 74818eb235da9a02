"""Describe a dataset in Croissant, the JSON-LD that search engines and loaders read.

Version 1.0 of MLCommons' vocabulary, https://docs.mlcommons.org/croissant/docs/croissant-spec.html.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from dmrl.card.describe import explain_column
from dmrl.card.templating import fill_template
from dmrl.datasets import Split, layout
from dmrl.guards.bounded_parsing import parse_json

CROISSANT_FILE = "croissant.json"
CONTEXT_FILE = "croissant_context.json"
"""The fixed beginning of the document: MLCommons' names of its keys."""
ENCODING_FORMATS = {True: "application/x-parquet", False: "application/vnd.apache.arrow.stream"}
"""Format of the shards, by whether they are Parquet, which Croissant's loaders read."""


def build_croissant(about: Mapping[str, Any]) -> str:
    """Build the JSON document of a dataset from the values of its card."""
    splits, title = about["splits"], about["title"]
    licences = about["facts"].licences if about["facts"] else {}
    context = (Path(__file__).parent / CONTEXT_FILE).read_text(encoding="utf-8")
    document: dict[str, Any] = {
        "@context": parse_json(context),
        "@type": "sc:Dataset",
        "name": title,
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "description": fill_template("croissant.txt", **about),
        "license": about["license_id"],
        "version": about["version"],
        "citeAs": fill_template("citation.bib", **about, key=_name_citation(title)),
        "creator": {"@type": "sc:Organization", "name": f"dmrl {about['made'].dmrl_version}"},
        "isBasedOn": [
            {"@type": "sc:CreativeWork", "name": name, "license": words}
            for name, words in sorted(licences.items())
        ],
        "distribution": [
            _describe_files(name, about["files"][name], parquet=about["parquet"]) for name in splits
        ],
        "recordSet": [_describe_rows(name, split) for name, split in splits.items()],
    }
    if about["published"]:
        document["datePublished"] = about["published"]
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def _name_citation(title: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")[:40] or "dataset"


def read_publication_date(folder: Path) -> str | None:
    """Return the date of publication in the document of a dataset; None without one."""
    try:
        found = parse_json((folder / CROISSANT_FILE).read_text(encoding="utf-8"))
        return str(found["datePublished"])
    except (OSError, ValueError, LookupError, TypeError):
        return None


def _describe_files(split: str, files: Sequence[str], *, parquet: bool) -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": f"{split}-shards",
        "name": f"{split}-shards",
        "description": f"Shards of the split {split}.",
        "encodingFormat": ENCODING_FORMATS[parquet],
        "includes": list(files),
    }


def _describe_rows(name: str, split: Split) -> dict[str, Any]:
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "description": f"The {len(split)} images of the split {name}.",
        "field": list(_iter_fields(name, split)),
    }


def _iter_fields(name: str, split: Split) -> Iterator[dict[str, Any]]:
    for column in split.table.schema:
        field = _describe_field(name, column.name, explain_column(column.name, split))
        if pa.types.is_list(column.type) and pa.types.is_struct(column.type.value_type):
            inner = list(_iter_peer_fields(name, column, split))
            yield field | {"repeated": True, "subField": inner}
            continue
        if pa.types.is_fixed_size_list(column.type):
            field["repeated"] = True
        path = "bytes" if column.name == layout.IMAGE else ""
        yield field | _describe_values(name, column.name, column, path)


def _describe_field(place: str, name: str, words: str) -> dict[str, Any]:
    return {"@type": "cr:Field", "@id": f"{place}/{name}", "name": name, "description": words}


def _describe_values(split: str, column: str, values: pa.Field, path: str) -> dict[str, Any]:
    """Describe the type of a column's values, and where they are."""
    source: dict[str, Any] = {"fileSet": {"@id": f"{split}-shards"}, "extract": {"column": column}}
    at = {"transform": {"jsonPath": path}} if path else {}
    return {"dataType": _name_data_type(values), "source": source | at}


def _iter_peer_fields(name: str, column: pa.Field, split: Split) -> Iterator[dict[str, Any]]:
    """Yield the fields of a column with several peers per row, each as a list."""
    for inner in column.type.value_type:
        words = explain_column(f"{column.name}.{inner.name}", split)
        field = _describe_field(f"{name}/{column.name}", inner.name, words)
        yield field | _describe_values(name, column.name, inner, inner.name)


def _name_data_type(column: pa.Field) -> str:
    """Return the schema.org type of a column; for nested columns, of the values inside."""
    if column.name in (layout.IMAGE, layout.PIXELS):
        return "sc:ImageObject" if column.name == layout.IMAGE else "sc:Text"
    inner = column.type
    while pa.types.is_list(inner) or pa.types.is_fixed_size_list(inner):
        inner = inner.value_type
    if pa.types.is_integer(inner):
        return "sc:Integer"
    return "sc:Float" if pa.types.is_floating(inner) else "sc:Text"
