"""Count the content that a test split shares with train: recordings, moments, poses."""

from collections.abc import Iterator, Mapping
from itertools import product

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from dmrl.datasets import Split
from dmrl.guards.safe_names import escape_markdown, markdown_code

SIMILAR_WITHIN_S = 1.0
"""Two images of one camera within this time count as similar, seconds."""
SAME_POSE_LIMITS = (1.0, 1.0, 0.01)
"""Largest difference of equal poses: u and v, pixels, and depth, metres."""


def leakage_lines(splits: Mapping[str, Split]) -> Iterator[str]:
    """Yield Markdown lines on the content that each other split shares with train."""
    train = splits.get("train")
    for name, split in splits.items():
        if name == "train" or train is None or not len(split):
            continue
        shared = sorted(set(_unique_texts(split, "source")) & set(_unique_texts(train, "source")))
        place = ", ".join(map(markdown_code, shared)) or "no recording"
        yield (
            f"- {escape_markdown(name)} and train share {place}: images of one recording have "
            "similar "
            "places, light and backgrounds."
        )
        yield (
            f"- {count_near_in_time(split, train)} of {len(split)} images of "
            f"{escape_markdown(name)} were taken "
            f"within {SIMILAR_WITHIN_S:g} s of one in train, by the same camera."
        )
        shared_poses, poses = count_same_poses(split, train)
        yield (
            f"- {shared_poses} of {poses} labels of {escape_markdown(name)} are within 1 px and 1 "
            "cm of "
            "one in train."
        )


def _unique_texts(split: Split, column: str) -> list[str]:
    return list(pc.unique(split.table[column]).to_pylist())


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
