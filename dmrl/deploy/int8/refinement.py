"""On-device refinement of the last layer, in integers; the specification of the generated C.

Each update is a gradient step on one labelled image. The loss is a simplified training loss: the
squared error of the confidence, except in the cells around the robot's, plus the absolute error of
log depth and offsets in the robot's cell.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.int8.network import SUBPIXEL, Conv, IntegerNetwork
from dmrl.deploy.int8.reference import QuantizedTensor, convolve
from dmrl.errors import ModelError

Int64 = NDArray[np.int64]

UNIT_SLOPE = 4096
"""Fixed-point value of a slope of 1."""
FIXED_POINT_ONE = 65536
"""Fixed-point value of a step of an int8 weight, and of a learning rate of 1."""
MAX_WEIGHT, MAX_BIAS = 127 * FIXED_POINT_ONE, 2**30
"""Limits of learned weights and biases."""
UNIT_GAIN = 256
"""Fixed-point value of a gain of 1."""
MAX_GAIN = 2**26
"""Limit of gains, against overflow."""


class RefinementLabel(NamedTuple):
    """Label of the robot in an image: its centre, 1/16 px, and depth; 0 mm: no robot."""

    u_q4: int
    v_q4: int
    depth_mm: int


@dataclass(frozen=True, slots=True, eq=False)
class LearnedWeights:
    """Weights of the last layer during refinement.

    Parameters
    ----------
    weight
        (heads, features) in 1 / `FIXED_POINT_ONE` of a step of the int8 weights.
    bias
        (heads,) in steps of the sum.
    """

    weight: Int64
    bias: Int64


def find_last_layer(network: IntegerNetwork) -> Conv:
    """Return the layer that computes every head.

    Raises
    ------
    ModelError
        If there is no such layer, or it is not a 1x1 convolution of an unsigned tensor.
    """
    layer = network.layers[-1]
    at = {head.tensor for head in network.heads.values()}
    plain = isinstance(layer, Conv) and layer.kernel == layer.groups == layer.stride == 1
    unsigned = plain and layer.sources[0] > 0 and not network.layers[layer.sources[0] - 1].signed
    if at != {len(network.layers)} or not unsigned or len(layer.sources) > 1:
        raise ModelError(
            f"layer {layer.name} cannot be refined: that requires one 1x1 convolution after a ReLU "
            "for all heads. Export without --refine"
        )
    assert isinstance(layer, Conv)
    return layer


def initial_weights(network: IntegerNetwork) -> LearnedWeights:
    """Return the exported weights."""
    layer, rows = find_last_layer(network), _head_channels(network)
    weight = layer.weight[rows, :, 0, 0].astype(np.int64) * FIXED_POINT_ONE
    return LearnedWeights(weight, layer.bias[rows].astype(np.int64))


def _head_channels(network: IntegerNetwork) -> list[int]:
    return [head.channel for head in network.heads.values()]


def compute_gains(network: IntegerNetwork) -> tuple[Int64, Int64]:
    """Compute the update of weights and of biases for a slope and a rate of 1.

    Returns
    -------
    tuple
        (heads,) for weights and (heads,) for biases, in 1/256.
    """
    layer = find_last_layer(network)
    in_scale = network.layers[layer.source - 1].scale
    out_scale = np.array([head.scale for head in network.heads.values()])
    sum_scale = layer.multiplier[_head_channels(network)] / 2.0**layer.shift * out_scale
    weight_scale = sum_scale / in_scale
    weight = UNIT_GAIN * FIXED_POINT_ONE / UNIT_SLOPE * in_scale / weight_scale
    limited = [np.minimum(np.rint(g), MAX_GAIN) for g in (weight, UNIT_GAIN / sum_scale)]
    return limited[0].astype(np.int64), limited[1].astype(np.int64)


def apply_weights(network: IntegerNetwork, learned: LearnedWeights) -> IntegerNetwork:
    """Return the network with refined weights, rounded to int8."""
    layer, rows = find_last_layer(network), _head_channels(network)
    weight, bias = layer.weight.copy(), layer.bias.copy()
    weight[rows, :, 0, 0] = (learned.weight + FIXED_POINT_ONE // 2) >> 16
    bias[rows] = learned.bias
    last = replace(layer, weight=weight, bias=bias)
    return replace(network, layers=(*network.layers[:-1], last))


def take_gradient_step(
    network: IntegerNetwork,
    learned: LearnedWeights,
    features: QuantizedTensor,
    seen: RefinementLabel,
    rate: int,
) -> LearnedWeights:
    """Take one gradient step.

    Parameters
    ----------
    network
        Exported network.
    learned
        Weights so far.
    features
        (features, rows, cols) input of the last layer for an image.
    seen
        Label of the image.
    rate
        Learning rate times `FIXED_POINT_ONE`.

    Returns
    -------
    LearnedWeights
        Weights after the step.
    """
    layer = find_last_layer(apply_weights(network, learned))
    out = convolve(layer, features)
    weight, bias = learned.weight.copy(), learned.bias.copy()
    for h, (gain, bias_gain) in enumerate(zip(*compute_gains(network), strict=True)):
        slope = _output_gradient(
            network, list(network.heads)[h], out[_head_channels(network)[h]], seen
        )
        for row, col in np.argwhere(slope):
            x, by = features[:, row, col].astype(np.int64), slope[row, col]
            step = (by * x * rate * gain + (1 << 23)) >> 24
            weight[h] = np.clip(weight[h] - step, -MAX_WEIGHT, MAX_WEIGHT)
            step = (by * rate * bias_gain + (1 << 35)) >> 36
            bias[h] = np.clip(bias[h] - step, -MAX_BIAS, MAX_BIAS)
    return LearnedWeights(weight, bias)


def _output_gradient(
    network: IntegerNetwork, name: str, out: QuantizedTensor, seen: RefinementLabel
) -> Int64:
    """Return (rows, cols) the gradient of the loss by a head's output, times `UNIT_SLOPE`."""
    rows, cols = network.grid_shape
    step = SUBPIXEL * network.stride_px
    value = network.heads[name].table[out.astype(np.int64) + 128].astype(np.int64)
    down = np.arange(rows)[:, None] - (seen.v_q4 // step if seen.depth_mm else -rows)
    right = np.arange(cols)[None] - (seen.u_q4 // step if seen.depth_mm else -cols)
    here = (down == 0) & (right == 0)
    if name == "confidence":
        off = value // 16 - UNIT_SLOPE * here
        around = (np.abs(down) < 2) & (np.abs(right) < 2) & ~here
        return np.where(around, 0, np.sign(off) * (off * off // UNIT_SLOPE))
    places = {"offset_u": seen.u_q4 % step, "offset_v": seen.v_q4 % step, "depth": seen.depth_mm}
    most = UNIT_SLOPE if name == "depth" else UNIT_SLOPE // 2
    return np.where(here, most * np.sign(value - places[name]), 0)
