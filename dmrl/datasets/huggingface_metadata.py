"""Metadata files for the Hugging Face ``datasets`` library: JSON beside the shards."""

import hashlib
import json
from pathlib import Path
from typing import Any

import pyarrow as pa

from dmrl.atomic_output import rewritten_file
from dmrl.datasets import layout
from dmrl.datasets.manifest import Manifest
from dmrl.datasets.shards import schema_of
from dmrl.guards.safe_names import inside


def write_names(
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
        place = inside(folder, name, "a split")
        schema = schema_of(manifest.place(folder, name, shards[0]))
        rewrite(place / "state.json", _state(manifest, name, fingerprint))
        rewrite(place / "dataset_info.json", _info(manifest, name, schema, about))
    rewrite(folder / "dataset_dict.json", {"splits": list(manifest.splits)})


def rewrite(path: Path, document: Any) -> None:
    """Write a JSON file atomically, unless it has this content already."""
    text = layout.json_text(document)
    if not (path.is_file() and path.read_text(encoding="utf-8") == text):
        with rewritten_file(path) as partial:
            partial.write_text(text, encoding="utf-8")


def fingerprint_of(document: Any) -> str:
    """Return the SHA-256 hash of a JSON document."""
    return hashlib.sha256(json.dumps(document).encode()).hexdigest()


def _state(manifest: Manifest, split: str, fingerprint: str) -> dict[str, Any]:
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


def _info(
    manifest: Manifest, split: str, schema: pa.Schema, about: dict[str, str]
) -> dict[str, Any]:
    shards = manifest.splits[split]
    told = {
        "name": split,
        "num_bytes": sum(shard.bytes for shard in shards),
        "num_examples": manifest.rows(split),
        "shard_lengths": [shard.rows for shard in shards],
        "dataset_name": None,
    }
    return {**about, "features": layout.features(schema), "splits": {split: told}}
