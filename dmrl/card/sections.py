"""Sections of a card, as lines of Markdown."""

from collections import Counter
from collections.abc import Iterator

import numpy as np
import pyarrow as pa

from dmrl.card.statistics import SplitCounts
from dmrl.datasets import Split, layout
from dmrl.geometry.frames import STRIDE_PX
from dmrl.guards.safe_names import escape_markdown, markdown_code
from dmrl.recording import Provenance

COLUMN_MEANINGS = {
    layout.PIXELS: "image, {height} x {width} x 3 bytes, RGB, row by row from the top left",
    layout.IMAGE: "image, {height} x {width} px, PNG, RGB",
    layout.MASKS: "index of the peer in {height} x {width} pixels, from 1 in `peers`; 0: no peer",
    "peers": "every labelled peer; it may lie outside the image",
    "peers.peer": "name of the peer",
    "peers.u_px": "px, right from the left edge; pixel-edge coordinates: [0, {width}]",
    "peers.v_px": "px, down from the top edge: [0, {height}]",
    "peers.depth_m": "m, along the optical axis (camera x), not the range; 0: unknown",
    "peers.sigma_u_px": "px, one standard deviation; 0: exact or unknown",
    "peers.sigma_v_px": "px, one standard deviation; 0: exact or unknown",
    "peers.sigma_depth_m": "m, one standard deviation; 0: exact or unknown; infinite: no depth",
    "peers.box_px": "px: left, top, right, bottom of the visible part; empty: none",
    "peers.visible_share": "visible share of the peer, 0 to 1; 0: unknown",
    "peers.status": "OK, UNCONVERGED or AMBIGUOUS",
    "peers.source": "truth, estimate, hand or published",
    layout.CONFIDENCE: "1 in the cell (v, u) // {stride} of a peer's centre, else 0",
    layout.DEPTH: "m, depth of the peer in that cell, the nearest of several; else 0",
    "robot": "robot whose camera took the image",
    "source": "file name of the recording that the row comes from",
    "log_time": "ns, time of exposure in that recording",
    "split": "train or test",
}
"""Meaning and unit of each column."""


def intro_lines(splits: dict[str, Split], title: str, made: Provenance) -> list[str]:
    """Return the title and a summary of the dataset."""
    height_px, width_px = next(iter(splits.values())).image_shape
    rows, cols = next(iter(splits.values())).grid_shape
    return [
        f"# {escape_markdown(title)}",
        "",
        f"{sum(map(len, splits.values()))} camera images of {width_px} x {height_px} px, each with "
        "the pixel position and depth of the peer robots in it, and the same as grid labels of "
        f"{rows} x {cols} cells for training a network. Every row names its recording and time.",
        f"Made with dmrl {escape_markdown(made.dmrl_version)}.",
        "",
        "Pixels: u right, v down from the top-left corner, pixel-edge coordinates. Lengths in "
        "metres, times in nanoseconds. Depth is measured along the optical axis.",
        "",
    ]


def loading_lines(splits: dict[str, Split], *, parquet: bool) -> list[str]:
    """Return code that opens the dataset with three packages; DATASET stands for its folder."""
    name, split = next(iter(splits.items()))
    png = layout.IMAGE in split.table.schema.names
    ways = {
        "datasets": _datasets_snippet(name, split, png=png, parquet=parquet),
        "pyarrow": _pyarrow_snippet(name, parquet=parquet),
        "dmrl": f"""from pathlib import Path

from dmrl.datasets import open_dataset

split = open_dataset(Path("DATASET")).split("{name}")
rgb, confidence, depth = split.pixels[0][0], split.confidence[0], split.depth[0]""",
    }
    lines = ["## Load it", ""]
    for package, snippet in ways.items():
        lines += [f"With {package}:", "", "```python", snippet, "```", ""]
    if not png:
        lines += [
            "`pixels` need datasets 5.1 or newer. Leave them in its default or `arrow` format: its "
            "NumPy and torch formats drop zero bytes at the end of binary values.",
            "",
        ]
    return lines


def _datasets_snippet(name: str, split: Split, *, png: bool, parquet: bool) -> str:
    height_px, width_px = split.image_shape
    load = "load_dataset" if parquet else "load_from_disk"
    raw = f'np.frombuffer(row["pixels"], np.uint8).reshape({height_px}, {width_px}, 3)'
    return f"""import numpy as np
from datasets import {load}

row = {load}("DATASET")["{name}"][0]
rgb = {'np.asarray(row["image"])' if png else raw}"""


def _pyarrow_snippet(name: str, *, parquet: bool) -> str:
    if parquet:
        return f"""from glob import glob

import pyarrow.parquet as pq

table = pq.read_table(sorted(glob("DATASET/data/{name}-*.parquet"))[0])"""
    return f"""from glob import glob

import pyarrow as pa

shard = sorted(glob("DATASET/{name}/data-*.arrow"))[0]
table = pa.ipc.open_stream(pa.memory_map(shard)).read_all()  # no copy"""


def count_lines(counts: dict[str, SplitCounts]) -> list[str]:
    """Return tables of images, peers and label sources, by split and by recording."""
    lines = ["## Numbers", "", "| split | images | with a peer | peers | depth, m | labels from |"]
    lines.append("|---|--:|--:|--:|--:|---|")
    for name, c in counts.items():
        low, high = (c.depth_m.min(), c.depth_m.max()) if c.depth_m.size else (0.0, 0.0)
        sources = ", ".join(
            f"{escape_markdown(source)} ({n})" for source, n in sorted(c.label_sources.items())
        )
        lines.append(
            f"| {escape_markdown(name)} | {c.images} | {int((c.peers > 0).sum())} | "
            f"{int(c.peers.sum())} "
            f"| {low:.2f} to {high:.2f} | {sources} |"
        )
    lines += ["", "Peers and depths count peers inside the image, labels all of them.", ""]
    lines += ["| recording | split | images |", "|---|---|--:|"]
    rows = sorted((r, name, n) for name, c in counts.items() for r, n in c.recordings.items())
    return [
        *lines,
        *(f"| {escape_markdown(r)} | {escape_markdown(name)} | {n} |" for r, name, n in rows),
        "",
    ]


FRAMES = (
    "- Frames are right-handed. `image`: u right, v down, from the top-left edge. `camera`: x "
    "along the optical axis, y left, z up; depth is its x. Without distortion, a point lies focal "
    "length * (y, z) / x pixels from the centre of the lens.",
)
SYNTHETIC_STAGES = {
    "render": "rendered",
    "sketch": "drawn by code",
    "fly": "from simulated flights",
}
"""Stages that make images without a camera, in words."""


def limit_lines(counts: dict[str, SplitCounts], made: Provenance) -> list[str]:
    """Return the limits of a network that learns from the dataset."""
    depth_m = np.concatenate([c.depth_m for c in counts.values()])
    images = sum(c.images for c in counts.values())
    empty = sum(int((c.peers == 0).sum()) for c in counts.values())
    most = max((int(c.peers.max()) for c in counts.values() if c.peers.size), default=0)
    statuses = sum((c.statuses for c in counts.values()), Counter[str]())
    lines = ["## Limits", ""]
    if depth_m.size:
        low, middle, high = np.percentile(depth_m, (5, 50, 95))
        lines.append(
            f"- 90 % of the peers are {low:.2f} to {high:.2f} m away, the median {middle:.2f} m. "
            "Depths outside that range cannot be learned."
        )
    if without := sum(len(c.uv_px) - len(c.depth_m) for c in counts.values()):
        lines.append(
            f"- {without} peers have no depth: `depth_m` is 0 and `sigma_depth_m` infinite. "
            "Training masks their depth, and evaluation leaves it out."
        )
    lines.append(
        f"- {empty} of {images} images show no peer. They train a network to avoid false alarms. "
        f"The largest number of peers in one image is {most}."
    )
    stages = {one.stage for _, source in made.iter_ancestors() if (one := source.provenance)}
    if simulated := [words for stage, words in SYNTHETIC_STAGES.items() if stage in stages]:
        lines.append(f"- Images are {', or '.join(simulated)}. Those of a real camera differ.")
    told = ", ".join(f"{escape_markdown(name)} {n}" for name, n in sorted(statuses.items()))
    return [*lines, f"- Labels by status: {told or 'none'}.", ""]


def column_lines(splits: dict[str, Split]) -> list[str]:
    """Return a table of the columns with type, unit and meaning."""
    split = next(iter(splits.values()))
    height_px, width_px = split.image_shape
    rows, cols = split.grid_shape
    values = {"height": height_px, "width": width_px, "stride": STRIDE_PX}
    lines = ["## Columns", "", "| column | type | meaning |", "|---|---|---|"]
    for name, kind in _iter_columns(split.table.schema):
        text = "grid" if name in (layout.CONFIDENCE, layout.DEPTH) else str(kind)
        kind_text = f"{rows} x {cols} float32" if text == "grid" else layout.to_dtype_name(kind)
        meaning = COLUMN_MEANINGS.get(name, "").format(**values)
        lines.append(f"| `{name}` | {kind_text.partition('<')[0]} | {meaning} |")
    return [*lines, ""]


def _iter_columns(schema: pa.Schema) -> Iterator[tuple[str, pa.DataType]]:
    for column in schema:
        yield column.name, column.type
        if column.name == "peers":
            yield from ((f"peers.{f.name}", f.type) for f in column.type.value_type)


def ancestry_lines(made: Provenance) -> Iterator[str]:
    """Yield a nested list of the stages: settings, versions, and the hash of every input."""
    yield from _stage_lines(made, "")
    for depth, source in made.iter_ancestors():
        pad = "  " * (2 * depth + 1)
        yield f"{pad}- input {markdown_code(source.name)}, SHA-256 {markdown_code(source.sha256)}"
        if source.provenance is not None:
            yield from _stage_lines(source.provenance, pad + "  ")


def _stage_lines(made: Provenance, pad: str) -> Iterator[str]:
    seed = "" if made.seed is None else f", seed {made.seed}"
    libraries = "".join(f", {name} {version}" for name, version in made.libraries.items())
    versions = escape_markdown(f", dmrl {made.dmrl_version}{seed}{libraries}")
    yield f"{pad}- **{escape_markdown(made.stage)}**{versions}"
    if made.settings:
        settings = ", ".join(f"{key} = {value!r}" for key, value in made.settings.items())
        yield f"{pad}  - settings: {markdown_code(settings)}"
