"""Backends: ways to compute a network's output without torch, behind one interface."""

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.int8 import reference
from dmrl.deploy.int8.graph import (
    Float32,
    FloatGraph,
    compute_rgb_tensors,
    rgb_to_grey,
    select_outputs,
)
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.quantise import HEAD_OF_CHANNEL
from dmrl.learn.inference.decode_grids import Grids

Images = NDArray[np.uint8] | Sequence[NDArray[np.uint8]]
"""(N, height, width, 3) RGB, or N images of one size."""
Outputs = dict[str, Float32]
"""(N, rows, cols) by channel name, as in ``channels`` of the network's class."""
Int8Grids = dict[str, NDArray[np.int8]]
"""(rows, cols) by the name of the head."""


class Backend(Protocol):
    """Protocol of a backend."""

    def outputs(self, images: Images) -> Outputs:
        """Compute the output for (N, height, width, 3) RGB images of the network's size."""


def to_grids(outputs: Outputs) -> Grids:
    """Convert the output for N images to `Grids`."""
    # Clip far beyond meaningful values, so that exp does not overflow.
    logit = np.clip(outputs["confidence"].astype(np.float64), -60, 60)
    depth_m = np.exp(np.minimum(outputs["log_depth"], 60))
    offset = None
    if "offset_u" in outputs and "offset_v" in outputs:
        offset = np.stack([outputs["offset_u"], outputs["offset_v"]], axis=1)
    return Grids((1 / (1 + np.exp(-logit))).astype(np.float32), depth_m, offset)


class FloatBackend:
    """Float network in NumPy, batch normalisation folded.

    Parameters
    ----------
    graph
        The network.
    channels
        Names of the channels of its output.
    """

    def __init__(self, graph: FloatGraph, channels: tuple[str, ...]) -> None:
        self.graph = graph
        self.channels = channels

    def outputs(self, images: Images) -> Outputs:
        """Compute the output for (N, height, width, 3) RGB images."""
        output = select_outputs(self.graph, compute_rgb_tensors(self.graph, np.asarray(images)))
        return dict(zip(self.channels, output.swapaxes(0, 1), strict=True))


class Int8Backend:
    """Int8 network, computed image by image.

    Parameters
    ----------
    network
        The network.
    run
        Function from a (height, width, channels) image, in the network's format, to the heads' int8
        grids.
    """

    def __init__(
        self, network: IntegerNetwork, run: Callable[[NDArray[np.uint8]], Int8Grids]
    ) -> None:
        self.network = network
        self.run = run

    def outputs(self, images: Images) -> Outputs:
        """Compute the dequantized heads for (N, height, width, 3) RGB images."""
        seen = [to_network_input(self.network, image) for image in images]
        return dequantize_heads(self.network, [self.run(image) for image in seen])


def build_reference_backend(network: IntegerNetwork) -> Int8Backend:
    """Return the backend of the integer reference, in NumPy."""
    return Int8Backend(network, lambda image: reference.run_network(network, image))


def to_network_input(network: IntegerNetwork, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert a (height, width, 3) RGB image to the network's format: RGB, or grey."""
    return rgb_to_grey(image[None])[0] if network.channels == 1 else image


def dequantize_heads(network: IntegerNetwork, levels: list[Int8Grids]) -> Outputs:
    """Dequantize the int8 grids of N images."""
    return {
        channel: reference.dequantize(
            network.heads[head], np.stack([grids[head] for grids in levels])
        ).astype(np.float32)
        for channel, head in HEAD_OF_CHANNEL.items()
        if head in network.heads
    }
