"""Post-training quantization of a float network to int8, from calibrated ranges.

Weights have one scale per output channel, activations one per tensor with zero point 0, and each
head its own scale. Ranges are the largest measured values. Clipping at a percentile costs accuracy:
the few large values are the robots.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.int8.activation_ranges import ActivationRanges
from dmrl.deploy.int8.graph import FloatAdd, FloatConv, FloatGraph, FloatPool
from dmrl.deploy.int8.layers import (
    GAIN_SHIFT,
    PIXEL_ZERO,
    SIGNED_OFFSET,
    Add,
    AnyLayer,
    Conv,
    Int32,
    MaxPool,
)
from dmrl.deploy.int8.network import CONFIDENCE_ONE, SUBPIXEL, Head, IntegerNetwork
from dmrl.deploy.int8.rounding import InputMoments, round_weights
from dmrl.errors import SettingError

Array = NDArray[np.float64]

HEAD_OF_CHANNEL = {
    "log_depth": "depth",
    "confidence": "confidence",
    "offset_u": "offset_u",
    "offset_v": "offset_v",
}
"""Head for each channel of a network's output; other channels are dropped."""
HEAD_MARGIN = 0.05
"""Margin of a head at either end, as a fraction of its range, for values beyond calibration."""
INT8_LEVELS = np.arange(-128.0, 128.0)
SHORTCUT_ROUNDING_LOSS = 0.5
"""Mean loss of rounding down a shortcut, in steps of the sum; the bias compensates it."""
MAX_GAIN_BITS = 16
"""Significant bits of a shortcut's gain. Its product with 8 bits is then exact in float32, too."""


@dataclass(frozen=True, slots=True)
class NetworkInfo:
    """Description of an integer network.

    Parameters
    ----------
    name, architecture, stride_px, threshold
        See `IntegerNetwork`.
    channels
        Names of the output channels, as in the network's class.
    """

    name: str
    architecture: str
    stride_px: int
    channels: tuple[str, ...]
    threshold: float


def quantise_network(
    graph: FloatGraph,
    ranges: ActivationRanges,
    about: NetworkInfo,
    moments: InputMoments | None = None,
) -> IntegerNetwork:
    """Quantize a float network to int8.

    Parameters
    ----------
    graph, ranges
        The network, and the ranges of its tensors.
    about
        Its description.
    moments
        Second moments of every convolution's inputs, for compensated rounding (GPTQ). Without them,
        each weight is rounded to the nearest level.

    Raises
    ------
    SettingError
        If the network has no confidence or no depth.
    """
    heads = _build_heads(graph, ranges, about)
    layers: list[AnyLayer] = []
    # Scale and type of every tensor so far; the first is the image.
    scales = [1 / PIXEL_ZERO]
    signed = [False]
    for index, layer in enumerate(graph.layers):
        tensor = index + 1
        own = [head for head in heads.values() if head.tensor == tensor]
        made: AnyLayer
        if isinstance(layer, FloatConv):
            made = _quantise_conv(layer, scales, ranges, tensor, own, (moments or {}).get(index))
        elif isinstance(layer, FloatAdd):
            made = _quantise_add(layer, scales, ranges, tensor)
        else:
            made = _quantise_pool(layer, scales, signed)
        layers.append(made)
        scales.append(made.scale)
        signed.append(made.signed)
    return IntegerNetwork(
        about.name,
        about.architecture,
        graph.channels,
        ranges.height_px,
        ranges.width_px,
        about.stride_px,
        tuple(layers),
        threshold=about.threshold,
        **heads,
    )


def _build_heads(
    graph: FloatGraph, ranges: ActivationRanges, about: NetworkInfo
) -> dict[str, Head]:
    """Build the heads of a network, by name."""
    heads = {
        HEAD_OF_CHANNEL[channel]: _build_head(
            graph, ranges, k, HEAD_OF_CHANNEL[channel], about.stride_px
        )
        for k, channel in enumerate(about.channels)
        if channel in HEAD_OF_CHANNEL
    }
    if absent := sorted({"confidence", "depth"} - heads.keys()):
        raise SettingError(
            f"{about.name} gives no {absent[0]}, which detections require. Use another network"
        )
    return heads


def _build_head(
    graph: FloatGraph, ranges: ActivationRanges, output: int, name: str, stride_px: int
) -> Head:
    """Build a head; its 256 levels cover its range, a margin, and 0.

    Each head has its own scale, since log depths and logits have different ranges.
    """
    tensor, channel = graph.outputs[output]
    least, most = ranges.low[tensor][channel], ranges.high[tensor][channel]
    room = HEAD_MARGIN * (most - least)
    low, high = min(least - room, 0.0), max(most + room, 0.0)
    scale = float(high - low) / 255 or 1.0
    zero_point = int(np.clip(np.rint(-128 - low / scale), -128, 127))
    meaning = HEAD_CONVERSIONS[name](scale * (INT8_LEVELS - zero_point), stride_px)
    return Head(tensor, channel, scale, zero_point, np.rint(meaning).astype(np.int32))


def _to_confidence_units(logit: Array, _stride_px: int) -> Array:
    confidence: Array = CONFIDENCE_ONE / (1 + np.exp(-np.clip(logit, -60, 60)))
    return confidence


def _to_millimetres(log_depth: Array, _stride_px: int) -> Array:
    depth: Array = np.minimum(1000 * np.exp(np.minimum(log_depth, 20)), 65535)
    return depth


def _to_subpixels(offset: Array, stride_px: int) -> Array:
    """Return the position in a cell, 1/16 px, of an offset from the cell centre in cells."""
    return np.clip((offset + 0.5) * stride_px * SUBPIXEL, -32768, 32767)


HEAD_CONVERSIONS: dict[str, Callable[[Array, int], Array]] = {
    "confidence": _to_confidence_units,
    "depth": _to_millimetres,
    "offset_u": _to_subpixels,
    "offset_v": _to_subpixels,
}


def _activation_scale(ranges: ActivationRanges, tensor: int, *, signed: bool) -> float:
    # Symmetric, zero point 0: the inner sum then needs no zero point terms.
    low, high = float(ranges.low[tensor].min()), float(ranges.high[tensor].max())
    return max(-low, high) / 127 if signed else high / 255


def _quantise_conv(
    layer: FloatConv,
    scales: list[float],
    ranges: ActivationRanges,
    tensor: int,
    heads: list[Head],
    moments: Array | None,
) -> Conv:
    outs = len(layer.bias)
    scale = 1.0 if heads else _activation_scale(ranges, tensor, signed=not layer.relu)
    out_scale = np.full(outs, scale)
    zero = np.full(outs, 0.0 if layer.relu else SIGNED_OFFSET)
    for head in heads:
        out_scale[head.channel] = head.scale
        zero[head.channel] += head.zero_point
    in_scales = [scales[source] for source in layer.sources]
    weight, bias, gain, divisor = _quantise_weights(layer, in_scales, out_scale, zero, moments)
    # Only the image has a zero point: sum(w * (q - 128)) = sum(w * q) - 128 * sum(w).
    if layer.sources[0] == 0:
        bias -= PIXEL_ZERO * weight.sum(axis=(1, 2, 3))
    multiplier, shift = _to_fixed_point(divisor)
    return Conv(
        layer.name,
        layer.sources[0],
        weight.astype(np.int8),
        bias.astype(np.int32),
        multiplier,
        shift,
        layer.stride,
        layer.dilation,
        layer.padding,
        layer.groups,
        signed=not layer.relu,
        pad_value=PIXEL_ZERO if layer.sources[0] == 0 else 0,
        scale=scale,
        shortcut=layer.sources[1] if len(layer.sources) > 1 else -1,
        gain=gain.astype(np.int32),
    )


def _quantise_weights(
    layer: FloatConv, in_scales: list[float], out_scale: Array, zero: Array, moments: Array | None
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Array]:
    """Return integer weights, bias, gain of a shortcut, and divisor of the sums, per channel.

    The bias includes the level of zero and half of the divisor, for rounding. The weight scale of a
    channel is the smallest that satisfies three bounds: its largest weight, the room that bias and
    shortcut need in int32, and the largest divisor. It is then raised slightly to make the divisor
    odd.
    """
    # Room in int32 for bias and shortcut beside the largest sum of weights times inputs.
    largest = np.abs(layer.weight).max(axis=(1, 2, 3))
    room = 2**31 - 1 - 128 * 255 * (layer.weight[0].size + 1)
    in_scale, *beside = in_scales
    more = np.abs(layer.bias) + (np.abs(zero) + 1) * out_scale
    more += 2.0**GAIN_SHIFT * 255 * sum(beside)
    least = 2.0**-30 * out_scale / in_scale
    weight_scale = np.maximum.reduce([largest / 127, more / (in_scale * room), least])
    divisor = _round_to_odd(out_scale / (in_scale * weight_scale))
    sum_scale = out_scale / divisor
    weight_scale = sum_scale / in_scale
    if moments is None:
        weight = np.rint(layer.weight / weight_scale[:, None, None, None]).astype(np.int64)
        bias = layer.bias
    else:
        weight, bias = round_weights(layer, weight_scale, moments)
    steps = np.rint(bias / sum_scale + SHORTCUT_ROUNDING_LOSS * len(beside))
    steps += np.rint(zero * divisor) + divisor // 2
    gains = [_limit_bits(2.0**GAIN_SHIFT * scale / sum_scale) for scale in beside]
    gain = np.array(gains).ravel().astype(np.int64)
    return weight, np.clip(steps, -room, room).astype(np.int64), gain, divisor


def _round_to_odd(divisor: Array) -> Array:
    """Return the odd number at or below each divisor; below 1, one over a whole number.

    No sum then lies halfway between two levels. All implementations that round to nearest agree, in
    integers or floats, whatever their rule for halves.
    """
    odd: Array = 2 * np.floor((np.maximum(divisor, 1) + 1) / 2) - 1
    return odd / np.ceil(np.maximum(1 / divisor, 1))


def _limit_bits(gain: Array) -> Array:
    """Round to whole numbers with at most `MAX_GAIN_BITS` significant bits."""
    unit = np.maximum(2.0 ** (np.frexp(gain)[1] - MAX_GAIN_BITS), 1.0)
    near: Array = np.rint(gain / unit) * unit
    return near


def _to_fixed_point(divisor: Array) -> tuple[Int32, int]:
    """Return requantization factors as ``multiplier / 2^shift``, the largest in 30 bits.

    Integers give the same rounding on every machine, including those without floating point. The
    shift is 32 unless a divisor is 4 or less. Multipliers are rounded up: with a shift of 32 and a
    whole divisor up to 4095, the product is the exact quotient, rounded down, of every
    representable sum. Otherwise, a sum of 24 bits has an error of an eighth of a step at most.
    """
    shift = min(32, 30 - int(np.frexp(1 / divisor.min())[1]))
    return np.ceil(2.0**shift / divisor).astype(np.int32), shift


def _quantise_add(
    layer: FloatAdd, scales: list[float], ranges: ActivationRanges, tensor: int
) -> Add:
    signed = not layer.relu and bool((ranges.low[tensor] < 0).any())
    a, b = (scales[source] for source in layer.sources)
    # A sum that cancels may be small, but the shift must be at least 1.
    scale = max(_activation_scale(ranges, tensor, signed=signed), max(a, b) * 2.0**-19)
    # 21 bits for the larger one: two terms of 8 and 21 bits and their sum fit in int32.
    _, exponent = np.frexp(max(a, b) / scale)
    shift = 21 - int(exponent)
    shift -= round(max(a, b) / scale * 2**shift) == 2**21  # rounded up to one bit more
    first, second = (round(part / scale * 2**shift) for part in (a, b))
    return Add(layer.name, layer.sources, (first, second), shift, signed=signed, scale=scale)


def _quantise_pool(layer: FloatPool, scales: list[float], signed: list[bool]) -> MaxPool:
    source = layer.sources[0]
    return MaxPool(layer.name, source, signed=signed[source], scale=scales[source])
