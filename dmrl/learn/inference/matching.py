"""Matching of detections with labels, by two rules for two purposes.

*Localization error* (`compute_errors`): the N most confident detections of an image with N labels
are assigned one-to-one with the least total distance. With one label, this is the most confident
cell. *Correct detections* (`match_within_radius`): in order of confidence, each detection takes
the nearest label within a radius that is still unmatched.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from dmrl.learn.inference.decode_grids import Detections

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Points:
    """Labels or detections of many images, flat, one row each.

    Parameters
    ----------
    image
        (M,) index of the image, ascending. Detections of one image: most confident first.
    u_px, v_px, depth_m
        (M,) pixel and depth; NaN where a label has no depth.
    confidence
        (M,) 0 to 1; ones for labels.
    """

    image: Index
    u_px: Array
    v_px: Array
    depth_m: Array
    confidence: Array

    def __len__(self) -> int:
        return len(self.image)

    def ranks_in_image(self) -> Index:
        """Return (M,) the position of each row within its image, from 0."""
        return np.arange(len(self), dtype=np.int64) - np.searchsorted(self.image, self.image)

    @staticmethod
    def concatenate(parts: Sequence["Points"], first: Index) -> "Points":
        """Concatenate parts; image indices of part k are offset by ``first[k]``."""
        image = np.concatenate([part.image + first[k] for k, part in enumerate(parts)])
        columns = zip(*(part._columns() for part in parts), strict=True)
        return Points(image, *map(np.concatenate, columns))

    def select(self, keep: NDArray[np.bool_] | Index) -> "Points":
        """Return the chosen rows."""
        return Points(self.image[keep], *(column[keep] for column in self._columns()))

    @staticmethod
    def from_detections(found: Detections) -> "Points":
        """Return the decoded detections of N images."""
        image, place = np.nonzero(np.arange(found.u_px.shape[1]) < found.count[:, None])
        columns = (found.u_px, found.v_px, found.depth_m, found.confidence)
        return Points(image, *(column[image, place] for column in columns))

    def _columns(self) -> tuple[Array, Array, Array, Array]:
        return self.u_px, self.v_px, self.depth_m, self.confidence


@dataclass(frozen=True, slots=True)
class LabelErrors:
    """Detection minus label, one row per label; NaN if an image has too few detections.

    Parameters
    ----------
    u_px, v_px, depth_m
        (M,) pixel and depth errors.
    """

    u_px: Array
    v_px: Array
    depth_m: Array

    @property
    def norm_px(self) -> Array:
        """(M,) length of the pixel error; infinite without a detection."""
        length = np.hypot(self.u_px, self.v_px)
        return np.where(np.isnan(length), np.inf, length)


def compute_errors(labels: Points, detections: Points) -> LabelErrors:
    """Compute the localization error of every label, by the first rule of this module."""
    rows = assign_detections(labels, detections)
    missing = rows < 0

    def difference(label: Array, detection: Array) -> Array:
        if not len(detection):
            return np.full(len(label), np.nan)
        return np.where(missing, np.nan, detection[rows] - label)

    names = ("u_px", "v_px", "depth_m")
    return LabelErrors(*(difference(getattr(labels, k), getattr(detections, k)) for k in names))


def assign_detections(labels: Points, detections: Points) -> Index:
    """Return (M,) the row of the detection assigned to each label, -1 for none."""
    first = np.searchsorted(detections.image, labels.image)
    available = np.searchsorted(detections.image, labels.image, side="right") - first
    wanted = np.searchsorted(labels.image, labels.image, side="right") - np.searchsorted(
        labels.image, labels.image
    )
    out = np.where(available > 0, first, -1).astype(np.int64)
    ranks = labels.ranks_in_image()
    for start in np.flatnonzero((wanted > 1) & (available > 0) & (ranks == 0)):
        rows = slice(start, start + wanted[start])
        columns = slice(first[start], first[start] + min(wanted[start], available[start]))
        distance_px = np.hypot(
            labels.u_px[rows, None] - detections.u_px[columns],
            labels.v_px[rows, None] - detections.v_px[columns],
        )
        taken, chosen = linear_sum_assignment(distance_px)
        out[rows] = -1
        out[start + taken] = first[start] + chosen
    return out


def match_within_radius(labels: Points, detections: Points, radius_px: float | Array) -> Index:
    """Match each detection with a label within a radius; return (D,) label rows, -1 for none.

    ``radius_px`` is one radius, or (L,) one of each label.
    """
    out = np.full(len(detections), -1, np.int64)
    if not len(labels):
        return out
    radius_px = np.broadcast_to(radius_px, len(labels))
    places = labels.ranks_in_image()
    images = int(max(labels.image[-1], detections.image[-1] if len(detections) else 0)) + 1
    row_at = np.full((images, int(places.max()) + 1), -1, np.int64)
    row_at[labels.image, places] = np.arange(len(labels))
    ranks = detections.ranks_in_image()
    for rank in range(int(ranks.max(initial=-1)) + 1):
        chosen = np.flatnonzero(ranks == rank)
        image = detections.image[chosen]
        rows = row_at[image]
        distance_px = np.hypot(
            labels.u_px[rows] - detections.u_px[chosen, None],
            labels.v_px[rows] - detections.v_px[chosen, None],
        )
        distance_px[rows < 0] = np.inf
        nearest = np.argmin(distance_px, axis=1)
        every = np.arange(len(chosen))
        right = distance_px[every, nearest] <= radius_px[rows[every, nearest]]
        out[chosen[right]] = rows[right, nearest[right]]
        row_at[image[right], nearest[right]] = -1
    return out
