"""Learning on in the last layer, in integers: the specification of the C that does it on a drone.

A step of gradient on one labelled image. The loss is that of training, made simple: the squared
error of the confidence, which leaves the cells around the robot's alone, and the absolute error of
log depth and of the offsets, in the robot's cell.
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
"""A slope of 1."""
POINT = 65536
"""What a step of an int8 weight is in a learned weight, and a learning rate of 1 in `rate`."""
LARGEST, LARGEST_BIAS = 127 * POINT, 2**30
GAIN_ONE = 256
LARGEST_GAIN = 2**26


class Seen(NamedTuple):
    """A robot that is known to be in an image: its centre, 1/16 px, and depth; 0 mm: nobody is."""

    u_q4: int
    v_q4: int
    depth_mm: int


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """Weights of the last layer while they are learned.

    Parameters
    ----------
    weight
        (heads, features) in 1 / `POINT` of a step of the int8 weights.
    bias
        (heads,) in steps of the sum.
    """

    weight: Int64
    bias: Int64


def last_layer(network: IntegerNetwork) -> Conv:
    """The layer that gives every head.

    Raises
    ------
    ModelError
        If there is no such, or it is no 1x1 convolution of an unsigned tensor.
    """
    layer = network.layers[-1]
    at = {head.tensor for head in network.heads.values()}
    plain = isinstance(layer, Conv) and layer.kernel == layer.groups == layer.stride == 1
    unsigned = plain and layer.sources[0] > 0 and not network.layers[layer.sources[0] - 1].signed
    if at != {len(network.layers)} or not unsigned or len(layer.sources) > 1:
        raise ModelError(
            f"layer {layer.name} cannot be learned on: that wants one 1x1 convolution behind a "
            "ReLU for all heads. Export without --refine"
        )
    assert isinstance(layer, Conv)
    return layer


def start(network: IntegerNetwork) -> Learned:
    """The weights as they were exported."""
    layer, rows = last_layer(network), _rows(network)
    weight = layer.weight[rows, :, 0, 0].astype(np.int64) * POINT
    return Learned(weight, layer.bias[rows].astype(np.int64))


def _rows(network: IntegerNetwork) -> list[int]:
    return [head.channel for head in network.heads.values()]


def gains(network: IntegerNetwork) -> tuple[Int64, Int64]:
    """(heads,) by what a slope of 1 moves weights and biases at a rate of 1, in 1/256."""
    layer = last_layer(network)
    in_scale = network.layers[layer.source - 1].scale
    out_scale = np.array([head.scale for head in network.heads.values()])
    sum_scale = layer.multiplier[_rows(network)] / 2.0**layer.shift * out_scale
    weight_scale = sum_scale / in_scale
    weight = GAIN_ONE * POINT / ONE * in_scale / weight_scale
    limited = [np.minimum(np.rint(g), LARGEST_GAIN) for g in (weight, GAIN_ONE / sum_scale)]
    return limited[0].astype(np.int64), limited[1].astype(np.int64)


def with_learned(network: IntegerNetwork, learned: Learned) -> IntegerNetwork:
    """The network with learned weights, rounded to int8."""
    layer, rows = last_layer(network), _rows(network)
    weight, bias = layer.weight.copy(), layer.bias.copy()
    weight[rows, :, 0, 0] = (learned.weight + POINT // 2) >> 16
    bias[rows] = learned.bias
    last = replace(layer, weight=weight, bias=bias)
    return replace(network, layers=(*network.layers[:-1], last))


def learn(
    network: IntegerNetwork, learned: Learned, features: Quantised, seen: Seen, rate: int
) -> Learned:
    """One step of gradient.

    Parameters
    ----------
    network
        As it was exported.
    learned
        The weights so far.
    features
        (features, rows, cols) that the last layer reads of an image.
    seen
        Who is there.
    rate
        Learning rate times `POINT`.
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
    """(rows, cols) gradient of the loss to a head's output, times `ONE`."""
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
