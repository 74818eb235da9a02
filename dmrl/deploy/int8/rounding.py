"""Weights rounded so that their errors cancel (Frantar et al. 2022, GPTQ, after OBQ).

Rounding to the nearest level is best for a weight alone. But the inputs of a convolution are
correlated: weights that are not yet rounded can correct the error of one that is, and the bias
corrects the rest. How the inputs are correlated is measured on calibration images.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.int8.graph import FloatConv, Graph, grey_of, tensors_of, to_input
from dmrl.deploy.int8.windows import taps_of

Array = NDArray[np.float64]
Moments = dict[int, Array]
"""By the number of a layer, (groups, n + 1, n + 1): mean products of any two of the n inputs of
an output, and of 1, which stands for the bias and comes last."""

LARGEST = 127
DAMPING = 1e-4
"""Share of the mean square of the inputs added to each: no weight makes good at any cost."""


def moments_of(graph: Graph, images: Iterable[NDArray[np.uint8]]) -> Moments:
    """What the inputs of every convolution are like over (height, width, 3) images."""
    sums: Moments = {}
    count = 0
    for image in images:
        seen = image[None]
        tensors = tensors_of(graph, to_input(grey_of(seen) if graph.channels == 1 else seen))
        for index, layer in enumerate(graph.layers):
            if isinstance(layer, FloatConv):
                more = _moments(layer, tensors[layer.sources[0]][0])
                sums[index] = sums[index] + more if count else more
        count += 1
    return {index: total / count for index, total in sums.items()}


def _moments(layer: FloatConv, x: NDArray[np.float32]) -> Array:
    pad = layer.padding
    padded = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
    taps = taps_of(padded, layer.weight.shape[2], layer.stride, layer.dilation)
    places = taps.shape[2] * taps.shape[3]
    inputs = taps.reshape(layer.groups, -1, places)
    inputs = np.concatenate([inputs, np.ones_like(inputs[:, :1])], axis=1)
    products = (inputs @ inputs.swapaxes(1, 2)).astype(np.float64)
    mean: Array = products / places
    return mean


def rounded(layer: FloatConv, scale: Array, moments: Array) -> tuple[NDArray[np.int64], Array]:
    """Integer weights of a convolution, and the bias that suits them.

    Parameters
    ----------
    layer
        The convolution.
    scale
        (out,) real value of one step of the weights.
    moments
        Of its inputs, as `moments_of` gives them.
    """
    outs = len(layer.bias)
    wanted = np.column_stack([layer.weight.reshape(outs, -1) / scale[:, None], layer.bias / scale])
    each = outs // layer.groups
    parts = [
        _rounded(wanted[group * each : (group + 1) * each], moment)
        for group, moment in enumerate(moments)
    ]
    levels = np.concatenate(parts)
    weight = levels[:, :-1].reshape(layer.weight.shape).astype(np.int64)
    return weight, levels[:, -1] * scale


def _rounded(wanted: Array, moments: Array) -> Array:
    """Rows of weights, and a bias each, in steps: all but the bias rounded, one after another.

    The largest input goes first, since most can still be made good. With H the moments and
    U'U = H^-1, what column j lost weighs ``U[j, k] / U[j, j]`` on column k.
    """
    last = len(moments) - 1
    square = np.diag(moments)[:last]
    order = np.append(np.argsort(-square, kind="stable"), last)
    damped = moments + np.diag(np.append(np.full(last, DAMPING * square.mean() + 1e-12), 0.0))
    inverse = np.linalg.inv(damped[np.ix_(order, order)])
    factor = np.linalg.cholesky((inverse + inverse.T) / 2).T
    left = wanted[:, order]
    for j in range(last):
        level = np.clip(np.rint(left[:, j]), -LARGEST, LARGEST)
        lost = (left[:, j] - level) / factor[j, j]
        left[:, j] = level
        left[:, j + 1 :] -= lost[:, None] * factor[j, j + 1 :]
    levels = np.empty_like(left)
    levels[:, order] = left
    return levels
