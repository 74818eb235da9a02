"""Count the content that a test split shares with train: recordings, moments, poses."""

from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from dmrl.datasets import Split

SIMILAR_WITHIN_S = 1.0
"""Two images of one camera within this time count as similar, seconds."""
SAME_POSE_LIMITS = (1.0, 1.0, 0.01)
"""Largest difference of equal poses: u and v, pixels, and depth, metres."""


def find_leaks(splits: Mapping[str, Split]) -> Iterator[dict[str, Any]]:
    """Yield the content that each other split shares with train."""
    train = splits.get("train")
    for name, split in splits.items():
        if name == "train" or train is None or not len(split):
            continue
        same_poses, poses = count_same_poses(split, train)
        yield {
            "split": name,
            "images": len(split),
            "shared": sorted(_unique_texts(split, "source") & _unique_texts(train, "source")),
            "near": count_near_in_time(split, train),
            "same_poses": same_poses,
            "poses": poses,
        }


def _unique_texts(split: Split, column: str) -> set[str]:
    return set(pc.unique(split.table[column]).to_pylist())


def count_near_in_time(split: Split, train: Split) -> int:
    """Count the images of a split within `SIMILAR_WITHIN_S` of one in train, by the same camera."""
    count = 0
    known = _sort_times(train)
    for who, times in _sort_times(split).items():
        others = known.get(who)
        if others is not None:
            at = np.searchsorted(others, times)
            before = np.abs(times - others[np.maximum(at - 1, 0)])
            after = np.abs(times - others[np.minimum(at, len(others) - 1)])
            count += int((np.minimum(before, after) <= SIMILAR_WITHIN_S * 1e9).sum())
    return count


def _sort_times(split: Split) -> dict[tuple[str, str], NDArray[np.int64]]:
    """Return sorted log times by recording and robot."""
    names = list(zip(*(split.table[c].to_pylist() for c in ("source", "robot")), strict=True))
    times = split.table["log_time"].to_numpy()
    rows: dict[tuple[str, str], list[int]] = {}
    for row, who in enumerate(names):
        rows.setdefault(who, []).append(row)
    return {who: np.sort(times[mine]) for who, mine in rows.items()}


def count_same_poses(split: Split, train: Split) -> tuple[int, int]:
    """Count the labels of a split whose pose is also in train, and all of its labels."""
    mine, theirs = _collect_poses(split), _collect_poses(train)
    seen = np.zeros(len(mine), bool)
    # Two equal poses may lie on two sides of a cell's edge, so a grid shifted by half a cell counts
    # too.
    for shift in product((0.0, 0.5), repeat=3):
        known, asked = (_name_pose_cells(values, shift) for values in (theirs, mine))
        seen |= np.isin(asked, known)
    return int(seen.sum()), len(mine)


def _name_pose_cells(values: NDArray[np.float64], shift: tuple[float, ...]) -> NDArray[np.str_]:
    """Return the names of the cells that poses fall into, in a shifted grid."""
    boxes = np.floor(values / SAME_POSE_LIMITS + shift).astype(np.int64)
    return np.array([f"{u} {v} {depth}" for u, v, depth in boxes.tolist()], np.str_)


def _collect_poses(split: Split) -> NDArray[np.float64]:
    """Return u, v and depth of all labels, (M, 3)."""
    flat = pa.chunked_array(split.table["peers"]).combine_chunks().flatten()
    return np.column_stack([pc.struct_field(flat, n) for n in ("u_px", "v_px", "depth_m")])
