"""Metadata files for the Hugging Face ``datasets`` library: JSON beside the shards."""

import hashlib
import json
from pathlib import Path
from typing import Any

import pyarrow as pa

from dmrl.atomic_output import replace_file
from dmrl.datasets import layout
from dmrl.datasets.manifest import Manifest
from dmrl.datasets.shards import load_schema
from dmrl.guards.safe_names import safe_join


def write_metadata(
    folder: Path, manifest: Manifest, *, fingerprint: str, about: dict[str, str]
) -> None:
    """Write ``state.json`` and ``dataset_info.json`` of each split, then ``dataset_dict.json``.

    Parameters
    ----------
    folder
        Folder of the dataset. A Parquet dataset needs no such files and gets none.
    manifest
        Its manifest.
    fingerprint
        Identifies the content; ``datasets`` uses it as the key of its cache.
    about
        ``description`` and ``license`` for dataset_info.json.
    """
    if manifest.parquet:
        return
    for name, shards in manifest.splits.items():
        place = safe_join(folder, name, "a split")
        schema = load_schema(manifest.shard_path(folder, name, shards[0]))
        write_json_if_changed(place / "state.json", _build_state(manifest, name, fingerprint))
        write_json_if_changed(
            place / "dataset_info.json", _build_info(manifest, name, schema, about)
        )
    write_json_if_changed(folder / "dataset_dict.json", {"splits": list(manifest.splits)})


def write_json_if_changed(path: Path, document: Any) -> None:
    """Write a JSON file atomically, unless it has this content already."""
    text = layout.format_json(document)
    if not (path.is_file() and path.read_text(encoding="utf-8") == text):
        with replace_file(path) as partial:
            partial.write_text(text, encoding="utf-8")


def hash_document(document: Any) -> str:
    """Return the SHA-256 hash of a JSON document."""
    return hashlib.sha256(json.dumps(document).encode()).hexdigest()


def _build_state(manifest: Manifest, split: str, fingerprint: str) -> dict[str, Any]:
    digest = hashlib.sha256(f"{fingerprint} {split}".encode()).hexdigest()
    return {
        "_data_files": [{"filename": shard.file} for shard in manifest.splits[split]],
        "_fingerprint": digest[:16],
        "_format_columns": None,
        "_format_kwargs": {},
        "_format_type": None,
        "_output_all_columns": False,
        "_split": split,
    }


def _build_info(
    manifest: Manifest, split: str, schema: pa.Schema, about: dict[str, str]
) -> dict[str, Any]:
    shards = manifest.splits[split]
    told = {
        "name": split,
        "num_bytes": sum(shard.bytes for shard in shards),
        "num_examples": manifest.count_rows(split),
        "shard_lengths": [shard.rows for shard in shards],
        "dataset_name": None,
    }
    return {**about, "features": layout.describe_features(schema), "splits": {split: told}}
