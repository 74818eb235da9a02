"""Calibration: value ranges of a network's tensors over calibration images."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.int8.graph import FloatGraph, compute_rgb_tensors
from dmrl.errors import SettingError

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ActivationRanges:
    """Ranges measured on calibration images.

    Parameters
    ----------
    low, high
        (channels,) smallest and largest value of every channel, for each tensor.
    images
        Number of images.
    height_px, width_px
        Size of the images.
    """

    low: tuple[Array, ...]
    high: tuple[Array, ...]
    images: int
    height_px: int
    width_px: int

    def merge(self, other: "ActivationRanges") -> "ActivationRanges":
        """Return the ranges over both sets of images, which have one size."""
        return ActivationRanges(
            tuple(np.minimum(a, b) for a, b in zip(self.low, other.low, strict=True)),
            tuple(np.maximum(a, b) for a, b in zip(self.high, other.high, strict=True)),
            self.images + other.images,
            self.height_px,
            self.width_px,
        )


def calibrate_ranges(graph: FloatGraph, batches: Iterable[NDArray[np.uint8]]) -> ActivationRanges:
    """Measure the range of every tensor over calibration images.

    Parameters
    ----------
    graph
        The network.
    batches
        (n, height, width, 3) RGB images, all of one size; converted to grey for a network of grey
        images.

    Raises
    ------
    SettingError
        If there are no images, each of them has a single colour, or a layer is zero for all of
        them.
    """
    ranges: ActivationRanges | None = None
    varied = False
    for batch in batches:
        varied = varied or bool((np.ptp(batch, axis=(1, 2)) > 0).any())
        more = _measure_ranges(graph, batch)
        ranges = more if ranges is None else ranges.merge(more)
    if ranges is None:
        raise SettingError("no images to calibrate on. Give a dataset with images")
    if not varied:
        raise SettingError(
            f"each of the {ranges.images} calibration images is of a single colour, so ranges "
            "cannot be measured. Give images as the camera takes them"
        )
    for layer, high, low in zip(graph.layers, ranges.high[1:], ranges.low[1:], strict=True):
        if not (high.any() or low.any()):
            raise SettingError(
                f"layer {layer.name} is zero for all of the {ranges.images} calibration images. "
                "Give more of them, or train the network"
            )
    return ranges


def _measure_ranges(graph: FloatGraph, images: NDArray[np.uint8]) -> ActivationRanges:
    tensors = compute_rgb_tensors(graph, images)
    return ActivationRanges(
        tuple(tensor.min(axis=(0, 2, 3)).astype(np.float64) for tensor in tensors),
        tuple(tensor.max(axis=(0, 2, 3)).astype(np.float64) for tensor in tensors),
        len(images),
        images.shape[1],
        images.shape[2],
    )
