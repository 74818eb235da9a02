"""Test-time augmentation: views of one image, shifted by parts of a cell and mirrored. NumPy only.

The error of a network depends on the position of the robot within its cell, and differs between
left and right. The median over views has a smaller error. It is too slow in flight but suits
labelling.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.images.codec import Rgb
from dmrl.learn.inference.decode_grids import DETECTION_COLUMNS, Detections
from dmrl.learn.inference.tta_views import TTA_VIEWS as TTA_VIEWS
from dmrl.learn.inference.tta_views import TtaView as TtaView

DetectionRows = NDArray[np.float64]

MERGE_RADIUS_PX = 16.0
"""Detections of different views closer than this, in pixels, belong to one robot."""


def apply_view(images: Rgb, view: TtaView, stride_px: int) -> Rgb:
    """Apply a view to (N, H, W, 3) images; the border is repeated where it shifts in."""
    right_px, down_px = _shift_px(view, stride_px)
    reach = stride_px
    padded = np.pad(images, ((0, 0), (reach, reach), (reach, reach), (0, 0)), mode="edge")
    padded = padded[:, :, ::-1] if view.mirrored else padded
    rows = slice(reach - down_px, reach - down_px + images.shape[1])
    cols = slice(reach - right_px, reach - right_px + images.shape[2])
    return np.ascontiguousarray(padded[:, rows, cols])


def undo_view(
    found: Detections, view: TtaView, stride_px: int, size_px: tuple[int, int]
) -> Detections:
    """Map detections in a view back to the N images, which have this height and width."""
    height_px, width_px = size_px
    right_px, down_px = _shift_px(view, stride_px)
    u_px, v_px = found.u_px - right_px, found.v_px - down_px
    u_px = width_px - u_px if view.mirrored else u_px
    columns = {name: getattr(found, name) for name in DETECTION_COLUMNS}
    columns |= {"u_px": np.clip(u_px, 0, width_px), "v_px": np.clip(v_px, 0, height_px)}
    return Detections(**columns, count=found.count)


def merge_views(
    views: Sequence[Detections], *, most: int = 20, min_confidence: float = 0.01
) -> Detections:
    """Merge the detections of several views of N images.

    Starting from the most confident detection, the nearest one of each other view within
    `MERGE_RADIUS_PX` belongs to the same robot. Position, depth and sigma are medians; the class is
    that of the first. The confidence is the mean over all views, 0 for a view without a detection.

    Parameters
    ----------
    views
        Detections of each view, mapped back to the images.
    most, min_confidence
        As in `decode`.
    """
    images = [
        _select_best(
            list(_iter_robots(_stack_views(views, image), len(views))), most, min_confidence
        )
        for image in range(len(views[0].count))
    ]
    wide = max(map(len, images))
    table = np.zeros((len(images), wide, len(DETECTION_COLUMNS)))
    for rows, mine in zip(table, images, strict=True):
        rows[: len(mine)] = mine
    columns: dict[str, Any] = dict(zip(DETECTION_COLUMNS, np.moveaxis(table, 2, 0), strict=True))
    columns["class_id"] = columns["class_id"].astype(np.int64)
    return Detections(**columns, count=np.array([len(mine) for mine in images]))


def _shift_px(view: TtaView, stride_px: int) -> tuple[int, int]:
    return round(view.right * stride_px), round(view.down * stride_px)


def _stack_views(views: Sequence[Detections], image: int) -> DetectionRows:
    """Return (D, 1 + columns) view number and detections of one image, most confident first."""
    parts = [
        np.column_stack(
            [np.full(found.count[image], number)]
            + [getattr(found, name)[image, : found.count[image]] for name in DETECTION_COLUMNS]
        )
        for number, found in enumerate(views)
    ]
    rows = np.concatenate(parts)
    order = np.argsort(-rows[:, 1 + DETECTION_COLUMNS.index("confidence")], kind="stable")
    return np.asarray(rows[order])


def _iter_robots(rows: DetectionRows, views: int) -> Iterator[DetectionRows]:
    """Yield the merged row of each robot, (columns,)."""
    confidence, class_id = map(DETECTION_COLUMNS.index, ("confidence", "class_id"))
    while len(rows):
        away_px = np.hypot(*(rows[:, 1:3] - rows[0, 1:3]).T)
        near = np.flatnonzero(away_px <= MERGE_RADIUS_PX)
        near = near[np.argsort(away_px[near], kind="stable")]
        mine = near[np.unique(rows[near, 0], return_index=True)[1]]
        robot = np.median(rows[mine, 1:], axis=0)
        robot[confidence] = rows[mine, 1 + confidence].sum() / views
        robot[class_id] = rows[0, 1 + class_id]
        yield robot
        rows = np.delete(rows, mine, axis=0)


def _select_best(robots: list[DetectionRows], most: int, min_confidence: float) -> DetectionRows:
    """Return (K, columns) rows, the most confident first; at least one."""
    table = np.stack(robots)
    confidence = table[:, DETECTION_COLUMNS.index("confidence")]
    order = np.argsort(-confidence, kind="stable")[:most]
    kept = max(int((confidence[order] >= min_confidence).sum()), 1)
    return np.asarray(table[order[:kept]])
