"""Convert images, detections and grid maps to rerun archetypes; `label_overlay` draws labels.

All are in the ``<robot>/image`` frame, so maps, labels and detections match the image's pixels.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from dmrl.colours import MIN_DEPTH_CONFIDENCE, RGB, paint_viridis
from dmrl.viewer.drawing.entity import (
    DETECTION_TEXT_WIDTH,
    FAINT_POINT_UI,
    INVISIBLE_RADIUS,
    LINE_UI,
    POINT_UI,
    TEXT_HEIGHT,
    Entity,
)

Colour = tuple[int, int, int]

STRIDE_PX = 8
"""Pixels per cell of a GridMap without a stride; the published network's."""

MEDIA_TYPES = {"jpg": "image/jpeg"}
MAP_ORDER = -20.0
"""Drawing order of a map; that of a camera's image is -10."""
CELL_COLOUR, NO_VALUE_COLOUR = (255, 255, 255), (48, 48, 48)
HALF_HEIGHT_M, FOCAL_WIDTHS, NEAR_M = 0.03, 0.57, 0.1
"""Offset of a text below a detection: half the height of a small drone, metres; focal length in
image widths; smallest depth that is used, metres."""


@dataclass(frozen=True, slots=True)
class ColourScale:
    """Colours of a channel of the grid, the first at 0.

    Parameters
    ----------
    title
        Quantity and unit.
    last
        Value of the last colour.
    unit
        Suffix of a value.
    has_gaps
        Cells may have no value: they are grey, which no value of a map of rerun can be.
    """

    title: str
    last: float
    unit: str
    has_gaps: bool


def build_scales(depth_max_m: float) -> dict[str, ColourScale]:
    """Return the colours of the channels that are shown, by name of the channel."""
    return {
        "confidence": ColourScale("confidence", 1.0, "", has_gaps=False),
        "depth_m": ColourScale("depth, m", depth_max_m, " m", has_gaps=True),
    }


def channel_path(topic: str, channel: str) -> str:
    """Return the entity path of one channel of a grid."""
    return f"{topic}/{channel}"


def draw_images(path: str, frame: str, batch: pa.RecordBatch) -> Iterator[Entity]:
    """Draw compressed images without decoding them."""
    formats = batch["format"].to_pylist()
    columns = rr.EncodedImage.columns(
        blob=batch["data"].to_pylist(),
        media_type=[MEDIA_TYPES.get(name, f"image/{name}") for name in formats],
    )
    yield Entity(path, columns, frame=frame)


def draw_detections(
    path: str,
    frame: str,
    batch: pa.RecordBatch,
    width_px: int,
    colour: Colour = RGB["detection"],
) -> Iterator[Entity]:
    """Draw detections as points; those below the threshold go to `weak_path`.

    Texts with confidence and depth, in `texts_path`, are below the robots. Of two texts that would
    overlap, the one with the higher confidence is drawn. ``width_px`` is the width of the images.
    """
    column = batch["detections"]
    found = column.flatten()
    confidence, depth_m = (found.field(key).to_numpy() for key in ("confidence", "depth_m"))
    row_of, uv_px = row_indices(column), points_px(found)
    believed = confidence >= batch["threshold"].to_numpy()[row_of]
    half_px = HALF_HEIGHT_M * FOCAL_WIDTHS * width_px / np.fmax(depth_m, NEAR_M)
    texts_px = uv_px + np.column_stack([np.zeros(len(uv_px)), half_px])
    (surest,) = np.nonzero(believed)
    surest = surest[np.lexsort([-confidence[surest], row_of[surest]])]
    told = np.zeros(len(uv_px), bool)
    told[surest[_select_uncovered(texts_px[surest] / width_px, row_of[surest])]] = True
    texts = [f"conf {confidence[k]:.2f}, {depth_m[k]:.2f} m" for k in np.flatnonzero(told)]
    for where, kept, at_px, radius, words in (
        (path, believed, uv_px, POINT_UI, None),
        (texts_path(path), told, texts_px, INVISIBLE_RADIUS, texts),
        (weak_path(path), ~believed, uv_px, FAINT_POINT_UI, None),
    ):
        points = rr.Points2D.columns(positions=at_px[kept], labels=words)
        lengths = np.bincount(row_of[kept], minlength=batch.num_rows)
        yield Entity(where, points.partition(lengths), (_detection_style(colour, radius),), frame)


def texts_path(path: str) -> str:
    """Return the entity path of the texts below detections."""
    return f"{path}/texts"


def weak_path(path: str) -> str:
    """Return the entity path of detections below the threshold; no view contains it by default."""
    return f"{path}/weak"


def _select_uncovered(places: NDArray[np.float64], row_of: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Select the texts that overlap none of those before them in their image, (N,).

    Parameters
    ----------
    places
        (N, 2) positions in widths of the image.
    row_of
        (N,) index of the image, sorted.
    """
    out = np.ones(len(places), bool)
    first = np.searchsorted(row_of, row_of)
    for k in np.flatnonzero(first < np.arange(len(places))):
        before = places[first[k] : k][out[first[k] : k]]
        out[k] = (abs(before - places[k]) >= (DETECTION_TEXT_WIDTH, TEXT_HEIGHT)).any(axis=1).all()
    return out


@cache
def _detection_style(colour: Colour, radius: float) -> rr.Points2D:
    return rr.Points2D.from_fields(colors=[colour], radii=[radius], draw_order=40.0)


def draw_grids(
    path: str,
    frame: str,
    batch: pa.RecordBatch,
    scales: Mapping[str, ColourScale],
    *,
    smooth: bool = False,
) -> Iterator[Entity]:
    """Draw heat maps of confidence and depth, and the cell with the highest confidence.

    A cell of low confidence has no depth. A network outputs a depth in every cell but learned depth
    near robots only.

    Parameters
    ----------
    path, frame
        Entity path of the grid, and frame of its image.
    batch
        Columns of GridMap.
    scales
        Colours of the channels that are shown.
    smooth
        Interpolate between cells; otherwise each cell is a square of the pixels that it covers.
    """
    # A topic's channels do not change from message to message.
    names = batch["channels"][0].as_py()
    stride_px = batch["stride_px"][0].as_py() or STRIDE_PX
    sizes = zip(batch["rows"].to_pylist(), batch["cols"].to_pylist(), strict=True)
    maps = [
        np.frombuffer(data, "<f4").reshape(len(names), *size)
        for data, size in zip(batch["data"].to_pylist(), sizes, strict=True)
    ]
    for index, channel in enumerate(names):
        if channel not in scales:
            continue
        values = [one[index] for one in maps]
        if channel == "depth_m" and "confidence" in names:
            sure = [one[names.index("confidence")] >= MIN_DEPTH_CONFIDENCE for one in maps]
            values = [np.where(*two, np.nan) for two in zip(sure, values, strict=True)]
        own = f"{frame}{channel_path(path, channel)}"
        place = rr.Transform3D(scale=[stride_px, stride_px, 1], child_frame=own, parent_frame=frame)
        style = map_style(scales[channel], smooth=smooth)
        columns = _build_map_columns(scales[channel], values)
        yield Entity(channel_path(path, channel), columns, (style, place), own)
        if channel == "confidence":
            yield _draw_best_cells(f"{path}/best", frame, values, stride_px)


def _draw_best_cells(
    path: str, frame: str, maps: Sequence[NDArray[np.float32]], stride_px: int
) -> Entity:
    """Draw an outline of the cell with the highest confidence."""
    best = np.array([np.unravel_index(one.argmax(), one.shape) for one in maps])
    centres = (best[:, ::-1] + 0.5) * stride_px
    columns = rr.Boxes2D.columns(centers=centres, half_sizes=np.full((len(best), 2), stride_px / 2))
    return Entity(path, columns, (_cell_style(),), frame)


def _build_map_columns(
    scale: ColourScale, maps: Sequence[NDArray[np.floating]]
) -> rr.ComponentColumnList:
    """Return a row per map, (rows, cols)."""
    buffers, formats = zip(*(_encode_map(scale, one) for one in maps), strict=True)
    kind = rr.Image if scale.has_gaps else rr.DepthImage
    return kind.columns(buffer=buffers, format=formats)


def build_still_map(scale: ColourScale, values: NDArray[np.float32]) -> rr.AsComponents:
    """Return one map, (rows, cols)."""
    buffer, form = _encode_map(scale, values)
    kind = rr.Image if scale.has_gaps else rr.DepthImage
    return kind.from_fields(buffer=buffer, format=form)


def _encode_map(
    scale: ColourScale, values: NDArray[np.floating]
) -> tuple[bytes, rr.components.ImageFormat]:
    """Return values, or colours if there may be none: those that are not finite are grey."""
    high, wide = values.shape
    if not scale.has_gaps:
        form = rr.components.ImageFormat(width=wide, height=high, channel_datatype="F32")
        return values.tobytes(), form
    known = np.isfinite(values)
    rgb = paint_viridis(np.where(known, values, 0.0) / scale.last)
    rgb[~known] = NO_VALUE_COLOUR
    form = rr.components.ImageFormat(
        width=wide, height=high, color_model="RGB", channel_datatype="U8"
    )
    return rgb.tobytes(), form


@cache
def map_style(scale: ColourScale, *, smooth: bool = False) -> rr.AsComponents:
    """Return the style of a map: a fixed range; sharp cells unless they are smoothed."""
    upscaling: Any = "linear" if smooth else "nearest"
    if scale.has_gaps:  # as a DepthImage: opaque in every view, below a camera's image
        return rr.Image.from_fields(
            opacity=1.0, draw_order=MAP_ORDER, magnification_filter=upscaling
        )
    return rr.DepthImage.from_fields(
        colormap="inferno", depth_range=[0.0, scale.last], magnification_filter=upscaling
    )


@cache
def _cell_style() -> rr.Boxes2D:
    return rr.Boxes2D.from_fields(colors=[CELL_COLOUR], radii=[LINE_UI], draw_order=35.0)


def row_indices(column: pa.ListArray) -> NDArray[np.intp]:
    """Return the row of a column that each value of its lists belongs to."""
    return np.repeat(np.arange(len(column)), column.value_lengths().to_numpy())


def points_px(points: pa.StructArray) -> NDArray[np.float64]:
    """Return the positions of labels or detections, (N, 2), pixels."""
    return stack_fields(points, ("u_px", "v_px"))


def stack_fields(points: pa.StructArray, names: Sequence[str]) -> NDArray[np.float64]:
    """Stack these fields of a column of structs, (N, k)."""
    return np.column_stack([points.field(name).to_numpy() for name in names])
