"""Layout ``dataset``: the rows of a dataset, ordered by the error of a model.

A model's detections come from recordings that ``dmrl predict`` wrote. A row and a message match
by source recording, robot and log time.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from dmrl.colours import RGB
from dmrl.datasets import layout, open_dataset
from dmrl.errors import DatasetError, SettingError
from dmrl.geometry.frames import STRIDE_PX
from dmrl.recording import name_recordings
from dmrl.viewer import layouts
from dmrl.viewer.content.matched_detections import (
    MatchedDetections,
    RowKey,
    compute_row_errors,
    find_detections,
)
from dmrl.viewer.drawing import archetypes, time_plots
from dmrl.viewer.drawing.archetypes import ColourScale
from dmrl.viewer.drawing.entity import Entity, image_frame
from dmrl.viewer.drawing.label_overlay import draw_labels
from dmrl.viewer.drawing.legend import draw_colour_bars, draw_legend
from dmrl.viewer.layouts import CameraPanel, PlotPanel
from dmrl.viewer.settings import Settings
from dmrl.viewer.show import Show, TimedEntity

TIMELINE = "rank"
ROBOT = "row"
FACTS_PATH, ERROR_PX_PATH, ERROR_M_PATH = "/row/facts", "/row/error_px", "/row/error_m"
BATCH_ROWS = 32
MOST_ROWS = 200
"""Rows that are shown by default."""

CHANNEL_COLUMNS = {"confidence": layout.CONFIDENCE, "depth_m": layout.DEPTH}
"""Channels of maps, and the columns with their ground truth."""


@dataclass(frozen=True, slots=True)
class RankedRows:
    """Rows of a dataset in display order.

    Parameters
    ----------
    rows
        All columns.
    of
        Number of rows before the limit.
    error_px, error_m
        (N,) of the worst label of each row; NaN where there is no error.
    found
        Detections of a model; None without one.
    """

    rows: pa.Table
    of: int
    error_px: NDArray[np.float64]
    error_m: NDArray[np.float64]
    found: MatchedDetections | None


def browse(paths: Sequence[Path], settings: Settings, *, rank: int | None) -> Show:
    """Show a dataset, row by row.

    Parameters
    ----------
    paths
        The folder, and optionally recordings with a model's detections.
    settings
        Selects the rows by number, split and error.
    rank
        Only this row, from 1. None: all.

    Raises
    ------
    DatasetError
        If the folder is not a dataset.
    RecordingError
        If a recording has no detections, or only of other images.
    SettingError
        If no row is left, or another layout was requested.
    """
    folder, ranked = rank_dataset(paths, replace(settings, most=settings.most or MOST_ROWS))
    if rank is not None and not 1 <= rank <= len(ranked.rows):
        raise SettingError(
            f"{folder} shows {len(ranked.rows)} rows. Give --rank 1 to {len(ranked.rows)}"
        )
    scales = archetypes.build_scales(settings.depth_max_m)
    rows, cols = grid_shape(ranked.rows)
    camera = CameraPanel(
        ROBOT,
        folder.name,
        cols * STRIDE_PX,
        rows * STRIDE_PX,
        "/row/image",
        "/row/labels",
        "/row/detections",
        "/row/grid",
        tuple(scales),
    )
    plot = None
    if ranked.found is not None:
        plot = PlotPanel("error by rank, px", (ERROR_PX_PATH,))
    return Show(
        folder.name,
        layouts.build_dataset_layout(
            camera, scales, plot, FACTS_PATH, timeline=TIMELINE, overlay=settings.overlay
        ),
        partial(_iter_entities, ranked, camera, scales, settings, rank),
        len(ranked.rows) if rank is None else 1,
        (TIMELINE, rank or 1),
        f"row {rank or 1} of {len(ranked.rows)}",
    )


def rank_dataset(paths: Sequence[Path], settings: Settings) -> tuple[Path, RankedRows]:
    """Return the folder of a dataset, and its rows in display order; see `browse`."""
    folder, recordings = _separate_paths(paths, settings)
    return folder, _rank_rows(folder, recordings, settings)


def _separate_paths(paths: Sequence[Path], settings: Settings) -> tuple[Path, list[Path]]:
    folders = [path for path in dict.fromkeys(paths) if path.is_dir()]
    if settings.layout not in ("auto", "dataset"):
        raise SettingError(f"{folders[0]} is a dataset: leave --layout {settings.layout} out")
    if len(folders) > 1:
        raise SettingError(f"{folders[0]}, {folders[1]}: one dataset at a time. Leave one out")
    return folders[0], [path for path in dict.fromkeys(paths) if not path.is_dir()]


def _rank_rows(folder: Path, recordings: Sequence[Path], settings: Settings) -> RankedRows:
    """Return the selected rows: by error if a model is given, else in their order."""
    rows = _load_rows(folder, settings)
    filtered = settings.error_from_px is not None or settings.error_to_px is not None
    if recordings:
        return _rank_by_error(folder, rows, recordings, settings, filtered=filtered)
    if filtered:
        raise SettingError(
            "errors require a model: name its recording as well. "
            "Try: dmrl predict MODEL IN.mcap OUT.mcap"
        )
    chosen = np.arange(len(rows))[:: settings.every][: settings.most]
    unknown = np.full(len(chosen), np.nan)
    return RankedRows(rows.take(chosen), len(rows), unknown, unknown, None)


def _load_rows(folder: Path, settings: Settings) -> pa.Table:
    """Read the rows of the selected split and robot; of all by default."""
    try:
        dataset = open_dataset(folder)
    except DatasetError as e:
        if next(folder.glob("*.mcap"), None) is None:
            raise
        raise DatasetError(f"{folder} is not a dataset. {name_recordings(folder)}") from e
    splits = dataset.splits if settings.split is None else (settings.split,)
    tables = [dataset.split(name).table for name in splits]
    rows = pa.concat_tables([table for table in tables if len(table)] or tables[:1])
    if settings.robot is not None:
        rows = rows.filter(pa.compute.equal(rows["robot"], settings.robot))
    if not len(rows):
        raise DatasetError(f"{folder} has no such rows. Leave --split or --robot out")
    return rows


def _rank_by_error(
    folder: Path, rows: pa.Table, recordings: Sequence[Path], settings: Settings, *, filtered: bool
) -> RankedRows:
    found = find_detections(recordings, folder, row_keys(rows))
    error_px, error_m = compute_row_errors(rows, found, image_size(rows))
    low = -1.0 if settings.error_from_px is None else settings.error_from_px
    high = np.inf if settings.error_to_px is None else settings.error_to_px
    # Images without a peer have no error; unless a range of errors is requested, they come last.
    kept = (error_px >= low) & (error_px <= high) | (np.isnan(error_px) & (not filtered))
    order = np.argsort(np.nan_to_num(-error_px, nan=np.inf), kind="stable")
    order = order[kept[order]]
    if not len(order):
        raise SettingError(
            f"no row of {folder} has such an error: errors are {np.nanmin(error_px):.2f} to "
            f"{np.nanmax(error_px):.2f} px. Change --error-from-px or --error-to-px"
        )
    chosen = order[:: settings.every][: settings.most]
    return RankedRows(
        rows.take(chosen), len(order), error_px[chosen], error_m[chosen], found.select_rows(chosen)
    )


def row_keys(rows: pa.Table) -> list[RowKey]:
    """Return the source recording, robot and log time of each row."""
    names = ("source", "robot", "log_time")
    return list(zip(*(rows[name].to_pylist() for name in names), strict=True))


def grid_shape(rows: pa.Table) -> tuple[int, int]:
    """Return the rows and columns of the maps of a table of rows."""
    kind = rows.schema.field(layout.CONFIDENCE).type
    return kind.list_size, kind.value_type.list_size


def image_size(rows: pa.Table) -> tuple[int, int]:
    """Return width and height of the images, pixels."""
    high, wide = grid_shape(rows)
    return wide * STRIDE_PX, high * STRIDE_PX


def _iter_entities(
    ranked: RankedRows,
    camera: CameraPanel,
    scales: Mapping[str, ColourScale],
    settings: Settings,
    rank: int | None,
) -> Iterator[TimedEntity]:
    every = np.arange(len(ranked.rows))
    if ranked.found is not None:
        known = every[np.isfinite(ranked.error_px)]
        yield (
            _rank_column(known),
            time_plots.draw_line(
                ERROR_PX_PATH, ranked.error_px[known], "worst label", RGB["detection"]
            ),
        )
    named = {} if ranked.found is None else {"detection": RGB["detection"]}
    shown = {name: scales[name] for name in camera.channels}
    for entity in draw_colour_bars(ROBOT, shown, camera.width_px, camera.height_px):
        yield None, entity
    sources: set[str] = set()
    chosen = every if rank is None else every[[rank - 1]]
    for start in range(0, len(chosen), BATCH_ROWS):
        part = chosen[start : start + BATCH_ROWS]
        for entity in _draw_rows(ranked, part, camera, shown, sources, smooth=settings.overlay):
            yield _rank_column(part), entity
    colours = {name: RGB.get(name, RGB["other"]) for name in sorted(sources)} | named
    yield None, draw_legend(ROBOT, colours, camera.width_px, camera.height_px)


def _rank_column(rows: NDArray[np.int64]) -> rr.TimeColumn:
    return rr.TimeColumn(TIMELINE, sequence=rows + 1)


def _draw_rows(
    ranked: RankedRows,
    part: NDArray[np.int64],
    camera: CameraPanel,
    scales: Mapping[str, ColourScale],
    sources: set[str],
    *,
    smooth: bool,
) -> Iterator[Entity]:
    rows = ranked.rows.take(part).combine_chunks()
    frame = image_frame(ROBOT)
    (batch,) = rows.to_batches()
    yield _draw_images(camera, batch)
    yield from draw_labels(
        camera.labels, frame, batch.select(["peers"]), sources, (camera.width_px, camera.height_px)
    )
    maps = None
    if ranked.found is not None:
        mine = ranked.found.select_rows(part)
        yield from archetypes.draw_detections(
            camera.detections, frame, mine.to_detections(), camera.width_px
        )
        maps = mine.load_maps()
    yield from archetypes.draw_grids(
        camera.grid, frame, _build_true_maps(batch) if maps is None else maps, scales, smooth=smooth
    )
    words = [_describe_row(ranked, int(k)) for k in part]
    columns = rr.TextDocument.columns(text=words, media_type=["text/markdown"] * len(words))
    yield Entity(FACTS_PATH, columns)


def _draw_images(camera: CameraPanel, batch: pa.RecordBatch) -> Entity:
    frame = image_frame(ROBOT)
    if layout.PIXELS not in batch.schema.names:
        blobs = batch[layout.IMAGE].field("bytes").to_pylist()
        columns = rr.EncodedImage.columns(blob=blobs, media_type=["image/png"] * len(blobs))
        return Entity(camera.picture, columns, frame=frame)
    form = rr.components.ImageFormat(
        width=camera.width_px, height=camera.height_px, color_model="RGB", channel_datatype="U8"
    )
    pixels = batch[layout.PIXELS].to_pylist()
    return Entity(
        camera.picture, rr.Image.columns(buffer=pixels, format=[form] * len(pixels)), frame=frame
    )


def _build_true_maps(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Return the ground truth of the maps as columns of GridMap."""
    flat = [
        np.asarray(batch[column].flatten().flatten(), "<f4").reshape(batch.num_rows, -1)
        for column in CHANNEL_COLUMNS.values()
    ]
    high, wide = grid_shape(pa.Table.from_batches([batch]))
    data = [row.tobytes() for row in np.concatenate(flat, axis=1)]
    count = batch.num_rows
    columns: dict[str, Any] = {
        "rows": [high] * count,
        "cols": [wide] * count,
        "channels": [list(CHANNEL_COLUMNS)] * count,
        "data": data,
        "stride_px": [STRIDE_PX] * count,
    }
    return pa.RecordBatch.from_pydict(columns)


def _describe_row(ranked: RankedRows, row: int) -> str:
    """Describe a row in Markdown."""
    one = {
        name: ranked.rows[name][row].as_py() for name in ("source", "robot", "log_time", "split")
    }
    lines = [f"# {row + 1} of {len(ranked.rows)}"]
    if ranked.found is None:
        lines.append("Maps: ground truth.")
    elif np.isnan(ranked.error_px[row]):
        lines.append("No peer in view: no error.")
    else:
        lines += [
            f"**{ranked.error_px[row]:.1f} px** pixel error",
            f"**{ranked.error_m[row]:.2f} m** depth error",
        ]
    lines += [
        f"recording {one['source']}",
        f"robot {one['robot']}",
        f"log time {one['log_time'] / 1e9:.3f} s",
        f"split {one['split']}",
        f"{ranked.of} rows in all",
    ]
    return "\n\n".join(lines)
