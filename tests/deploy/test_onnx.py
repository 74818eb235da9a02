"""ONNX files, run by onnxruntime."""

from pathlib import Path

import numpy as np
import pytest

from dmrl.deploy.backends import Float, Outputs, integer
from dmrl.deploy.onnx_run import OnnxRun
from dmrl.deploy.onnx_write import float_onnx, int8_onnx
from dmrl.deploy.quantise import HEAD_OF
from dmrl.errors import ModelError

from .graphs import quantised_network, random_graph

SEEDS = range(25)


def rgb_images(seed: int) -> np.ndarray:
    images = random_graph(seed)[2]
    return np.repeat(images, 3, axis=3) if images.shape[3] == 1 else images


def steps(wanted: Outputs, got: Outputs, seed: int) -> np.ndarray:
    """How many levels of its head each value lies beside."""
    network = quantised_network(seed)
    scale = {name: network.heads[HEAD_OF[name]].scale for name in wanted}
    return np.concatenate([np.abs(got[n] - wanted[n]).ravel() / scale[n] for n in wanted])


@pytest.mark.parametrize("seed", SEEDS)
def test_float_onnx_computes_the_float_network(seed: int) -> None:
    graph, channels, _ = random_graph(seed)
    images = rgb_images(seed)
    wanted = Float(graph, channels).outputs(images)
    grid_shape = wanted["confidence"].shape[1:]
    file = float_onnx(graph, channels, size_px=images.shape[1:3], grid_shape=grid_shape)
    got = OnnxRun(file, threads=1).outputs(images)
    assert set(got) == set(channels)
    for name, value in wanted.items():
        np.testing.assert_allclose(got[name], value, atol=1e-4 * np.abs(value).max())


def test_int8_onnx_is_the_reference_but_for_rounding() -> None:
    beside = []
    for seed in SEEDS:
        network = quantised_network(seed)
        images = rgb_images(seed)
        wanted = integer(network).outputs(images)
        got = OnnxRun(int8_onnx(network), threads=1).outputs(images)
        beside.append(steps(wanted, got, seed))
    every = np.concatenate(beside)
    assert (every < 0.5).mean() > 0.97
    # A bias in whole steps of the sum, of which some of these networks have two to an output's.
    assert (every < 1.5).mean() > 0.997


def test_the_same_network_gives_the_same_bytes() -> None:
    assert int8_onnx(quantised_network(4)) == int8_onnx(quantised_network(4))


def test_what_is_not_a_network_of_ours_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "model.onnx"
    file.write_bytes(b"no model")
    with pytest.raises(ModelError, match=r"model.onnx cannot be run: .* Export the model again"):
        OnnxRun(file, file)
