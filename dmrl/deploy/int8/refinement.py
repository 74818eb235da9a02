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
from dmrl.deploy.int8.reference import Quantised, convolve
from dmrl.errors import ModelError

Int64 = NDArray[np.int64]

ONE = 4096
"""Fixed-point value of a slope of 1."""
POINT = 65536
"""Fixed-point value of a step of an int8 weight, and of a learning rate of 1."""
LARGEST, LARGEST_BIAS = 127 * POINT, 2**30
"""Limits of learned weights and biases."""
GAIN_ONE = 256
"""Fixed-point value of a gain of 1."""
LARGEST_GAIN = 2**26
"""Limit of gains, against overflow."""


class Seen(NamedTuple):
    """Label of the robot in an image: its centre, 1/16 px, and depth; 0 mm: no robot."""

    u_q4: int
    v_q4: int
    depth_mm: int


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
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


def last_layer(network: IntegerNetwork) -> Conv:
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


def start(network: IntegerNetwork) -> Learned:
    """Return the exported weights."""
    layer, rows = last_layer(network), _rows(network)
    weight = layer.weight[rows, :, 0, 0].astype(np.int64) * POINT
    return Learned(weight, layer.bias[rows].astype(np.int64))


def _rows(network: IntegerNetwork) -> list[int]:
    return [head.channel for head in network.heads.values()]


def gains(network: IntegerNetwork) -> tuple[Int64, Int64]:
    """Compute the update of weights and of biases for a slope and a rate of 1.

    Returns
    -------
    tuple
        (heads,) for weights and (heads,) for biases, in 1/256.
    """
    layer = last_layer(network)
    in_scale = network.layers[layer.source - 1].scale
    out_scale = np.array([head.scale for head in network.heads.values()])
    sum_scale = layer.multiplier[_rows(network)] / 2.0**layer.shift * out_scale
    weight_scale = sum_scale / in_scale
    weight = GAIN_ONE * POINT / ONE * in_scale / weight_scale
    limited = [np.minimum(np.rint(g), LARGEST_GAIN) for g in (weight, GAIN_ONE / sum_scale)]
    return limited[0].astype(np.int64), limited[1].astype(np.int64)


def with_learned(network: IntegerNetwork, learned: Learned) -> IntegerNetwork:
    """Return the network with refined weights, rounded to int8."""
    layer, rows = last_layer(network), _rows(network)
    weight, bias = layer.weight.copy(), layer.bias.copy()
    weight[rows, :, 0, 0] = (learned.weight + POINT // 2) >> 16
    bias[rows] = learned.bias
    last = replace(layer, weight=weight, bias=bias)
    return replace(network, layers=(*network.layers[:-1], last))


def learn(
    network: IntegerNetwork, learned: Learned, features: Quantised, seen: Seen, rate: int
) -> Learned:
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
    layer = last_layer(with_learned(network, learned))
    out = convolve(layer, features)
    weight, bias = learned.weight.copy(), learned.bias.copy()
    for h, (gain, bias_gain) in enumerate(zip(*gains(network), strict=True)):
        slope = _slope(network, list(network.heads)[h], out[_rows(network)[h]], seen)
        for row, col in np.argwhere(slope):
            x, by = features[:, row, col].astype(np.int64), slope[row, col]
            step = (by * x * rate * gain + (1 << 23)) >> 24
            weight[h] = np.clip(weight[h] - step, -LARGEST, LARGEST)
            step = (by * rate * bias_gain + (1 << 35)) >> 36
            bias[h] = np.clip(bias[h] - step, -LARGEST_BIAS, LARGEST_BIAS)
    return Learned(weight, bias)


def _slope(network: IntegerNetwork, name: str, out: Quantised, seen: Seen) -> Int64:
    """Return (rows, cols) the gradient of the loss by a head's output, times `UNIT_SLOPE`."""
    rows, cols = network.grid_shape
    step = SUBPIXEL * network.stride_px
    value = network.heads[name].table[out.astype(np.int64) + 128].astype(np.int64)
    down = np.arange(rows)[:, None] - (seen.v_q4 // step if seen.depth_mm else -rows)
    right = np.arange(cols)[None] - (seen.u_q4 // step if seen.depth_mm else -cols)
    here = (down == 0) & (right == 0)
    if name == "confidence":
        off = value // 16 - ONE * here
        around = (np.abs(down) < 2) & (np.abs(right) < 2) & ~here
        return np.where(around, 0, np.sign(off) * (off * off // ONE))
    places = {"offset_u": seen.u_q4 % step, "offset_v": seen.v_q4 % step, "depth": seen.depth_mm}
    most = ONE if name == "depth" else ONE // 2
    return np.where(here, most * np.sign(value - places[name]), 0)
