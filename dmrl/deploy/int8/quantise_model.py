"""Quantise a float network by images: fold, calibrate, equalise, round."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.int8.activation_ranges import calibrate_ranges
from dmrl.deploy.int8.equalisation import equalise_channels
from dmrl.deploy.int8.graph import FloatGraph, build_graph
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.quantise import NetworkInfo, quantise_network
from dmrl.deploy.int8.rounding import measure_moments
from dmrl.learn.inference.loaded_model import Model
from dmrl.learn.networks.trace import trace_operations
from dmrl.terminal.progress import track

MAX_ROUNDING_IMAGES = 50
"""Most images that the weights are rounded by: each has hundreds of places or more."""


class ImageSource(Protocol):
    """Images by their number."""

    def __len__(self) -> int:
        """Return the number of images."""

    def images(self, rows: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
        """Yield the images of these numbers, (height, width, 3) RGB."""


class Quantised(NamedTuple):
    """The float graph, equalised, the int8 network, and the number of calibration images."""

    graph: FloatGraph
    network: IntegerNetwork
    images: int


def quantise_model(model: Model, source: ImageSource, most: int, *, grey: bool) -> Quantised:
    """Quantise a network.

    Parameters
    ----------
    model
        The float network.
    source
        Images of its size.
    most
        Most calibration images, evenly spread.
    grey
        Whether the int8 network takes grey images.

    Raises
    ------
    ModelError
        If it has a layer that int8 cannot carry.
    SettingError
        If nothing can be learned from the images.
    """
    graph = build_graph(trace_operations(model.network))
    graph = graph.to_grey() if grey else graph
    rows = pick_evenly(len(source), most)
    calibration = track(source.images(rows), "Calibrating", len(rows))
    ranges = calibrate_ranges(graph, (image[None] for image in calibration))
    graph, ranges = equalise_channels(graph, ranges)
    rows = pick_evenly(len(source), min(most, MAX_ROUNDING_IMAGES))
    moments = measure_moments(graph, track(source.images(rows), "Rounding", len(rows)))
    network = quantise_network(graph, ranges, _describe(model), moments)
    return Quantised(graph, network, ranges.images)


def pick_evenly(count: int, most: int) -> list[int]:
    """Return at most ``most`` numbers below ``count``, ascending, evenly spread."""
    numbers: list[int] = np.unique(np.linspace(0, count - 1, min(count, most)).astype(int)).tolist()
    return numbers


def _describe(model: Model) -> NetworkInfo:
    network = model.network
    name = model.name or model.architecture
    return NetworkInfo(
        name, model.architecture, network.stride_px, network.channels, model.threshold
    )
