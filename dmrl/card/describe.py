"""Describe a dataset and its facts as the values of the card's templates."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from dmrl.card.facts import Facts
from dmrl.card.front_matter import name_size_category, to_yaml_feature
from dmrl.card.leakage import find_leaks
from dmrl.datasets import Dataset, Split, layout
from dmrl.datasets.manifest import part_folder
from dmrl.datasets.writing.near_duplicates import NEAR_DUPLICATE_BITS, load_hashes
from dmrl.geometry.frames import STRIDE_PX, is_inside
from dmrl.guards.bounded_parsing import parse_toml
from dmrl.recording import Provenance
from dmrl.recording.provenance_inputs import read_provenance


@dataclass(frozen=True)
class SplitCounts:
    """Numbers of one split.

    Parameters
    ----------
    images
        Number of images.
    peers
        (N,) peers inside each image.
    uv_px
        (M, 2) pixels of the peers inside the images.
    depth_m
        (K,) their depths, metres, of those with a known depth.
    label_sources
        Labels per source, outside the images as well.
    recordings
        Images per recording.
    statuses
        Labels per status, outside the images as well.
    """

    images: int
    peers: NDArray[np.int64]
    uv_px: NDArray[np.float64]
    depth_m: NDArray[np.float64]
    label_sources: Counter[str]
    recordings: Counter[str]
    statuses: Counter[str]


def summarize_sigmas(
    splits: Mapping[str, Split],
) -> dict[str, tuple[int, int, float, float, float]]:
    """Summarize the sigmas of labels by source.

    Returns
    -------
    dict
        By source: labels with a sigma, all labels, and the median sigma of u and v, pixels, and of
        depth, metres.
    """
    flat = pa.concat_arrays(
        [pa.chunked_array(s.table["peers"]).combine_chunks().flatten() for s in splits.values()]
    )
    names = ("sigma_u_px", "sigma_v_px", "sigma_depth_m")
    values = np.column_stack([pc.struct_field(flat, name) for name in names])
    values[np.isinf(values)] = 0.0  # the depth is unknown, not uncertain
    source = np.array(pc.struct_field(flat, "source").to_pylist(), object)
    found = {}
    for name in sorted(set(source.tolist())):
        mine = values[source == name]
        known = mine[(mine > 0).any(axis=1)]
        medians = np.median(known, axis=0).tolist() if len(known) else [0.0, 0.0, 0.0]
        found[name] = (len(known), len(mine), medians[0], medians[1], medians[2])
    return found


def count_split(split: Split) -> SplitCounts:
    """Count images, peers, sources, recordings and statuses of one split."""
    peers = pa.chunked_array(split.table["peers"]).combine_chunks()
    flat = peers.flatten()
    uv_px = np.column_stack([pc.struct_field(flat, name) for name in ("u_px", "v_px")])
    height_px, width_px = split.image_shape
    seen = is_inside(uv_px, width_px, height_px)
    image = pc.list_parent_indices(peers).to_numpy()[seen]
    known = np.isfinite(pc.struct_field(flat, "sigma_depth_m").to_numpy())
    return SplitCounts(
        images=len(split),
        peers=np.bincount(image, minlength=len(split)),
        uv_px=uv_px[seen],
        depth_m=pc.struct_field(flat, "depth_m").to_numpy()[seen & known],
        label_sources=Counter(pc.struct_field(flat, "source").to_pylist()),
        recordings=Counter(split.table["source"].to_pylist()),
        statuses=Counter(pc.struct_field(flat, "status").to_pylist()),
    )


SYNTHETIC_STAGES = {
    "render": "rendered",
    "sketch": "drawn by code",
    "fly": "from simulated flights",
}
"""Stages that make images without a camera, in words."""


def describe_dataset(dataset: Dataset, made: Provenance) -> dict[str, Any]:
    """Return the values that follow from the rows, shards and provenance of a dataset."""
    splits = {name: dataset.split(name) for name in dataset.splits}
    counts = {name: count_split(split) for name, split in splits.items()}
    first = next(iter(splits.values()))
    (height, width), (rows, cols) = first.image_shape, first.grid_shape
    images = sum(map(len, splits.values()))
    parts = list(_iter_parts(dataset))
    return {
        **{"made": made, "splits": splits, "counts": counts, "first": first.name},
        **{"height": height, "width": width, "rows": rows, "cols": cols, "images": images},
        **describe_limits(counts),
        "version": f"1.{max(len(parts) - 1, 0)}.0",
        "parts": parts,
        "recordings": sorted(
            (recording, name, n)
            for name, c in counts.items()
            for recording, n in c.recordings.items()
        ),
        "size": name_size_category(images),
        "features": [to_yaml_feature(column) for column in first.table.schema],
        "parquet": dataset.parquet,
        "png": layout.IMAGE in first.table.schema.names,
        "files": {
            name: [file.relative_to(dataset.path).as_posix() for file in dataset.list_shards(name)]
            for name in splits
        },
        "sigmas": summarize_sigmas(splits),
        "leaks": list(find_leaks(splits)),
        "simulated": _name_synthetic_stages(made),
        "columns": list(_iter_columns(first)),
    }


def describe_limits(counts: Mapping[str, SplitCounts]) -> dict[str, Any]:
    """Return the limits of a network that learns from the counted splits."""
    depth_m = np.concatenate([c.depth_m for c in counts.values()])
    peers = np.concatenate([c.peers for c in counts.values()])
    return {
        "spread": np.percentile(depth_m, (5, 50, 95)).tolist() if depth_m.size else None,
        "without_depth": sum(len(c.uv_px) for c in counts.values()) - len(depth_m),
        "empty": int((peers == 0).sum()),
        "most": int(peers.max(initial=0)),
        "statuses": sum((c.statuses for c in counts.values()), Counter[str]()),
        "within_s": 1,
    }


def describe_facts(facts: Facts) -> dict[str, Any]:
    """Return the values of the templates of facts and sensors."""
    cameras = sorted(facts.cameras.items(), key=lambda one: (one[1], one[0]))
    alike = [(words, list(named)) for words, named in groupby(cameras, lambda one: one[1])]
    return {
        "facts": facts,
        "findings": [
            (name, words) for name, found in sorted(facts.findings.items()) for words in found
        ],
        "left_out": [(why, count) for why, count in facts.left_out.items() if count],
        "near_bits": NEAR_DUPLICATE_BITS,
        "cameras": sorted(alike, key=lambda one: one[1][0]),
    }


def _name_synthetic_stages(made: Provenance) -> list[str]:
    stages = {one.stage for _, source in made.iter_ancestors() if (one := source.provenance)}
    return [words for stage, words in SYNTHETIC_STAGES.items() if stage in stages]


def _iter_parts(dataset: Dataset) -> Iterator[dict[str, Any]]:
    """Yield version, recordings and number of images of the creation and of each addition."""
    for k in range(dataset.manifest.parts if dataset.manifest else 0):
        folder = part_folder(dataset.path, k)
        made = read_provenance(folder)
        if made is not None:
            names = [source.name for source in made.inputs if not source.name.endswith(".csv")]
            yield {"version": made.dmrl_version, "names": names, "images": len(load_hashes(folder))}


@cache
def read_column_meanings() -> Mapping[str, str]:
    """Return the meaning and unit of each column, by name."""
    return parse_toml((Path(__file__).parent / "columns.toml").read_text(encoding="utf-8"))


def explain_column(name: str, split: Split) -> str:
    """Return the meaning of a column with the sizes of a split; empty if it is unknown."""
    height_px, width_px = split.image_shape
    words = read_column_meanings().get(name, "")
    return words.format(height=height_px, width=width_px, stride=STRIDE_PX)


def _iter_columns(split: Split) -> Iterator[dict[str, str]]:
    rows, cols = split.grid_shape
    grid = f"{rows} x {cols} float32"
    for name, kind in _iter_types(split.table.schema):
        own = name in (layout.CONFIDENCE, layout.DEPTH)
        words = grid if own else layout.to_dtype_name(kind).partition("<")[0]
        yield {"name": name, "type": words, "meaning": explain_column(name, split)}


def _iter_types(schema: pa.Schema) -> Iterator[tuple[str, pa.DataType]]:
    for column in schema:
        yield column.name, column.type
        if column.name == "peers":
            yield from ((f"peers.{f.name}", f.type) for f in column.type.value_type)
