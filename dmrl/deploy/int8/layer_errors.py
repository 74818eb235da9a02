"""Quantization error of each layer: the int8 network against the float one, on the same images."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.int8 import reference
from dmrl.deploy.int8.graph import FloatGraph, compute_rgb_tensors, rgb_to_grey
from dmrl.deploy.int8.layers import Shape
from dmrl.deploy.int8.network import IntegerNetwork


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
    shape: Shape
    products: int
    low: float
    high: float
    sqnr_db: float | None
    saturated: float


class _Output(NamedTuple):
    """Compared part of a tensor: the output of a layer, or a head, which is one channel of it."""

    about: tuple[str, str, Shape, int]
    """The first fields of `LayerErrorStats`."""
    tensor: int
    channels: slice
    scale: float
    zero_point: int
    signed: bool

    @property
    def levels(self) -> tuple[int, int]:
        """First and last level."""
        return (-128, 127) if self.signed else (0, 255)


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
    outputs = list(_iter_outputs(network))
    totals = np.zeros((len(outputs), 4))
    for image in images:
        seen = rgb_to_grey(image[None])[0] if network.channels == 1 else image
        wanted = compute_rgb_tensors(graph, image[None])
        got = list(reference.iter_tensors(network, seen))
        for one, sums in zip(outputs, totals, strict=True):
            real = wanted[one.tensor][0][one.channels].astype(np.float64)
            levels = got[one.tensor][one.channels]
            off = real - one.scale * (levels - one.zero_point)
            last = np.isin(levels, one.levels if one.signed else one.levels[1:])
            sums += (real**2).sum(), (off**2).sum(), last.sum(), levels.size
    return [_summarize(one, *sums.tolist()) for one, sums in zip(outputs, totals, strict=True)]


def _summarize(
    one: _Output, signal: float, error: float, saturated: float, count: float
) -> LayerErrorStats:
    low, high = (one.scale * (level - one.zero_point) for level in one.levels)
    sqnr_db = float(10 * np.log10(signal / error)) if signal * error else None
    return LayerErrorStats(*one.about, low, high, sqnr_db, saturated / max(count, 1))


def _iter_outputs(network: IntegerNetwork) -> Iterator[_Output]:
    shapes, whole = network.shapes, slice(None)
    of_heads = {head.tensor for head in network.heads.values()}
    products = network.layer_macs
    for tensor, layer in enumerate(network.layers, start=1):
        if tensor not in of_heads:
            about = (layer.name, layer.kind, shapes[tensor], products[tensor - 1])
            yield _Output(about, tensor, whole, layer.scale, 0, layer.signed)
    for name, head in network.heads.items():
        channels, rows, cols = shapes[head.tensor]
        label = f"{network.layers[head.tensor - 1].name}[{head.channel}] {name}"
        about = (label, "head", (1, rows, cols), products[head.tensor - 1] // channels)
        own = slice(head.channel, head.channel + 1)
        yield _Output(about, head.tensor, own, head.scale, head.zero_point, True)
