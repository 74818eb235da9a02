"""Exported ONNX files, run by onnxruntime, equal the float and the int8 reference."""

from pathlib import Path

import numpy as np
import pytest

from dmrl.deploy.backends import FloatBackend, build_reference_backend
from dmrl.deploy.int8.activation_ranges import calibrate_ranges
from dmrl.deploy.int8.graph import FloatConv, FloatGraph
from dmrl.deploy.int8.layers import Add, Conv
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.quantise import HEAD_OF_CHANNEL, NetworkInfo, quantise_network
from dmrl.deploy.onnx.graph_writer import build_float_onnx, int8_onnx
from dmrl.deploy.onnx.runtime import OnnxRun
from dmrl.errors import ModelError

from .graphs import SUB_CELL, draw_rgb_images, quantised_network, random_graph

SEEDS = range(25)


@pytest.mark.parametrize("seed", SEEDS)
def test_float_onnx_computes_the_float_network(seed: int) -> None:
    graph, channels, _ = random_graph(seed)
    images = draw_rgb_images(seed)
    wanted = FloatBackend(graph, channels).outputs(images)
    grid_shape = wanted["confidence"].shape[1:]
    file = build_float_onnx(graph, channels, size_px=images.shape[1:3], grid_shape=grid_shape)
    got = OnnxRun(file, threads=1).outputs(images)
    assert set(got) == set(channels)
    for name, value in wanted.items():
        np.testing.assert_allclose(got[name], value, atol=1e-4 * np.abs(value).max())


@pytest.mark.parametrize("seed", SEEDS)
def test_int8_onnx_gives_the_levels_of_the_reference(seed: int) -> None:
    require_same_levels(quantised_network(seed), draw_rgb_images(seed))


def require_same_levels(network: IntegerNetwork, images: np.ndarray) -> None:
    """Assert that int8 ONNX and the reference give equal integer levels."""
    wanted = build_reference_backend(network).outputs(images)
    got = OnnxRun(int8_onnx(network), threads=1).outputs(images)
    for name, values in wanted.items():
        head = network.heads[HEAD_OF_CHANNEL[name]]
        np.testing.assert_array_equal(np.rint(got[name] / head.scale), np.rint(values / head.scale))


def test_random_networks_include_shortcuts_and_sums() -> None:
    layers = [layer for seed in SEEDS for layer in quantised_network(seed).layers]
    assert sum(isinstance(layer, Conv) and layer.shortcut >= 0 for layer in layers) > 3
    assert sum(isinstance(layer, Add) for layer in layers) > 1


def test_heads_may_follow_a_shortcut() -> None:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (3, 16, 24, 3)).astype(np.uint8)
    first = FloatConv(
        "first", (0,), rng.normal(0, 0.3, (4, 3, 3, 3)), np.zeros(4), padding=1, relu=True
    )
    head = FloatConv("head", (1, 1), rng.normal(0, 0.5, (4, 4, 1, 1)), np.zeros(4))
    graph = FloatGraph((first, head), tuple((2, place) for place in range(4)))
    about = NetworkInfo("small", "small", 8, SUB_CELL, 0.3)
    network = quantise_network(graph, calibrate_ranges(graph, [images]), about)
    require_same_levels(network, images)


def test_the_same_network_gives_the_same_bytes() -> None:
    assert int8_onnx(quantised_network(4)) == int8_onnx(quantised_network(4))


def test_invalid_onnx_file_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "model.onnx"
    file.write_bytes(b"no model")
    with pytest.raises(ModelError, match=r"model.onnx cannot be run: .* Export the model again"):
        OnnxRun(file, file)
