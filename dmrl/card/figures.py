"""Draw the figures of a card: distributions of the labels, and sample images with labels."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dmrl.atomic_output import replace_file
from dmrl.datasets import Split
from dmrl.errors import DatasetError
from dmrl.geometry.frames import STRIDE_PX
from dmrl.images import panels

SAMPLES = 12
"""Sample images, at most."""


def draw_figures(folder: Path, about: Mapping[str, Any]) -> int:
    """Write the figures of a described dataset, and return the number of sample images.

    Raises
    ------
    DatasetError
        If the folder, or a file in it, is a link: writing would change another file.
    """
    if folder.is_symlink():
        raise DatasetError(f"{folder} is a link to another folder. Remove it")
    folder.mkdir(exist_ok=True)
    for old in folder.iterdir():
        if old.is_symlink():
            raise DatasetError(f"{old} is a link to another file. Remove it")
    shown = list(_iter_samples(about["splits"], about["images"]))
    files = _draw_distributions(about) | {"samples.jpg": panels.draw_samples(shown)}
    for name, data in files.items():
        with replace_file(folder / name) as partial:
            partial.write_bytes(data)
    return len(shown)


def _draw_distributions(about: Mapping[str, Any]) -> dict[str, bytes]:
    counts, size_px, cell_px = about["counts"], (about["width"], about["height"]), 2 * STRIDE_PX
    farthest_m = max([0.1, *(c.depth_m.max(initial=0.0) for c in counts.values())])
    edges_m = np.linspace(0.0, farthest_m, 41)
    bins = np.arange(about["most"] + 2) - 0.5
    uv_px = np.concatenate([c.uv_px for c in counts.values()])
    cells = [np.arange(0, size + cell_px, cell_px) for size in reversed(size_px)]
    heat, *_ = np.histogram2d(uv_px[:, 1], uv_px[:, 0], bins=cells)
    depths = {
        f"{n} ({len(c.depth_m)})": np.histogram(c.depth_m, edges_m)[0] for n, c in counts.items()
    }
    peers = {f"{n} ({c.images})": np.histogram(c.peers, bins)[0] for n, c in counts.items()}
    square = f"Peers per square of {cell_px} x {cell_px} px ({len(uv_px)} peers)"
    return {
        "depth.png": panels.draw_stacked_bars(
            depths, edges_m, "Peers by depth", "depth along the optical axis, m"
        ),
        "peers.png": panels.draw_stacked_bars(
            peers, bins, "Images by number of peers", "peers inside the image", middle=True
        ),
        "position.png": panels.draw_heat(heat, size_px, square),
    }


def _iter_samples(splits: Mapping[str, Split], images: int) -> Iterator[panels.LabelledImage]:
    """Yield images at equal distances over all splits, with their labels."""
    places = np.unique(np.linspace(0, images - 1, SAMPLES).astype(int))
    first = 0
    for name, split in splits.items():
        mine = places[(places >= first) & (places < first + len(split))] - first
        first += len(split)
        rows = split.table.select(["peers", "source"]).take(mine).to_pylist()
        for rgb, row in zip(split.images(mine.tolist()), rows, strict=True):
            peers = row["peers"]
            uv_px = np.array([(p["u_px"], p["v_px"]) for p in peers], float).reshape(-1, 2)
            texts = [f"{p['depth_m']:.2f} m" if p["depth_m"] else "" for p in peers]
            yield panels.LabelledImage(rgb, uv_px, texts, f"{name}, {row['source']}"[:44])
