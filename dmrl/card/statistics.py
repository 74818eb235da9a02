"""Count the numbers of a card from the columns of a dataset; no pixel is read."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from dmrl.datasets import Split
from dmrl.geometry.frames import is_inside


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
