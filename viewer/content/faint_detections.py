"""Find detections in confidence maps: predict leaves the faintest out, but writes whole maps."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dmrl.geometry.frames import STRIDE_PX
from dmrl.learn.inference.decode_grids import DUPLICATE_RADIUS_PX, decode

MIN_CONFIDENCE, MOST = 0.001, 50
"""Least confidence of a peak of a map, and most peaks of an image."""
DETECTION_FIELDS = ("u_px", "v_px", "depth_m", "confidence")
GRID_FIELDS = ("rows", "cols", "channels", "data", "stride_px")


def find_faint(
    grid: Mapping[str, Any], found: Sequence[Mapping[str, Any]]
) -> list[dict[str, float]]:
    """Return the peaks of an image's map that are not among its detections.

    Parameters
    ----------
    grid
        Fields of GridMap. Empty, or a map of another size than it says: it has no peaks.
    found
        Fields of Detection; a peak within `DUPLICATE_RADIUS_PX` of one is that detection.

    Returns
    -------
    list
        Fields of Detection; pixels are those of the centre of a cell.
    """
    shape = [len(grid.get("channels", ())), grid.get("rows", 0), grid.get("cols", 0)]
    data = np.frombuffer(grid.get("data", b""), np.uint8)
    if not len(data) or len(data) != 4 * math.prod(shape):
        return []
    named = dict(zip(grid["channels"], data.view("<f4").reshape(shape), strict=True))
    if not {"confidence", "depth_m"} <= set(named):
        return []
    peaks = decode(
        named["confidence"][None],
        named["depth_m"][None],
        stride_px=grid["stride_px"] or STRIDE_PX,
        most=MOST,
        min_confidence=MIN_CONFIDENCE,
    )
    columns = [getattr(peaks, name)[0, : peaks.count[0]].tolist() for name in DETECTION_FIELDS]
    told = np.array([(one["u_px"], one["v_px"]) for one in found]).reshape(-1, 2)
    return [
        dict(zip(DETECTION_FIELDS, row, strict=True))
        for row in zip(*columns, strict=True)
        if row[-1] >= MIN_CONFIDENCE
        and not (np.linalg.norm(told - row[:2], axis=1) < DUPLICATE_RADIUS_PX).any()
    ]
