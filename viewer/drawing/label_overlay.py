"""Draw labels in an image: points, boxes, ellipses and texts."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from dmrl.colours import RGB
from dmrl.geometry.frames import is_inside
from dmrl.viewer.drawing.archetypes import points_px, row_indices, stack_fields
from dmrl.viewer.drawing.entity import (
    ELLIPSE_SIGMAS,
    INVISIBLE_RADIUS,
    LINE_UI,
    POINT_UI,
    TEXT_HEIGHT,
    TEXT_WIDTH,
    Entity,
)


def draw_labels(
    path: str,
    frame: str,
    batch: pa.RecordBatch,
    sources: set[str],
    size_px: tuple[int, int],
) -> Iterator[Entity]:
    """Draw points, boxes and ellipses of every source of labels.

    Parameters
    ----------
    path, frame
        Entity path of the labels, and frame of their image.
    batch
        Columns of PeerLabels.
    sources
        Sources found so far; updated in place. A row without labels of a source must still be sent,
        or the old ones would stay on the screen.
    size_px
        Width and height of the images. Ellipses around points outside are left out: they would
        cover the surroundings of the image.
    """
    column = batch["peers"]
    row_of = row_indices(column)
    peers = column.flatten()
    source_of = np.array(peers.field("source").to_pylist(), dtype=object)
    sources.update(source_of)
    ordered = sorted(sources, key=_sort_key)
    places = np.array([ordered.index(source) for source in source_of], int)
    first = np.lexsort([places, row_of])
    texts_px = np.empty((len(peers), 2))
    tops_px, bottoms_px = (_edge_centres(peers, edge)[first] for edge in (0, 1))
    texts_px[first] = _place_texts(tops_px, bottoms_px[:, 1], row_of[first], size_px[0])
    for source in ordered:
        (at,) = np.nonzero(source_of == source)
        mine = _SourceLabels(peers.take(at), row_of[at], texts_px[at], batch.num_rows, size_px)
        for entity in mine.iter_entities(f"{path}/{source}", source):
            yield replace(entity, frame=frame)


@dataclass(frozen=True, slots=True)
class _SourceLabels:
    """The labels of one source; ``row_of`` is the image of each."""

    peers: pa.StructArray
    row_of: NDArray[np.intp]
    texts_px: NDArray[np.float64]
    rows: int
    size_px: tuple[int, int]

    def iter_entities(self, path: str, source: str) -> Iterator[Entity]:
        dot, dust, outline, curve = _label_styles(source)
        boxed, corners = _parse_boxes(self.peers)
        centres = corners.mean(axis=1)
        uv_px = points_px(self.peers)

        points = rr.Points2D.columns(positions=uv_px)
        boxes = rr.Boxes2D.columns(centers=centres, half_sizes=(corners[:, 1] - corners[:, 0]) / 2)
        yield Entity(f"{path}/points", self._partition_rows(points), (dot,))
        yield Entity(f"{path}/boxes", self._partition_rows(boxes, boxed), (outline,))
        yield Entity(f"{path}/texts", self._partition_rows(self._build_texts()), (dust,))
        sigmas_px = stack_fields(self.peers, ("sigma_u_px", "sigma_v_px"))
        unsure = (sigmas_px > 0).all(axis=1) & is_inside(uv_px, *self.size_px)
        ellipses = rr.Ellipses2D.columns(
            centers=uv_px[unsure], half_sizes=ELLIPSE_SIGMAS * sigmas_px[unsure]
        )
        yield Entity(f"{path}/sigmas", self._partition_rows(ellipses, unsure), (curve,))

    def _build_texts(self) -> rr.ComponentColumnList:
        names, depths_m = (self.peers.field(key).to_pylist() for key in ("peer", "depth_m"))
        texts = [
            f"{name} {depth_m:.2f} m" if depth_m else name
            for name, depth_m in zip(names, depths_m, strict=True)
        ]
        return rr.Points2D.columns(positions=self.texts_px, labels=texts)

    def _partition_rows(
        self, columns: rr.ComponentColumnList, kept: NDArray[np.bool_] | None = None
    ) -> rr.ComponentColumnList:
        row_of = self.row_of if kept is None else self.row_of[kept]
        return columns.partition(np.bincount(row_of, minlength=self.rows))


def _parse_boxes(peers: pa.StructArray) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return which labels have a box, (N,), and the corners of those, (M, 2, 2)."""
    edges = peers.field("box_px")
    boxed = edges.value_lengths().to_numpy() == 4
    return boxed, edges.filter(pa.array(boxed)).flatten().to_numpy().reshape(-1, 2, 2)


def _edge_centres(peers: pa.StructArray, edge: int) -> NDArray[np.float64]:
    """Return the middle of an edge of each label's box, (N, 2); without a box, the label.

    The upper edge is 0, the lower one is 1.
    """
    boxed, corners = _parse_boxes(peers)
    out = points_px(peers)
    out[boxed] = np.column_stack([corners.mean(axis=1)[:, 0], corners[:, edge, 1]])
    return out


def _place_texts(
    tops_px: NDArray[np.float64],
    bottoms_px: NDArray[np.float64],
    row_of: NDArray[np.intp],
    width_px: int,
) -> NDArray[np.float64]:
    """Place texts above their peers without overlap; the texts of detections are below.

    A text that has no room above goes below those of detections.

    Parameters
    ----------
    tops_px
        (N, 2) points below the texts; the first ones have the first choice.
    bottoms_px
        (N,) heights below which a detection of the same peer has its text.
    row_of
        (N,) index of the image, sorted.
    width_px
        Width of the images.
    """
    high_px, wide_px = TEXT_HEIGHT * width_px, TEXT_WIDTH * width_px
    out = np.column_stack([tops_px[:, 0], np.maximum(tops_px[:, 1] - high_px, 0.0)])
    begins = np.flatnonzero(np.diff(row_of, prepend=-1))
    ends = np.flatnonzero(np.diff(row_of, append=-1)) + 1
    for begin, end in zip(begins, ends, strict=True):
        for k in range(begin + 1, end):
            near = abs(out[begin:k, 0] - out[k, 0]) < wide_px
            taken = np.concatenate([out[begin:k, 1][near], bottoms_px[begin:k][near]])
            out[k, 1] = _find_free_height(out[k, 1], taken, high_px)
    return out


def _find_free_height(wanted: float, taken: NDArray[np.float64], high: float) -> float:
    """Find the nearest height at a distance of ``high`` from all in ``taken``; prefer above."""
    above, below = taken - high, taken + high
    tried = np.concatenate([[wanted], above[above >= 0], below])
    far = np.where(tried > wanted, 3.0, 1.0) * abs(tried - wanted)
    free = (abs(tried[:, None] - taken) > high - 0.5).all(axis=1)
    # Below the lowest text there is always room.
    return float(tried[np.argmin(np.where(free, far, np.inf))])


@cache
def _label_styles(source: str) -> tuple[rr.Points2D, rr.Points2D, rr.Boxes2D, rr.Ellipses2D]:
    """Return the styles of points, texts, boxes and ellipses. Cached for later batches."""
    colour = RGB.get(source, RGB["other"])
    # Where two sources agree, the first one in the table is drawn on top.
    order = 30.0 - _sort_key(source)[0]
    dot, dust = (
        rr.Points2D.from_fields(colors=[colour], radii=[radius], draw_order=order)
        for radius in (POINT_UI, INVISIBLE_RADIUS)
    )
    outline = rr.Boxes2D.from_fields(colors=[colour], radii=[LINE_UI], draw_order=order - 10.0)
    curve = rr.Ellipses2D.from_fields(
        colors=[colour], line_radii=[LINE_UI], draw_order=order - 10.0
    )
    return dot, dust, outline, curve


def _sort_key(source: str) -> tuple[int, str]:
    """Return the index of a source in the table of colours; unknown sources come last."""
    return list(RGB).index(source if source in RGB else "other"), source
