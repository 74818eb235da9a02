"""Cross-layer equalization (Nagel et al. 2019, eq. 11): like ranges for all channels of a tensor.

An int8 tensor has one scale, so a channel with small values has few levels. Dividing a channel by s
and multiplying the weights that read it by s does not change the float network, since ReLU and
max-pool commute with positive factors. ``s = range of the channel ^ a / range of the weights that
read it ^ (1 - a)`` divides the rounding loss between the two (Xiao et al. 2023, SmoothQuant).
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.int8.activation_ranges import ActivationRanges
from dmrl.deploy.int8.graph import FloatConv, FloatGraph

Array = NDArray[np.float64]

RANGE_EXPONENT = 0.9
"""Exponent a. 1/2 would divide the loss equally, but `rounding` compensates most of the weights'
rounding errors."""
MAX_FACTOR = 32.0
"""Largest factor, so that a channel that is nearly always zero is not amplified without limit."""


def equalise_channels(
    graph: FloatGraph, ranges: ActivationRanges
) -> tuple[FloatGraph, ActivationRanges]:
    """Equalize the channel ranges of a network; return the equivalent network and its ranges.

    Tensors that a sum or a max-pool connects are divided by the same factors, which the
    convolutions that read them compensate. The image, the outputs and tensors connected to them are
    not changed.
    """
    convs = {k: layer for k, layer in enumerate(graph.layers) if isinstance(layer, FloatConv)}
    low, high = list(ranges.low), list(ranges.high)
    fixed = {0, *(tensor for tensor, _ in graph.outputs)}
    for tensors in _tied_tensors(graph):
        readers = [k for k, layer in convs.items() if layer.sources[0] in tensors]
        if fixed & tensors or not readers:
            continue
        spans = [high[tensor] - low[tensor] for tensor in sorted(tensors)]
        factor = _channel_factors(spans, [convs[k] for k in readers])
        for tensor in tensors:
            low[tensor], high[tensor] = low[tensor] / factor, high[tensor] / factor
            if tensor - 1 in convs:
                convs[tensor - 1] = _divide_output(convs[tensor - 1], factor)
        for k in readers:
            convs[k] = _multiply_input(convs[k], factor)
    layers = [convs.get(k, layer) for k, layer in enumerate(graph.layers)]
    return replace(graph, layers=tuple(layers)), replace(ranges, low=tuple(low), high=tuple(high))


def _tied_tensors(graph: FloatGraph) -> list[set[int]]:
    """Return all tensors, in sets whose channels must share factors, in order of computation."""
    sets = [{tensor} for tensor in range(len(graph.layers) + 1)]
    for tensor, layer in enumerate(graph.layers, start=1):
        for other in layer.sources[1:] if isinstance(layer, FloatConv) else layer.sources:
            if sets[other] is not sets[tensor]:
                sets[tensor] |= sets[other]
                for member in sets[tensor]:
                    sets[member] = sets[tensor]
    return [each for tensor, each in enumerate(sets) if tensor == min(each)]


def _channel_factors(spans: list[Array], readers: list[FloatConv]) -> Array:
    """Return (channels,) the divisor of each channel; the largest channel is not changed."""
    read = np.max([_largest_weights(layer) for layer in readers], axis=0)
    span = np.max([_relative_range(span) for span in spans], axis=0)
    ratio = span**RANGE_EXPONENT / _relative_range(read) ** (1 - RANGE_EXPONENT)
    factor: Array = np.clip(ratio, 1 / MAX_FACTOR, MAX_FACTOR)
    return factor


def _relative_range(values: Array) -> Array:
    most = values.max()
    return np.maximum(values / most, 1e-3) if most > 0 else np.ones_like(values)


def _largest_weights(layer: FloatConv) -> Array:
    """Return (channels,) the largest weight that reads each input channel."""
    weight = np.abs(layer.weight)
    largest: Array = weight.max(axis=(1, 2, 3)) if layer.groups > 1 else weight.max(axis=(0, 2, 3))
    return largest


def _divide_output(layer: FloatConv, factor: Array) -> FloatConv:
    weight = layer.weight / factor[:, None, None, None]
    return replace(layer, weight=weight, bias=layer.bias / factor)


def _multiply_input(layer: FloatConv, factor: Array) -> FloatConv:
    shape = (-1, 1, 1, 1) if layer.groups > 1 else (1, -1, 1, 1)
    return replace(layer, weight=layer.weight * factor.reshape(shape))
