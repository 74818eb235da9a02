"""Cross-layer equalisation (Nagel et al. 2019, eq. 11): channels of one tensor to like ranges.

An int8 tensor has one scale, so a channel that stays small has few levels. Dividing a channel
by s and multiplying the weights that read it by s changes nothing in the float network, since
ReLU and max-pool pass a positive factor on. ``s = range of the channel ^ a / range of the
weights that read it ^ (1 - a)`` shares the loss between the two (Xiao et al. 2023, SmoothQuant).
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.graph import FloatConv, FloatPool, Graph
from dmrl.deploy.ranges import Ranges

Array = NDArray[np.float64]

SHARE = 0.9
"""The exponent a. 1/2 were fair, but what the weights lose, `rounding` mostly makes good."""
MOST = 32.0
"""Largest factor: a channel that is nearly always zero is not blown up."""


def equalise(graph: Graph, ranges: Ranges) -> tuple[Graph, Ranges]:
    """The same network with like ranges of channels, and its ranges.

    Channels of a tensor are scaled where a convolution gives it and convolutions alone, or
    max-pools on the way to them, read it; a sum needs its two tensors as they are.
    """
    convs = {k: layer for k, layer in enumerate(graph.layers) if isinstance(layer, FloatConv)}
    alone = [k for k, layer in convs.items() if len(layer.sources) == 1]
    low, high = list(ranges.low), list(ranges.high)
    for index in alone:
        passed, readers = _followed(graph, index + 1)
        if not readers:
            continue
        factor = _factor(high[index + 1] - low[index + 1], [convs[k] for k in readers])
        convs[index] = _output_divided(convs[index], factor)
        for k in readers:
            convs[k] = _input_multiplied(convs[k], factor)
        for tensor in passed:
            low[tensor], high[tensor] = low[tensor] / factor, high[tensor] / factor
    layers = [convs.get(k, layer) for k, layer in enumerate(graph.layers)]
    return replace(graph, layers=tuple(layers)), replace(ranges, low=tuple(low), high=tuple(high))


def _followed(graph: Graph, tensor: int) -> tuple[list[int], list[int]]:
    """The tensor and its pooled forms, and the convolutions that read them; none if others do."""
    if any(tensor == output for output, _ in graph.outputs):
        return [], []
    passed, convs = [tensor], []
    for k, layer in enumerate(graph.layers):
        if tensor not in layer.sources:
            continue
        if isinstance(layer, FloatConv) and tensor not in layer.sources[1:]:
            convs.append(k)
        elif isinstance(layer, FloatPool):
            more, further = _followed(graph, k + 1)
            if not further:
                return [], []
            passed += more
            convs += further
        else:
            return [], []
    return passed, convs


def _factor(span: Array, readers: list[FloatConv]) -> Array:
    """(channels,) what each channel is divided by; its largest channel stays as it is."""
    read = np.max([_read_by(layer) for layer in readers], axis=0)
    ratio = _relative(span) ** SHARE / _relative(read) ** (1 - SHARE)
    factor: Array = np.clip(ratio, 1 / MOST, MOST)
    return factor


def _relative(values: Array) -> Array:
    most = values.max()
    return np.maximum(values / most, 1e-3) if most > 0 else np.ones_like(values)


def _read_by(layer: FloatConv) -> Array:
    """(channels,) largest weight on each input channel."""
    weight = np.abs(layer.weight)
    largest: Array = weight.max(axis=(1, 2, 3)) if layer.groups > 1 else weight.max(axis=(0, 2, 3))
    return largest


def _output_divided(layer: FloatConv, factor: Array) -> FloatConv:
    weight = layer.weight / factor[:, None, None, None]
    return replace(layer, weight=weight, bias=layer.bias / factor)


def _input_multiplied(layer: FloatConv, factor: Array) -> FloatConv:
    shape = (-1, 1, 1, 1) if layer.groups > 1 else (1, -1, 1, 1)
    return replace(layer, weight=layer.weight * factor.reshape(shape))
