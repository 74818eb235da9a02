"""Detect robots in images, over several views of each."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby

import numpy as np

from dmrl.deploy.detector import Detector
from dmrl.deploy.middle_look import magnify_middle, map_detections, map_grids
from dmrl.images.codec import Rgb
from dmrl.learn.inference.decode_grids import Detections, Grids
from dmrl.learn.inference.decode_grids import decode as find
from dmrl.learn.inference.tta import TTA_VIEWS, apply_view, merge_views, undo_view


@dataclass(frozen=True, slots=True)
class DetectionOptions:
    """Options of the detection; see ``dmrl.stages.predict.Settings``.

    With ``magnify``, the caller says which images are magnified: every second one of a camera.
    """

    min_confidence: float
    most: int
    views: int
    magnify: bool = False


def detect_images(
    images: Sequence[Rgb],
    detector: Detector,
    options: DetectionOptions,
    magnified: Sequence[bool] | None = None,
) -> Iterator[tuple[Detections, Grids]]:
    """Yield the detections and grids of each run of images of one size.

    Parameters
    ----------
    images
        (height, width, 3) RGB each.
    detector
        The opened model.
    options
        Limits on the detections, and the number of views.
    magnified
        Whether the model sees the middle of each image alone, magnified. None: no image's.
    """
    flags = [False] * len(images) if magnified is None else magnified
    for _, same_size in groupby(zip(images, flags, strict=True), key=lambda one: one[0].shape):
        pairs = list(same_size)
        group = [magnify_middle(image) if large else image for image, large in pairs]
        grids = detector.grids(group)
        found = _merge_views(group, grids, detector, options)
        if any(large := np.array([flag for _, flag in pairs])):
            height_px, width_px = group[0].shape[:2]
            found, grids = (
                map_detections(found, large, (width_px, height_px)),
                map_grids(grids, large),
            )
        yield found, grids


def _merge_views(
    images: list[Rgb], grids: Grids, detector: Detector, options: DetectionOptions
) -> Detections:
    """Return the detections in images, whose grids are given, over all views."""
    stride_px, (height_px, width_px, _) = detector.stride_px, images[0].shape
    most, least = options.most, options.min_confidence
    decode = partial(find, stride_px=stride_px, most=most, min_confidence=least)
    found = [decode(*grids)]
    for view in TTA_VIEWS[1 : options.views]:
        again = decode(*detector.grids(apply_view(np.stack(images), view, stride_px)))
        found.append(undo_view(again, view, stride_px, (height_px, width_px)))
    return merge_views(found, most=most, min_confidence=least) if len(found) > 1 else found[0]
