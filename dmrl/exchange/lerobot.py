"""Write datasets in LeRobot's format 3.0: Parquet files with the images, and their description.

The layout is that of ``lerobot.datasets`` 0.4: ``meta/info.json``, ``meta/tasks.parquet``,
``meta/episodes`` and ``data``. An episode is the images of a robot in a recording and split. Its
``timestamp`` is the number of the frame over ``fps``, as LeRobot requires; ``log_time`` is the time
of the recording. Labels are vectors as long as the largest number of peers, filled with NaN; so
are a depth and a box that are unknown.
"""

import json
import math
from itertools import groupby, pairwise
from pathlib import Path
from statistics import median
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from dmrl.datasets.layout import IMAGE_TYPE, format_json
from dmrl.datasets.writing.parquet_writer import ParquetWriter
from dmrl.exchange.dataset_rows import ExportRow, ExportRows, to_attributes

VERSION = "v3.0"
CHUNK_FILES = 1000
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
IMAGE = "observation.images.camera"
TASK = "Detect the peers in the image."
FIELDS = ("u_px", "v_px", "depth_m", "sigma_u_px", "sigma_v_px", "sigma_depth_m")
EDGES = ("left_px", "top_px", "right_px", "bottom_px")
LABELS = (*FIELDS, *EDGES, "class_id")
INTEGERS = ("frame_index", "episode_index", "index", "task_index", "log_time")
BATCH_ROWS = 64


def write_lerobot(rows: ExportRows, folder: Path) -> dict[str, int]:
    """Write a LeRobot dataset; return images by split."""
    fps = _estimate_fps(rows)
    schema = _build_schema(rows.most_peers)
    episodes: list[dict[str, Any]] = []
    index, spans, counts = 0, dict[str, tuple[int, int]](), dict[str, int]()
    for (split, *_), images in groupby(
        rows.iter_by_camera(), key=lambda row: (row.split, row.source, row.robot)
    ):
        number = len(episodes)
        place = {"chunk_index": number // CHUNK_FILES, "file_index": number % CHUNK_FILES}
        path = folder / "data" / FILE.format(**place)
        path.parent.mkdir(parents=True, exist_ok=True)
        length, pending = 0, list[dict[str, Any]]()
        with ParquetWriter(path, schema) as sink:
            for row in images:
                frame = _to_frame(row, rows) | {"timestamp": length / fps, "frame_index": length}
                frame |= {"episode_index": number, "index": index + length, "task_index": 0}
                pending.append(frame)
                length += 1
                if len(pending) == BATCH_ROWS:
                    sink.write_table(pa.Table.from_pylist(pending, schema))
                    pending.clear()
            sink.write_table(pa.Table.from_pylist(pending, schema))
        own = {f"data/{key}": value for key, value in place.items()}
        span = {"dataset_from_index": index, "dataset_to_index": index + length}
        episodes.append(
            {"episode_index": number, "tasks": [TASK], "length": length, **own, **span}
            | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        )
        index += length
        spans[split] = (spans.get(split, (number,))[0], number + 1)
        counts[split] = counts.get(split, 0) + length
    _write_meta(folder, episodes, _describe(rows, fps, spans, episodes))
    return counts


def _estimate_fps(rows: ExportRows) -> int:
    """Return the images per second of the median step between images, at least 1."""
    steps = [
        after - before
        for times in rows.list_times()
        for before, after in pairwise(sorted(times))
        if after > before
    ]
    return max(1, round(1e9 / median(steps))) if steps else 1


def _build_schema(most: int) -> pa.Schema:
    vector = pa.float32() if most == 1 else pa.list_(pa.float32(), most)
    return pa.schema(
        [
            (IMAGE, IMAGE_TYPE),
            *((f"labels.{name}", vector) for name in LABELS),
            ("timestamp", pa.float32()),
            *((name, pa.int64()) for name in INTEGERS),
        ]
    )


def _to_frame(row: ExportRow, rows: ExportRows) -> dict[str, Any]:
    """Return the image and the labels of a row."""
    frame: dict[str, Any] = {IMAGE: {"bytes": row.png, "path": None}, "log_time": row.log_time}
    told = [
        dict(zip(EDGES, peer["box_px"], strict=False))
        | to_attributes(peer)
        | {"class_id": rows.classes.index(peer["class"])}
        for peer in row.peers
    ]
    for name in LABELS:
        values = [float(peer.get(name, math.nan)) for peer in told]
        values += [math.nan] * (rows.most_peers - len(values))
        frame[f"labels.{name}"] = values[0] if rows.most_peers == 1 else values
    return frame


def _describe(
    rows: ExportRows, fps: int, spans: dict[str, tuple[int, int]], episodes: list[dict[str, Any]]
) -> dict[str, Any]:
    """Return the content of ``meta/info.json``."""
    height_px, width_px = rows.data.split(rows.data.splits[0]).image_shape
    names = [f"peer_{k}" for k in range(rows.most_peers)]
    image = {"dtype": "image", "shape": [height_px, width_px, 3]}
    features: dict[str, Any] = {IMAGE: image | {"names": ["height", "width", "channels"]}}
    for name in LABELS:
        shape = {"dtype": "float32", "shape": [rows.most_peers]}
        features[f"labels.{name}"] = shape | {"names": names}
    for name in ("timestamp", *INTEGERS):
        dtype = "float32" if name == "timestamp" else "int64"
        features[name] = {"dtype": dtype, "shape": [1], "names": None}
    return {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": len(episodes),
        "total_frames": sum(episode["length"] for episode in episodes),
        "total_tasks": 1,
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {split: f"{first}:{end}" for split, (first, end) in spans.items()},
        "data_path": f"data/{FILE}",
        "video_path": None,
        "features": features,
        "classes": rows.classes,
    }


def _write_meta(folder: Path, episodes: list[dict[str, Any]], info: dict[str, Any]) -> None:
    meta = folder / "meta"
    place = meta / "episodes" / FILE.format(chunk_index=0, file_index=0)
    place.parent.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(episodes), place)
    (meta / "info.json").write_text(format_json(info), encoding="utf-8")
    # LeRobot reads the tasks with pandas, by their index.
    key = "__index_level_0__"
    table = pa.table({"task_index": [0], key: [TASK]})
    index = {"name": None, "field_name": key, "pandas_type": "unicode", "numpy_type": "object"}
    about = {"index_columns": [key], "columns": [index | {"metadata": None}], "column_indexes": []}
    described = json.dumps(about)
    pq.write_table(table.replace_schema_metadata({"pandas": described}), meta / "tasks.parquet")
