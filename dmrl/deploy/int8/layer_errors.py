"""Quantization error of each layer: the int8 network against the float one, on the same images."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.int8 import reference
from dmrl.deploy.int8.graph import FloatGraph, compute_rgb_tensors, rgb_to_grey
from dmrl.deploy.int8.network import Conv, IntegerNetwork


@dataclass(frozen=True, slots=True)
class LayerErrorStats:
    """Quantization error of a layer.

    Parameters
    ----------
    name, kind
        Name and kind of the layer. A head, one channel of a layer's output, has the kind "head".
    shape
        Channels, rows and columns of its output.
    products
        Multiplications per image.
    low, high
        Smallest and largest representable real value.
    sqnr_db
        Signal-to-quantization-noise ratio, decibels, including errors of earlier layers. None: no
        difference.
    saturated
        Fraction of the values on the last level, 0 to 1.
    """

    name: str
    kind: str
    shape: tuple[int, int, int]
    products: int
    low: float
    high: float
    sqnr_db: float | None
    saturated: float


class _Output(NamedTuple):
    """Compared part of a tensor: the output of a layer, or a head, which is one channel of it."""

    name: str
    kind: str
    tensor: int
    channels: slice
    shape: tuple[int, int, int]
    products: int
    scale: float
    zero_point: int
    signed: bool

    @property
    def levels(self) -> tuple[int, int]:
        """First and last level."""
        return (-128, 127) if self.signed else (0, 255)


@dataclass
class _ErrorSums:
    signal: float = 0.0
    error: float = 0.0
    saturated: int = 0
    count: int = 0

    @property
    def sqnr_db(self) -> float | None:
        return float(10 * np.log10(self.signal / self.error)) if self.signal * self.error else None


def compute_layer_errors(
    graph: FloatGraph, network: IntegerNetwork, images: Iterable[NDArray[np.uint8]]
) -> list[LayerErrorStats]:
    """Compare every layer, then every head, of the int8 and the float network.

    Parameters
    ----------
    graph
        Float network.
    network
        Int8 network of it.
    images
        (height, width, 3) RGB images.
    """
    compared = [(output, _ErrorSums()) for output in _iter_outputs(network)]
    for image in images:
        seen = rgb_to_grey(image[None])[0] if network.channels == 1 else image
        wanted = compute_rgb_tensors(graph, image[None])
        got = list(reference.iter_tensors(network, seen))
        for one, sums in compared:
            real = wanted[one.tensor][0][one.channels]
            levels = got[one.tensor][one.channels]
            sums.signal += float((real.astype(np.float64) ** 2).sum())
            sums.error += float(((real - one.scale * (levels - one.zero_point)) ** 2).sum())
            last = one.levels if one.signed else one.levels[1:]
            sums.saturated += int(np.isin(levels, last).sum())
            sums.count += levels.size
    return [
        LayerErrorStats(
            one.name,
            one.kind,
            one.shape,
            one.products,
            one.scale * (one.levels[0] - one.zero_point),
            one.scale * (one.levels[1] - one.zero_point),
            sums.sqnr_db,
            sums.saturated / max(sums.count, 1),
        )
        for one, sums in compared
    ]


def _iter_outputs(network: IntegerNetwork) -> Iterator[_Output]:
    shapes, whole = network.shapes, slice(None)
    of_heads = {head.tensor for head in network.heads.values()}
    products = [
        layer.count_macs((shapes[layer.source],)) if isinstance(layer, Conv) else 0
        for layer in network.layers
    ]
    for tensor, layer in enumerate(network.layers, start=1):
        if tensor not in of_heads:
            about = (shapes[tensor], products[tensor - 1], layer.scale, 0, layer.signed)
            yield _Output(layer.name, layer.kind, tensor, whole, *about)
    for name, head in network.heads.items():
        channels, rows, cols = shapes[head.tensor]
        label = f"{network.layers[head.tensor - 1].name}[{head.channel}] {name}"
        own = slice(head.channel, head.channel + 1)
        share = products[head.tensor - 1] // channels
        about = ((1, rows, cols), share, head.scale, head.zero_point, True)
        yield _Output(label, "head", head.tensor, own, *about)
