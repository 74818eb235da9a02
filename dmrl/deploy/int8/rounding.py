"""Compensated weight rounding (GPTQ, Frantar et al. 2022, after OBQ).

Rounding to the nearest level is optimal for a single weight only. The inputs of a convolution are
correlated: weights that are not rounded yet compensate the error of one that is, and the bias
compensates the rest. The correlations are measured on calibration images.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.int8.graph import FloatConv, FloatGraph, compute_rgb_tensors
from dmrl.deploy.int8.windows import extract_taps

Array = NDArray[np.float64]
InputMoments = dict[int, Array]
"""Second moments by layer index, (groups, n + 1, n + 1): mean products of any two of the n inputs
of an output and of the constant 1, which is last and represents the bias."""

MAX_LEVEL = 127
"""Largest integer weight."""
DAMPING = 1e-4
"""Fraction of the inputs' mean square added to the diagonal. It limits the compensation."""


def measure_moments(graph: FloatGraph, images: Iterable[NDArray[np.uint8]]) -> InputMoments:
    """Measure the second moments of every convolution's inputs over (height, width, 3) images."""
    sums: InputMoments = {}
    count = 0
    for image in images:
        tensors = compute_rgb_tensors(graph, image[None])
        for index, layer in enumerate(graph.layers):
            if isinstance(layer, FloatConv):
                more = _layer_moments(layer, tensors[layer.sources[0]][0])
                sums[index] = sums[index] + more if count else more
        count += 1
    return {index: total / count for index, total in sums.items()}


def _layer_moments(layer: FloatConv, x: NDArray[np.float32]) -> Array:
    pad = layer.padding
    padded = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
    taps = extract_taps(padded, layer.weight.shape[2], layer.stride, layer.dilation)
    places = taps.shape[2] * taps.shape[3]
    inputs = taps.reshape(layer.groups, -1, places)
    inputs = np.concatenate([inputs, np.ones_like(inputs[:, :1])], axis=1)
    products = (inputs @ inputs.swapaxes(1, 2)).astype(np.float64)
    mean: Array = products / places
    return mean


def round_weights(
    layer: FloatConv, scale: Array, moments: Array
) -> tuple[NDArray[np.int64], Array]:
    """Round the weights of a convolution; return integer weights and the matching bias.

    Parameters
    ----------
    layer
        The convolution.
    scale
        (out,) real value of one step of the weights.
    moments
        Second moments of its inputs, from `measure_moments`.
    """
    outs = len(layer.bias)
    wanted = np.column_stack([layer.weight.reshape(outs, -1) / scale[:, None], layer.bias / scale])
    each = outs // layer.groups
    parts = [
        _round_rows(wanted[group * each : (group + 1) * each], moment)
        for group, moment in enumerate(moments)
    ]
    levels = np.concatenate(parts)
    weight = levels[:, :-1].reshape(layer.weight.shape).astype(np.int64)
    return weight, levels[:, -1] * scale


def _round_rows(wanted: Array, moments: Array) -> Array:
    """Round rows of weights, one column after another; the last column, the bias, stays real.

    The weights of the largest input are rounded first, since most other weights can still
    compensate. With H the moments and U'U = H^-1, the error of column j has weight ``U[j, k] / U[j,
    j]`` on column k.
    """
    last = len(moments) - 1
    square = np.diag(moments)[:last]
    order = np.append(np.argsort(-square, kind="stable"), last)
    damped = moments + np.diag(np.append(np.full(last, DAMPING * square.mean() + 1e-12), 0.0))
    inverse = np.linalg.inv(damped[np.ix_(order, order)])
    factor = np.linalg.cholesky((inverse + inverse.T) / 2).T
    left = wanted[:, order]
    for j in range(last):
        level = np.clip(np.rint(left[:, j]), -MAX_LEVEL, MAX_LEVEL)
        lost = (left[:, j] - level) / factor[j, j]
        left[:, j] = level
        left[:, j + 1 :] -= lost[:, None] * factor[j, j + 1 :]
    levels = np.empty_like(left)
    levels[:, order] = left
    return levels
