"""Convert images, detections and grid maps to rerun archetypes; `label_overlay` draws labels.

All are in the ``<robot>/image`` frame, so maps, labels and detections match the image's pixels.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from dmrl.colours import RGB
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
CELL_COLOUR = (255, 255, 255)
HALF_HEIGHT_M, FOCAL_WIDTHS, NEAR_M = 0.03, 0.57, 0.1
"""Offset of a text below a detection: half the height of a small drone, metres; focal length in
image widths; smallest depth that is used, metres."""
MIN_DEPTH_CONFIDENCE = 0.05
"""Confidence below which a cell's depth is drawn dark, since it belongs to no robot."""


@dataclass(frozen=True, slots=True)
class ColourScale:
    """Colours of a channel of the grid, the first at 0.

    Parameters
    ----------
    title
        Quantity and unit.
    colormap
        One of rerun's.
    last
        Value of the last colour.
    unit
        Suffix of a value.
    """

    title: str
    colormap: Literal["inferno", "viridis"]
    last: float
    unit: str


def build_scales(depth_max_m: float) -> dict[str, ColourScale]:
    """Return the colours of the channels that are shown, by name of the channel."""
    return {
        "confidence": ColourScale("confidence", "inferno", 1.0, ""),
        "depth_m": ColourScale("depth, m", "viridis", depth_max_m, " m"),
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

    Depth is drawn as 0, the darkest colour, where confidence is low. A network outputs a depth in
    every cell but learned depth near robots only.

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
    sizes = zip(batch["cols"].to_pylist(), batch["rows"].to_pylist(), strict=True)
    formats = [
        rr.components.ImageFormat(width=cols, height=rows, channel_datatype="F32")
        for cols, rows in sizes
    ]
    stride_px = batch["stride_px"][0].as_py() or STRIDE_PX
    # A topic's channels do not change from message to message.
    names = batch["channels"][0].as_py()
    data = batch["data"].to_pylist()

    def buffers_of(channel: str) -> list[bytes]:
        return [_slice_channel(one, names.index(channel), len(names)) for one in data]

    for channel in filter(scales.__contains__, names):
        buffers = buffers_of(channel)
        if channel == "depth_m" and "confidence" in names:
            beliefs = buffers_of("confidence")
            buffers = [_mask_depth(*two) for two in zip(buffers, beliefs, strict=True)]
        yield draw_map(
            channel_path(path, channel),
            frame,
            scales[channel],
            rr.DepthImage.columns(buffer=buffers, format=formats),
            stride_px=stride_px,
            smooth=smooth,
        )
        if channel == "confidence":
            yield _draw_best_cells(f"{path}/best", frame, buffers, formats, stride_px)


def draw_map(
    path: str,
    frame: str,
    scale: ColourScale,
    columns: Iterable[rr.ComponentColumn],
    *,
    stride_px: int = STRIDE_PX,
    smooth: bool = False,
) -> Entity:
    """Draw a map over an image; each cell has the size of the pixels that it covers."""
    own = f"{frame}{path}"
    place = rr.Transform3D(scale=[stride_px, stride_px, 1], child_frame=own, parent_frame=frame)
    return Entity(path, columns, (map_style(scale, smooth=smooth), place), own)


def _draw_best_cells(
    path: str,
    frame: str,
    buffers: Sequence[bytes],
    formats: Sequence[rr.components.ImageFormat],
    stride_px: int,
) -> Entity:
    """Draw an outline of the cell with the highest confidence."""
    best = np.array([np.frombuffer(buffer, "<f4").argmax() for buffer in buffers])
    cols = np.array([form.width for form in formats])
    centres = (np.column_stack([best % cols, best // cols]) + 0.5) * stride_px
    columns = rr.Boxes2D.columns(centers=centres, half_sizes=np.full((len(best), 2), stride_px / 2))
    return Entity(path, columns, (_cell_style(),), frame)


@cache
def _cell_style() -> rr.Boxes2D:
    return rr.Boxes2D.from_fields(colors=[CELL_COLOUR], radii=[LINE_UI], draw_order=35.0)


@cache
def map_style(scale: ColourScale, *, smooth: bool = False) -> rr.DepthImage:
    """Return the style of a map: a fixed range; sharp cells unless they are smoothed."""
    return rr.DepthImage.from_fields(
        colormap=scale.colormap,
        depth_range=[0.0, scale.last],
        magnification_filter="linear" if smooth else "nearest",
    )


def _slice_channel(data: bytes, index: int, parts: int) -> bytes:
    size = len(data) // parts
    return data[index * size : (index + 1) * size]


def _mask_depth(depth: bytes, confidence: bytes) -> bytes:
    """Set the depth to 0 where the confidence is below ``MIN_DEPTH_CONFIDENCE``."""
    believed = np.frombuffer(confidence, "<f4") >= MIN_DEPTH_CONFIDENCE
    return np.where(believed, np.frombuffer(depth, "<f4"), np.float32(0)).tobytes()


def row_indices(column: pa.ListArray) -> NDArray[np.intp]:
    """Return the row of a column that each value of its lists belongs to."""
    return np.repeat(np.arange(len(column)), column.value_lengths().to_numpy())


def points_px(points: pa.StructArray) -> NDArray[np.float64]:
    """Return the positions of labels or detections, (N, 2), pixels."""
    return stack_fields(points, ("u_px", "v_px"))


def stack_fields(points: pa.StructArray, names: Sequence[str]) -> NDArray[np.float64]:
    """Stack these fields of a column of structs, (N, k)."""
    return np.column_stack([points.field(name).to_numpy() for name in names])
