"""Numbers for a card, counted from the columns of a dataset; pixels are not touched."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from dmrl.dataset import Split
from dmrl.geometry.frames import inside


@dataclass(frozen=True)
class Counts:
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
        (M,) their depths, metres.
    label_sources
        Labels per source, outside the images as well.
    recordings
        Images per recording.
    """

    images: int
    peers: NDArray[np.int64]
    uv_px: NDArray[np.float64]
    depth_m: NDArray[np.float64]
    label_sources: Counter[str]
    recordings: Counter[str]


def count(split: Split) -> Counts:
    """Numbers of one split."""
    peers = pa.chunked_array(split.table["peers"]).combine_chunks()
    flat = peers.flatten()
    uv_px = np.column_stack([pc.struct_field(flat, name) for name in ("u_px", "v_px")])
    height_px, width_px = split.image_shape
    seen = inside(uv_px, width_px, height_px)
    image = pc.list_parent_indices(peers).to_numpy()[seen]
    return Counts(
        images=len(split),
        peers=np.bincount(image, minlength=len(split)),
        uv_px=uv_px[seen],
        depth_m=pc.struct_field(flat, "depth_m").to_numpy()[seen],
        label_sources=Counter(pc.struct_field(flat, "source").to_pylist()),
        recordings=Counter(split.table["source"].to_pylist()),
    )
