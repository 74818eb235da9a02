"""Quantization error of each layer: the int8 network against the float one, on the same images."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.int8 import graph as floats
from dmrl.deploy.int8 import reference
from dmrl.deploy.int8.graph import Float32, FloatGraph, rgb_to_grey
from dmrl.deploy.int8.network import Conv, IntegerNetwork
from dmrl.deploy.int8.reference import QuantizedTensor


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


@dataclass
class _ErrorSums:
    signal: float = 0.0
    error: float = 0.0
    saturated: int = 0
    count: int = 0

    def accumulate(
        self, wanted: Float32, got: NDArray[np.floating], levels: NDArray[np.integer], signed: bool
    ) -> None:
        self.signal += float((wanted.astype(np.float64) ** 2).sum())
        self.error += float(((wanted - got) ** 2).sum())
        last = (levels == 127) | (levels == -128) if signed else levels == 255
        self.saturated += int(last.sum())
        self.count += levels.size

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
    layers = [_ErrorSums() for _ in network.layers]
    heads = {name: _ErrorSums() for name in network.heads}
    for image in images:
        seen = rgb_to_grey(image[None])[0] if network.channels == 1 else image
        wanted = floats.compute_tensors(graph, floats.normalize_images(seen[None]))
        got = list(reference.iter_tensors(network, seen))
        _accumulate_image(network, [tensor[0] for tensor in wanted], got, layers, heads)
    return [*_summarise_layers(network, layers), *_summarise_heads(network, heads)]


def _accumulate_image(
    network: IntegerNetwork,
    wanted: list[Float32],
    got: list[QuantizedTensor],
    layers: list[_ErrorSums],
    heads: dict[str, _ErrorSums],
) -> None:
    for sums, layer, real, levels in zip(layers, network.layers, wanted[1:], got[1:], strict=True):
        sums.accumulate(real, levels * layer.scale, levels, layer.signed)
    for name, head in network.heads.items():
        levels = got[head.tensor][head.channel]
        values = reference.dequantize(head, levels.astype(np.int8))
        heads[name].accumulate(wanted[head.tensor][head.channel], values, levels, signed=True)


def _summarise_layers(network: IntegerNetwork, sums: list[_ErrorSums]) -> list[LayerErrorStats]:
    shapes = network.shapes
    of_heads = {head.tensor for head in network.heads.values()}
    return [
        LayerErrorStats(
            layer.name,
            layer.kind,
            shapes[k + 1],
            layer.count_macs((shapes[layer.source],)) if isinstance(layer, Conv) else 0,
            -128 * layer.scale if layer.signed else 0.0,
            (127 if layer.signed else 255) * layer.scale,
            sums[k].sqnr_db,
            sums[k].saturated / max(sums[k].count, 1),
        )
        for k, layer in enumerate(network.layers)
        if k + 1 not in of_heads
    ]


def _summarise_heads(network: IntegerNetwork, sums: dict[str, _ErrorSums]) -> list[LayerErrorStats]:
    out = []
    for name, head in network.heads.items():
        layer = network.layers[head.tensor - 1]
        assert isinstance(layer, Conv)
        channels, *grid = network.shapes[head.tensor]
        source = network.shapes[layer.source]
        low, high = reference.dequantize(head, np.array([-128, 127], np.int8))
        out.append(
            LayerErrorStats(
                f"{layer.name}[{head.channel}] {name}",
                "head",
                (1, grid[0], grid[1]),
                layer.count_macs((source,)) // channels,
                float(low),
                float(high),
                sums[name].sqnr_db,
                sums[name].saturated / max(sums[name].count, 1),
            )
        )
    return out
