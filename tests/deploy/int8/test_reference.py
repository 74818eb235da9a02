"""The integer reference, compared with hand-computed values and the float decoder."""

import numpy as np
import pytest

from dmrl.deploy.backends import build_reference_backend, to_grids
from dmrl.deploy.int8.layers import Add, Conv, MaxPool
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.reference import (
    IntegerDetection,
    compute_layer,
    decode_detections,
    run_network,
)
from dmrl.learn.inference.decode_grids import decode as float_decode

from ..graphs import quantised_network
from ..networks import random_network


def convolve_by_hand(layer: Conv, x: np.ndarray, *shortcut: np.ndarray) -> np.ndarray:
    """Compute a convolution in a loop over Python integers."""
    outs, rows, cols = layer.output_shape((x.shape,))
    out = np.zeros((outs, rows, cols), np.int64)
    low, high = (-128, 127) if layer.signed else (0, 255)
    for o, r, c in np.ndindex(outs, rows, cols):
        acc = int(layer.bias[o])
        for i, kr, kc in np.ndindex(layer.weight.shape[1:]):
            channel = o if layer.depthwise else i
            row = r * layer.stride - layer.padding + kr * layer.dilation
            col = c * layer.stride - layer.padding + kc * layer.dilation
            inside = 0 <= row < x.shape[1] and 0 <= col < x.shape[2]
            value = int(x[channel, row, col]) if inside else layer.pad_value
            acc += int(layer.weight[o, i, kr, kc]) * value
        for beside in shortcut:
            acc += int(layer.gain[o]) * int(beside[o, r, c]) >> 8
        assert -(2**31) <= acc < 2**31
        scaled = ((acc * int(layer.multiplier[o])) >> layer.shift) - (128 if layer.signed else 0)
        out[o, r, c] = min(max(scaled, low), high)
    return out


@pytest.mark.parametrize("seed", [*range(6), 7, 8])  # the last two have shortcuts
@pytest.mark.heavy
def test_convolutions_equal_a_direct_loop(seed: int) -> None:
    network = random_network(seed)
    rng = np.random.default_rng(seed)
    for layer, shape in zip(network.layers, network.shapes[1:], strict=True):
        shapes = [network.shapes[k] for k in layer.sources]
        inputs = [
            rng.integers(0, 256, (channels, min(rows, 11), min(cols, 11))).astype(np.int16)
            for channels, rows, cols in shapes
        ]
        if isinstance(layer, Conv) and shape[0] * shapes[0][0] < 60:
            np.testing.assert_array_equal(
                compute_layer(layer, *inputs), convolve_by_hand(layer, *inputs)
            )


def test_halves_round_up_for_both_signs() -> None:
    layer = Add("add", (0, 1), (2**20, 2**20), 21, signed=True)  # (a + b) / 2
    a, b = (np.array(v, np.int16).reshape(1, 1, -1) for v in ([3, -3, 1, -1], [0, 0, 0, 0]))
    assert compute_layer(layer, a, b).ravel().tolist() == [2, -1, 1, 0]


def test_unsigned_outputs_are_clamped_at_zero() -> None:
    layer = Add("add", (0, 1), (2**20, 2**20), 20)
    a = np.array([-5, 5, 200], np.int16).reshape(1, 1, 3)
    assert compute_layer(layer, a, a).ravel().tolist() == [0, 10, 255]


def test_an_odd_last_row_is_left_out_of_a_pool() -> None:
    x = np.arange(15, dtype=np.int16).reshape(1, 3, 5)
    assert compute_layer(MaxPool("pool", 0), x).tolist() == [[[6, 8]]]


def find_network(offsets: bool) -> IntegerNetwork:
    """Return the first random network with or without offsets whose confidence levels differ."""
    found = (quantised_network(seed) for seed in range(50))
    fine = (n for n in found if n.grid_shape > (4, 4) and n.confidence.scale < 0.2)
    return next(n for n in fine if (n.offset_u is not None) == offsets)


def draw_levels(network: IntegerNetwork, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Draw the levels of all heads, with many equal values."""
    return {
        name: rng.integers(-20, 21, network.grid_shape).astype(np.int8) * 6
        for name in network.heads
    }


@pytest.mark.parametrize("offsets", [False, True])
def test_integer_detections_equal_the_float_ones(offsets: bool) -> None:
    network, rng = find_network(offsets), np.random.default_rng(3)
    backend = build_reference_backend(network)
    believed = 0
    for _ in range(50):
        levels = draw_levels(network, rng)
        backend.run = lambda _, levels=levels: levels
        blank = np.zeros((1, network.height_px, network.width_px, 3), np.uint8)
        found = float_decode(*to_grids(backend.outputs(blank)), stride_px=8)
        sure = found.confidence[0, : found.count[0]] >= 0.3
        got = decode_detections(network, levels)
        if offsets and len(got) != sure.sum():
            continue  # rounding to 1/16 px changed whether two peaks are merged
        assert len(got) == sure.sum()
        believed += len(got)
        for k, one in enumerate(got):
            assert abs(one.u_q4 / 16 - found.u_px[0, k]) <= 1 / 16
            assert abs(one.v_q4 / 16 - found.v_px[0, k]) <= 1 / 16
            assert abs(one.depth_mm / 1000 - min(found.depth_m[0, k], 65.535)) < 1e-3
            assert abs(one.confidence / 65535 - found.confidence[0, k]) < 1e-4
    assert believed > 50


def test_equal_neighbouring_cells_give_the_first_detection_only() -> None:
    network = find_network(offsets=False)
    levels = {name: np.full(network.grid_shape, -128, np.int8) for name in network.heads}
    levels["confidence"][1, 1:3] = 127
    wanted = IntegerDetection(
        12 * 16, 12 * 16, int(network.depth.table[0]), int(network.confidence.table[255])
    )
    assert network.threshold_q <= 127
    assert decode_detections(network, levels) == [wanted]


def test_the_heads_are_channels_of_their_tensor() -> None:
    network = random_network(5)
    image = np.random.default_rng(0).integers(
        0, 256, (network.height_px, network.width_px, network.channels), np.uint8
    )
    got = run_network(network, image)
    assert set(got) == set(network.heads)
    assert all(grid.shape == network.grid_shape for grid in got.values())


def test_cell_at_the_threshold_is_detected() -> None:
    network = find_network(offsets=False)
    levels = {name: np.full(network.grid_shape, -128, np.int8) for name in network.heads}
    assert -128 < network.threshold_q <= 127
    for below, count in ((0, 1), (1, 0)):
        levels["confidence"][1, 2] = network.threshold_q - below
        assert len(decode_detections(network, levels)) == count
