"""What lies in an image, to rerun archetypes: one function per message type.

All of it is in the ``<robot>/image`` frame, so that maps, labels and detections lie over the
image where they belong.
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
    INVISIBLE,
    LINE_UI,
    POINT_UI,
    TEXT_HEIGHT,
    Entity,
)

Colour = tuple[int, int, int]

STRIDE_PX = 8
"""Pixels per cell where a GridMap does not say; the published network's."""

MEDIA_TYPES = {"jpg": "image/jpeg"}
CELL_COLOUR = (255, 255, 255)
HALF_HEIGHT_M, FOCAL, NEAR_M = 0.03, 0.57, 0.1
"""A text stands so far below a detection: half a small drone, focal length in widths, and the least
depth that is believed for it."""
BELIEVED = 0.05
"""Confidence below which a cell's depth is left dark: it is no robot's."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Colours of a channel of the grid, the first at 0.

    Parameters
    ----------
    title
        What is shown, with its unit.
    colormap
        One of rerun's.
    last
        Value of the last colour.
    unit
        What follows a value.
    """

    title: str
    colormap: Literal["inferno", "turbo"]
    last: float
    unit: str


def scales(depth_max_m: float) -> dict[str, Scale]:
    """Colours of the channels that are shown, by name of the channel."""
    return {
        "confidence": Scale("confidence", "inferno", 1.0, ""),
        "depth_m": Scale("depth, m", "turbo", depth_max_m, " m"),
    }


def channel_path(topic: str, channel: str) -> str:
    """Entity of one channel of a grid."""
    return f"{topic}/{channel}"


def images(path: str, frame: str, batch: pa.RecordBatch) -> Iterator[Entity]:
    """Compressed images, as they are."""
    formats = batch["format"].to_pylist()
    columns = rr.EncodedImage.columns(
        blob=batch["data"].to_pylist(),
        media_type=[MEDIA_TYPES.get(name, f"image/{name}") for name in formats],
    )
    yield Entity(path, columns, frame=frame)


def detections(
    path: str,
    frame: str,
    batch: pa.RecordBatch,
    width_px: int,
    colour: Colour = RGB["detection"],
) -> Iterator[Entity]:
    """Points, their confidence and depth in `texts_path`; below the threshold in `weak_path`.

    Texts stand below the robots. Of two whose texts would cover each other the surer has one.
    ``width_px`` is the images'.
    """
    column = batch["detections"]
    found = column.flatten()
    confidence, depth_m = (found.field(key).to_numpy() for key in ("confidence", "depth_m"))
    row_of, uv_px = rows_of(column), points_px(found)
    believed = confidence >= batch["threshold"].to_numpy()[row_of]
    half_px = HALF_HEIGHT_M * FOCAL * width_px / np.fmax(depth_m, NEAR_M)
    texts_px = uv_px + np.column_stack([np.zeros(len(uv_px)), half_px])
    (surest,) = np.nonzero(believed)
    surest = surest[np.lexsort([-confidence[surest], row_of[surest]])]
    told = np.zeros(len(uv_px), bool)
    told[surest[_uncovered(texts_px[surest] / width_px, row_of[surest])]] = True
    texts = [f"conf {confidence[k]:.2f}, {depth_m[k]:.2f} m" for k in np.flatnonzero(told)]
    for where, kept, at_px, radius, words in (
        (path, believed, uv_px, POINT_UI, None),
        (texts_path(path), told, texts_px, INVISIBLE, texts),
        (weak_path(path), ~believed, uv_px, FAINT_POINT_UI, None),
    ):
        points = rr.Points2D.columns(positions=at_px[kept], labels=words)
        lengths = np.bincount(row_of[kept], minlength=batch.num_rows)
        yield Entity(where, points.partition(lengths), (_detection_style(colour, radius),), frame)


def texts_path(path: str) -> str:
    """Entity of what is written below detections."""
    return f"{path}/texts"


def weak_path(path: str) -> str:
    """Entity of detections below the threshold: in no view until it is added to one."""
    return f"{path}/weak"


def _uncovered(places: NDArray[np.float64], row_of: NDArray[np.intp]) -> NDArray[np.bool_]:
    """(N,) whose texts stand on none of those before them in their image.

    Parameters
    ----------
    places
        (N, 2) in widths of the image.
    row_of
        (N,) in which image, sorted.
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


def grids(
    path: str,
    frame: str,
    batch: pa.RecordBatch,
    scales: Mapping[str, Scale],
    *,
    smooth: bool = False,
) -> Iterator[Entity]:
    """Heat maps of confidence and depth, and the cell with the highest confidence.

    Depth is 0, the darkest colour, where no robot is believed to be: a network says some depth
    in every cell, and has learned it near robots alone.

    Parameters
    ----------
    path, frame
        Where the grid stands, and in which image.
    batch
        Columns of GridMap.
    scales
        Colours of the channels that are shown.
    smooth
        Scale the maps up smoothly; otherwise each cell is a square of the pixels it stands for.
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
        return [_share(one, names.index(channel), len(names)) for one in data]

    for channel in filter(scales.__contains__, names):
        buffers = buffers_of(channel)
        if channel == "depth_m" and "confidence" in names:
            beliefs = buffers_of("confidence")
            buffers = [_dimmed(*two) for two in zip(buffers, beliefs, strict=True)]
        yield map_entity(
            channel_path(path, channel),
            frame,
            scales[channel],
            rr.DepthImage.columns(buffer=buffers, format=formats),
            stride_px=stride_px,
            smooth=smooth,
        )
        if channel == "confidence":
            yield _best_cells(f"{path}/best", frame, buffers, formats, stride_px)


def map_entity(
    path: str,
    frame: str,
    scale: Scale,
    columns: Iterable[rr.ComponentColumn],
    *,
    stride_px: int = STRIDE_PX,
    smooth: bool = False,
) -> Entity:
    """A map that is laid over an image, each cell as large as the pixels it stands for."""
    own = f"{frame}{path}"
    place = rr.Transform3D(scale=[stride_px, stride_px, 1], child_frame=own, parent_frame=frame)
    return Entity(path, columns, (map_style(scale, smooth=smooth), place), own)


def _best_cells(
    path: str,
    frame: str,
    buffers: Sequence[bytes],
    formats: Sequence[rr.components.ImageFormat],
    stride_px: int,
) -> Entity:
    """An outline of the cell with the highest confidence."""
    best = np.array([np.frombuffer(buffer, "<f4").argmax() for buffer in buffers])
    cols = np.array([form.width for form in formats])
    centres = (np.column_stack([best % cols, best // cols]) + 0.5) * stride_px
    columns = rr.Boxes2D.columns(centers=centres, half_sizes=np.full((len(best), 2), stride_px / 2))
    return Entity(path, columns, (_cell_style(),), frame)


@cache
def _cell_style() -> rr.Boxes2D:
    return rr.Boxes2D.from_fields(colors=[CELL_COLOUR], radii=[LINE_UI], draw_order=35.0)


@cache
def map_style(scale: Scale, *, smooth: bool = False) -> rr.DepthImage:
    """Colours of a map: fixed range; cells with sharp edges unless they are smoothed."""
    return rr.DepthImage.from_fields(
        colormap=scale.colormap,
        depth_range=[0.0, scale.last],
        magnification_filter="linear" if smooth else "nearest",
    )


def _share(data: bytes, index: int, parts: int) -> bytes:
    size = len(data) // parts
    return data[index * size : (index + 1) * size]


def _dimmed(depth: bytes, confidence: bytes) -> bytes:
    """A map of depths, 0 where the confidence is under ``BELIEVED``."""
    believed = np.frombuffer(confidence, "<f4") >= BELIEVED
    return np.where(believed, np.frombuffer(depth, "<f4"), np.float32(0)).tobytes()


def rows_of(column: pa.ListArray) -> NDArray[np.intp]:
    """Which row of a column each value of its lists is in."""
    return np.repeat(np.arange(len(column)), column.value_lengths().to_numpy())


def points_px(points: pa.StructArray) -> NDArray[np.float64]:
    """(N, 2) where labels or detections are."""
    return fields(points, ("u_px", "v_px"))


def fields(points: pa.StructArray, names: Sequence[str]) -> NDArray[np.float64]:
    """(N, k) of a column of structs with these fields."""
    return np.column_stack([points.field(name).to_numpy() for name in names])
