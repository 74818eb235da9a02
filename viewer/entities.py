"""Columns of a topic to rerun archetypes: one function per message type.

Everything in two dimensions is in the ``image`` frame, pixels, u right and v down, so that
maps, labels and detections lie over the image where they belong.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from dmrl.colours import RGB

STRIDE_PX = 8
"""Pixels per cell where a GridMap does not say; the published network's."""

MEDIA_TYPES = {"jpg": "image/jpeg"}
# rerun takes a negative radius in points of the screen: the same at every zoom.
POINT_UI, FAINT_POINT_UI, LINE_UI = -4.0, -1.5, -1.0
INVISIBLE = 0.01
# rerun writes below a point; at the zoom that a layout opens with, this is a line's height.
TEXT_PX = 14


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


@dataclass(frozen=True, slots=True)
class Entity:
    """Some rows of one entity.

    Parameters
    ----------
    path
        Where it stands, as a topic.
    columns
        One row per message; none for what does not move.
    style
        What never changes; logged once.
    """

    path: str
    columns: Iterable[rr.ComponentColumn] = ()
    style: tuple[rr.AsComponents, ...] = ()


def scales(depth_max_m: float) -> dict[str, Scale]:
    """Colours of the channels that are shown, by name of the channel."""
    return {
        "confidence": Scale("confidence", "inferno", 1.0, ""),
        "depth_m": Scale("depth, m", "turbo", depth_max_m, " m"),
    }


def escaped(path: str) -> str:
    """A topic as rerun writes an entity's path; robots may have any name."""
    return rr.new_entity_path(path.strip("/").split("/"))


def channel_path(topic: str, channel: str) -> str:
    """Entity of one channel of a grid."""
    return f"{topic}/{channel}"


def images(topic: str, batch: pa.RecordBatch) -> Iterator[Entity]:
    """Compressed images, as they are."""
    formats = batch["format"].to_pylist()
    columns = rr.EncodedImage.columns(
        blob=batch["data"].to_pylist(),
        media_type=[MEDIA_TYPES.get(name, f"image/{name}") for name in formats],
    )
    yield Entity(topic, columns)


def labels(topic: str, batch: pa.RecordBatch, sources: set[str]) -> Iterator[Entity]:
    """Points and boxes of every source of labels.

    Parameters
    ----------
    topic
        Where the labels stand.
    batch
        Columns of PeerLabels.
    sources
        Sources met so far, grown here: a row without a source's labels must still be sent,
        or the last ones would stay on the screen.
    """
    column = batch["peers"]
    row_of = _row_of(column)
    peers = column.flatten()
    source_of = np.array(peers.field("source").to_pylist(), dtype=object)
    sources.update(source_of)
    for source in sorted(sources):
        (at,) = np.nonzero(source_of == source)
        yield from _labels_of(topic, source, peers.take(at), row_of[at], batch.num_rows)


def _labels_of(
    topic: str, source: str, peers: pa.StructArray, row_of: NDArray[np.intp], rows: int
) -> Iterator[Entity]:
    colour = RGB.get(source, RGB["other"])
    # Where two sources agree, the one named first in the table is seen.
    order = 30.0 - list(RGB).index(source if source in RGB else "other")
    edges = peers.field("box_px")
    boxed = edges.value_lengths().to_numpy() == 4
    corners = edges.filter(pa.array(boxed)).flatten().to_numpy().reshape(-1, 2, 2)
    centres = corners.mean(axis=1)
    uv_px = _positions(peers)
    top_px = uv_px.copy()
    top_px[boxed] = np.column_stack([centres[:, 0], corners[:, 0, 1]])

    points = rr.Points2D.columns(positions=uv_px)
    boxes = rr.Boxes2D.columns(centers=centres, half_sizes=(corners[:, 1] - corners[:, 0]) / 2)
    dot, dust = (
        rr.Points2D.from_fields(colors=[colour], radii=[radius], draw_order=order)
        for radius in (POINT_UI, INVISIBLE)
    )
    outline = rr.Boxes2D.from_fields(colors=[colour], radii=[LINE_UI], draw_order=order - 10.0)
    lengths = np.bincount(row_of, minlength=rows)
    box_lengths = np.bincount(row_of[boxed], minlength=rows)
    path = f"{topic}/{source}"
    yield Entity(f"{path}/points", points.partition(lengths), (dot,))
    yield Entity(f"{path}/boxes", boxes.partition(box_lengths), (outline,))
    yield Entity(f"{path}/texts", _label_texts(peers, top_px).partition(lengths), (dust,))


def _label_texts(peers: pa.StructArray, top_px: NDArray[np.float64]) -> rr.ComponentColumnList:
    # Above the peer: below it stands what the network found.
    above_px = np.column_stack([top_px[:, 0], np.maximum(top_px[:, 1] - TEXT_PX, 0)])
    names, depths_m = (peers.field(key).to_pylist() for key in ("peer", "depth_m"))
    texts = [f"{name} {depth_m:.2f} m" for name, depth_m in zip(names, depths_m, strict=True)]
    return rr.Points2D.columns(positions=above_px, labels=texts)


def detections(topic: str, batch: pa.RecordBatch) -> Iterator[Entity]:
    """Points with confidence and depth; without text and faint below the model's threshold."""
    column = batch["detections"]
    found = column.flatten()
    confidence, depth_m = (found.field(key).to_numpy() for key in ("confidence", "depth_m"))
    believed = confidence >= batch["threshold"].to_numpy()[_row_of(column)]
    texts = [
        f"{c:.2f}, {d:.2f} m" if shown else ""
        for c, d, shown in zip(confidence, depth_m, believed, strict=True)
    ]
    columns = rr.Points2D.columns(
        positions=_positions(found),
        labels=texts,
        radii=np.where(believed, POINT_UI, FAINT_POINT_UI),
    )
    style = rr.Points2D.from_fields(colors=[RGB["detection"]], draw_order=40.0)
    yield Entity(topic, columns.partition(column.value_lengths().to_numpy()), (style,))


def grids(topic: str, batch: pa.RecordBatch, scales: Mapping[str, Scale]) -> Iterator[Entity]:
    """Heat maps of confidence and depth, each cell as large as the pixels it stands for."""
    sizes = zip(batch["cols"].to_pylist(), batch["rows"].to_pylist(), strict=True)
    formats = [
        rr.components.ImageFormat(width=cols, height=rows, channel_datatype="F32")
        for cols, rows in sizes
    ]
    stride_px = batch["stride_px"][0].as_py() or STRIDE_PX
    place = rr.Transform3D(scale=[stride_px, stride_px, 1])
    # A topic's channels do not change from message to message.
    names = batch["channels"][0].as_py()
    for index, channel in enumerate(names):
        if channel in scales:
            buffers = [_share(data, index, len(names)) for data in batch["data"].to_pylist()]
            columns = rr.DepthImage.columns(buffer=buffers, format=formats)
            yield Entity(channel_path(topic, channel), columns, (map_style(scales[channel]), place))


def map_style(scale: Scale) -> rr.DepthImage:
    """Colours of a map: fixed range, cells with sharp edges."""
    return rr.DepthImage.from_fields(
        colormap=scale.colormap,
        depth_range=[0.0, scale.last],
        magnification_filter="nearest",
    )


def _share(data: bytes, index: int, parts: int) -> bytes:
    size = len(data) // parts
    return data[index * size : (index + 1) * size]


def _row_of(column: pa.ListArray) -> NDArray[np.intp]:
    return np.repeat(np.arange(len(column)), column.value_lengths().to_numpy())


def _positions(points: pa.StructArray) -> NDArray[np.float64]:
    return np.column_stack([points.field(key).to_numpy() for key in ("u_px", "v_px")])
