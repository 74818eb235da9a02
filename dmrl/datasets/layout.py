"""Layout of a dataset: columns, Arrow types, files, and their features in ``datasets``.

``datasets.load_from_disk`` opens an Arrow dataset, which is written without that library::

    OUT/dataset_dict.json                 names of the splits
    OUT/train/state.json                  names of the shards
    OUT/train/dataset_info.json           features, rows per shard
    OUT/train/data-00000-of-00002.arrow   uncompressed Arrow IPC stream
    OUT/README.md, figures/               the card
    OUT/provenance.json                   inputs, settings and versions
    OUT/manifest.json, parts/             the shards, and metadata of every --add

A Parquet dataset has ``OUT/data/train-00000-of-00002.parquet`` in place of the first four. A shard
counts the shards that existed when it was added: ``data-00002-of-00003`` follows
``data-00001-of-00002``.
"""

import json
from pathlib import Path
from typing import Any

import pyarrow as pa

from dmrl.geometry.frames import STRIDE_PX
from dmrl.guards.safe_names import check_split_name

PIXELS, IMAGE, MASKS = "pixels", "image", "masks"
CONFIDENCE, DEPTH = "confidence", "depth"
MANIFEST_FILE = "manifest.json"
PEER_TYPE = pa.struct(
    [
        ("peer", pa.string()),
        *((name, pa.float64()) for name in ("u_px", "v_px", "depth_m")),
        *((f"sigma_{name}", pa.float64()) for name in ("u_px", "v_px", "depth_m")),
        ("box_px", pa.list_(pa.float64())),
        ("visible_share", pa.float64()),
        ("status", pa.string()),
        ("source", pa.string()),
    ]
)
"""One peer of one image: the fields of ``dmrl.v1.PeerLabel``, with the name of the status."""

IMAGE_TYPE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
"""Storage type of the Image feature of ``datasets``."""


def build_schema(
    height_px: int, width_px: int, *, packed: bool = False, masks: bool = False
) -> pa.Schema:
    """Build the Arrow schema of a dataset; all images have one size.

    Parameters
    ----------
    height_px, width_px
        Size of the images, multiples of 8.
    packed
        Column ``image`` with PNG or JPEG bytes in place of ``pixels`` with raw RGB.
    masks
        Add a column ``masks``: one byte per pixel, 0 for the background or the index of the peer in
        ``peers``, from 1.

    Returns
    -------
    pa.Schema
        With the features under the metadata key ``huggingface``, from which ``datasets`` takes the
        types of shards and Parquet files.
    """
    picture = (IMAGE, IMAGE_TYPE) if packed else (PIXELS, pa.binary(height_px * width_px * 3))
    row = pa.list_(pa.float32(), width_px // STRIDE_PX)
    grid = pa.list_(row, height_px // STRIDE_PX)
    covered = [(MASKS, pa.binary(height_px * width_px))] if masks else []
    plain = pa.schema(
        [
            picture,
            *covered,
            ("peers", pa.list_(PEER_TYPE)),
            (CONFIDENCE, grid),
            (DEPTH, grid),
            ("robot", pa.string()),
            ("source", pa.string()),
            ("log_time", pa.int64()),
            ("split", pa.string()),
        ]
    )
    info = {"info": {"features": describe_features(plain)}}
    return plain.with_metadata({"huggingface": json.dumps(info)})


def describe_features(columns: pa.Schema) -> dict[str, Any]:
    """Return the columns as ``datasets`` writes them in dataset_info.json.

    Fixed-size lists are written as "Sequence" and lists as ``[item]``, which ``datasets`` 3.6 and 5
    both read; "List" came with 4. Raw pixels require ``datasets`` 5.1, since earlier versions lack
    fixed_size_binary.
    """
    return {
        f.name: {"_type": "Image"} if f.name == IMAGE else _describe_feature(f.type)
        for f in columns
    }


def _describe_feature(kind: pa.DataType) -> Any:
    if pa.types.is_struct(kind):
        return {f.name: _describe_feature(f.type) for f in kind}
    if pa.types.is_fixed_size_list(kind):
        item = _describe_feature(kind.value_type)
        return {"feature": item, "length": kind.list_size, "_type": "Sequence"}
    if pa.types.is_list(kind):
        return [_describe_feature(kind.value_type)]
    return {"dtype": to_dtype_name(kind), "_type": "Value"}


def to_dtype_name(kind: pa.DataType) -> str:
    """Return the name that ``datasets`` gives a plain Arrow type: ``float32``, not ``float``."""
    return {"float": "float32", "double": "float64"}.get(str(kind), str(kind))


def shard_path(folder: Path, split: str, index: int, count: int, *, parquet: bool) -> Path:
    """Return the path of a shard, named as ``datasets`` and the Hub name it."""
    number = f"{index:05d}-of-{count:05d}"
    split = check_split_name(split, f"{folder}: a split")
    if parquet:
        return folder / "data" / f"{split}-{number}.parquet"
    return folder / split / f"data-{number}.arrow"


def format_json(document: Any) -> str:
    """Format a small JSON document with sorted keys, so that equal content gives equal bytes."""
    return json.dumps(document, indent=1, sort_keys=True) + "\n"


COLUMN_NAMES = {IMAGE, *build_schema(STRIDE_PX, STRIDE_PX, masks=True).names}
