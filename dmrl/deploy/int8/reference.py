"""Reference implementation of int8 networks; every other backend must match it bit for bit.

NumPy only. Sums of products use float64, which represents every integer below 2^53 exactly and
makes BLAS usable.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.int8.layers import GAIN_SHIFT, SIGNED_OFFSET, Add, AnyLayer, Conv
from dmrl.deploy.int8.network import SUBPIXEL, Head, IntegerNetwork
from dmrl.deploy.int8.windows import extract_taps, max_pool_2x2
from dmrl.learn.inference.decode_grids import DUPLICATE_RADIUS_PX

QuantizedTensor = NDArray[np.int16]
"""Values of uint8 or int8 tensors, in int16, which contains both."""


def run_network(network: IntegerNetwork, image: NDArray[np.uint8]) -> dict[str, NDArray[np.int8]]:
    """Run an int8 network on one image; return the int8 grid (rows, cols) of every head.

    Parameters
    ----------
    network
        The network.
    image
        (height, width, channels) uint8: RGB, or one channel of grey.
    """
    tensors = list(iter_tensors(network, image))
    return {
        name: tensors[head.tensor][head.channel].astype(np.int8)
        for name, head in network.heads.items()
    }


def iter_tensors(network: IntegerNetwork, image: NDArray[np.uint8]) -> Iterator[QuantizedTensor]:
    """Yield the image and the output of every layer, in order, each (channels, rows, cols)."""
    assert image.shape == (network.height_px, network.width_px, network.channels)
    tensors = [image.transpose(2, 0, 1).astype(np.int16)]
    yield tensors[0]
    for layer in network.layers:
        tensors.append(compute_layer(layer, *(tensors[k] for k in layer.sources)))
        yield tensors[-1]


def compute_layer(layer: AnyLayer, *inputs: QuantizedTensor) -> QuantizedTensor:
    """Compute the output of a layer, (channels, rows, cols)."""
    if isinstance(layer, Conv):
        return convolve(layer, *inputs)
    if isinstance(layer, Add):
        a, b = (x.astype(np.int64) * m for x, m in zip(inputs, layer.multipliers, strict=True))
        return clamp((a + b + (1 << (layer.shift - 1))) >> layer.shift, signed=layer.signed)
    return max_pool_2x2(inputs[0])


def convolve(layer: Conv, x: QuantizedTensor, *shortcut: QuantizedTensor) -> QuantizedTensor:
    """Compute a requantized convolution: ``clamp((acc * multiplier) >> shift)``, see `Conv`."""
    product = accumulate(layer, x, *shortcut) * layer.multiplier.astype(np.int64)[:, None, None]
    offset = SIGNED_OFFSET if layer.signed else 0
    return clamp((product >> layer.shift) - offset, signed=layer.signed)


def accumulate(layer: Conv, x: QuantizedTensor, *shortcut: QuantizedTensor) -> NDArray[np.int64]:
    """Compute the sums (out, rows, cols) of products, bias and shortcut, before requantization."""
    pad = layer.padding
    padded = np.pad(x, ((0, 0), (pad, pad), (pad, pad)), constant_values=layer.pad_value)
    taps = extract_taps(padded, layer.kernel, layer.stride, layer.dilation).astype(np.float64)
    outs, (rows, cols) = len(layer.weight), taps.shape[2:]
    weight = layer.weight.reshape(outs, -1).astype(np.float64)
    if layer.depthwise:
        sums = np.einsum("ct,ctrs->crs", weight, taps)
    else:
        sums = (weight @ taps.reshape(weight.shape[1], rows * cols)).reshape(outs, rows, cols)
    acc: NDArray[np.int64] = sums.astype(np.int64) + layer.bias[:, None, None]
    for beside in shortcut:
        acc += (beside * layer.gain.astype(np.int64)[:, None, None]) >> GAIN_SHIFT
    return acc


def clamp(values: NDArray[np.int64], *, signed: bool) -> QuantizedTensor:
    """Clip values to int8 or uint8."""
    low, high = (-128, 127) if signed else (0, 255)
    return np.clip(values, low, high).astype(np.int16)


def dequantize(head: Head, q: NDArray[np.int8]) -> NDArray[np.float64]:
    """Dequantize a head's grid to real values (log depth, logit, offset)."""
    return head.scale * (q.astype(np.float64) - head.zero_point)


@dataclass(frozen=True, slots=True)
class IntegerDetection:
    """A detection in integer units.

    Parameters
    ----------
    u_q4, v_q4
        Pixel-edge coordinates, 1/16 px.
    depth_mm
        Depth along the optical axis, 0 to 65535.
    confidence
        0 to 65535 for 0 to 1.
    """

    u_q4: int
    v_q4: int
    depth_mm: int
    confidence: int


def decode_detections(
    network: IntegerNetwork, grids: dict[str, NDArray[np.int8]], most: int = 20
) -> list[IntegerDetection]:
    """Decode the grids of `run_network` to detections, most confident first.

    A detection is a cell whose confidence q reaches ``network.threshold_q``, exceeds that of its
    3x3 neighbours before it in raster order, and is not exceeded by those after it. Detections are
    sorted by falling q, equal ones in raster order; the first ``most`` are kept.

    If the network has offsets, positions are clipped to the image, 0 and its sides included. Then,
    in that order, a detection closer than ``DUPLICATE_RADIUS_PX`` to a kept one is dropped: ``du^2
    + dv^2 < (16 DUPLICATE_RADIUS_PX)^2`` in 1/16 px.
    """
    q = grids["confidence"].astype(np.int64)
    rows, cols = q.shape
    around = np.pad(q, 1, constant_values=-129)
    peak = q >= network.threshold_q
    for row in range(3):
        for col in range(3):
            neighbour = around[row : row + rows, col : col + cols]
            if (row, col) < (1, 1):
                peak &= q > neighbour
            elif (row, col) > (1, 1):
                peak &= q >= neighbour
    cells = np.flatnonzero(peak)
    best = cells[np.argsort(-q.ravel()[cells], kind="stable")][:most]
    found = [_make_detection(network, grids, int(cell)) for cell in best]
    return found if network.offset_u is None else _drop_duplicates(found)


def _make_detection(
    network: IntegerNetwork, grids: dict[str, NDArray[np.int8]], cell: int
) -> IntegerDetection:
    rows, cols = network.grid_shape
    row, col = divmod(cell, cols)
    step = network.stride_px * SUBPIXEL
    value = {
        name: int(head.table[int(grids[name][row, col]) + 128])
        for name, head in network.heads.items()
    }
    return IntegerDetection(
        u_q4=min(max(col * step + value.get("offset_u", step // 2), 0), cols * step),
        v_q4=min(max(row * step + value.get("offset_v", step // 2), 0), rows * step),
        depth_mm=value["depth"],
        confidence=value["confidence"],
    )


def _drop_duplicates(found: list[IntegerDetection]) -> list[IntegerDetection]:
    """Drop detections that are close to a more confident one."""
    near = int(DUPLICATE_RADIUS_PX * SUBPIXEL) ** 2
    kept: list[IntegerDetection] = []
    for one in found:
        away = [(one.u_q4 - other.u_q4) ** 2 + (one.v_q4 - other.v_q4) ** 2 for other in kept]
        if not away or min(away) >= near:
            kept.append(one)
    return kept
