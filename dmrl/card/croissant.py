"""Describe a dataset in Croissant, the JSON-LD that search engines and loaders read.

Version 1.0 of MLCommons' vocabulary, https://docs.mlcommons.org/croissant/docs/croissant-spec.html.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from dmrl.card.sections import COLUMN_MEANINGS
from dmrl.datasets import Split, layout
from dmrl.geometry.frames import STRIDE_PX
from dmrl.recording import Provenance

CROISSANT_FILE = "croissant.json"
CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
} | {
    name: f"cr:{name}"
    for name in (
        *("citeAs", "column", "equivalentProperty", "extract", "field", "fileObject"),
        *("fileProperty", "fileSet", "format", "includes", "isLiveDataset", "jsonPath", "key"),
        *("md5", "parentField", "path", "recordSet", "references", "regex", "repeated"),
        *("replace", "samplingRate", "separator", "source", "subField", "transform"),
    )
}
ENCODING_FORMATS = {
    "parquet": "application/x-parquet",
    "arrow": "application/vnd.apache.arrow.stream",
}


def build_croissant(
    splits: Mapping[str, Split],
    made: Provenance,
    *,
    title: str,
    license_id: str,
    licences: Mapping[str, str],
    files: Mapping[str, Sequence[Path]],
    parquet: bool,
) -> str:
    """Build the JSON document of a dataset.

    Parameters
    ----------
    splits
        By name.
    made
        Provenance of the dataset.
    title, license_id
        As on the card.
    licences
        Licences of the source files, by name of the file.
    files
        Shards of each split, relative to the document.
    parquet
        Shards are Parquet files, which Croissant's loaders read; else Arrow streams.
    """
    first = next(iter(splits.values()))
    height_px, width_px = first.image_shape
    document: dict[str, Any] = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "name": title,
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "description": f"{sum(map(len, splits.values()))} camera images of {width_px} x "
        f"{height_px} px with the pixel position and depth of the peer robots in them. "
        "Pixel-edge coordinates, metres along the optical axis, nanoseconds. See README.md.",
        "license": license_id,
        "creator": {"@type": "sc:Organization", "name": f"dmrl {made.dmrl_version}"},
        "isBasedOn": [
            {"@type": "sc:CreativeWork", "name": name, "license": words}
            for name, words in sorted(licences.items())
        ],
        "distribution": [_describe_files(name, files[name], parquet=parquet) for name in splits],
        "recordSet": [_describe_rows(name, split) for name, split in splits.items()],
    }
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def _describe_files(split: str, files: Sequence[Path], *, parquet: bool) -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": f"{split}-shards",
        "name": f"{split}-shards",
        "description": f"Shards of the split {split}.",
        "encodingFormat": ENCODING_FORMATS["parquet" if parquet else "arrow"],
        "includes": [file.as_posix() for file in files],
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
    height_px, width_px = split.image_shape
    sizes = {"height": height_px, "width": width_px, "stride": STRIDE_PX}
    for column in split.table.schema:
        words = COLUMN_MEANINGS.get(column.name, "").format(**sizes)
        field = _describe_field(f"{name}/{column.name}", column.name, words)
        if pa.types.is_list(column.type) and pa.types.is_struct(column.type.value_type):
            yield field | {
                "repeated": True,
                "subField": list(_iter_peer_fields(name, column, sizes)),
            }
            continue
        if pa.types.is_fixed_size_list(column.type):
            field["repeated"] = True
        path = "bytes" if column.name == layout.IMAGE else ""
        yield field | {
            "dataType": _name_data_type(column),
            "source": _describe_source(name, column.name, path),
        }


def _describe_field(place: str, name: str, words: str) -> dict[str, Any]:
    return {"@type": "cr:Field", "@id": place, "name": name, "description": words}


def _describe_source(split: str, column: str, path: str) -> dict[str, Any]:
    source: dict[str, Any] = {
        "fileSet": {"@id": f"{split}-shards"},
        "extract": {"column": column},
    }
    return source | ({"transform": {"jsonPath": path}} if path else {})


def _iter_peer_fields(
    split: str, column: pa.Field, sizes: Mapping[str, int]
) -> Iterator[dict[str, Any]]:
    """Yield the fields of a column with several peers per row, each as a list."""
    for inner in column.type.value_type:
        where = f"{column.name}.{inner.name}"
        field = _describe_field(f"{split}/{column.name}/{inner.name}", inner.name, "")
        field["description"] = COLUMN_MEANINGS.get(where, "").format(**sizes)
        yield field | {
            "dataType": _name_data_type(inner),
            "source": _describe_source(split, column.name, inner.name),
        }


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
