"""Learning on in the last layer."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl.deploy.c import write_c
from dmrl.deploy.c.run.compile_targets import SANITIZER_FLAGS, Build, Target
from dmrl.deploy.c.run.verification import compute_expected, verify_target
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.reference import QuantizedTensor, convolve, iter_tensors
from dmrl.deploy.int8.refinement import (
    FIXED_POINT_ONE,
    RefinementLabel,
    apply_weights,
    find_last_layer,
    initial_weights,
    take_gradient_step,
)
from dmrl.errors import ModelError

from ..graphs import quantised_network

RATE = FIXED_POINT_ONE // 50


def noise(network: IntegerNetwork, count: int) -> list[np.ndarray]:
    shape = (count, network.height_px, network.width_px, network.channels)
    return list(np.random.default_rng(0).integers(0, 256, shape, np.uint8))


def network_of(seed: int, *, cells: int = 12) -> IntegerNetwork:
    """The first random network from ``seed`` on that can learn, with a grid of so many cells."""
    found = (quantised_network(k) for k in range(seed, seed + 60))
    large = (n for n in found if np.prod(n.grid_shape) >= cells and n.offset_u is not None)
    return next(n for n in large if not n.layers[n.layers[-1].sources[0] - 1].signed)


def features_of(network: IntegerNetwork, image: np.ndarray) -> QuantizedTensor:
    *_, features, _ = iter_tensors(network, image)
    return features


def loss(network: IntegerNetwork, features: QuantizedTensor, seen: RefinementLabel) -> float:
    """What is learned on, in real numbers: confidence, and depth where the robot is."""
    out = convolve(find_last_layer(network), features)
    row, col = seen.v_q4 // (16 * network.stride_px), seen.u_q4 // (16 * network.stride_px)
    believed, depth = (
        network.heads[name].table[out[network.heads[name].channel].astype(int) + 128]
        for name in ("confidence", "depth")
    )
    off = believed / 65535
    right = float((1 - off[row, col]) ** 2)
    off = np.delete(off.ravel(), row * off.shape[1] + col)
    depth_off = abs(np.log(max(depth[row, col], 1) / seen.depth_mm))
    return right + float((off**2).mean()) + float(depth_off)


@pytest.mark.parametrize("seed", [0, 20])
def test_steps_on_images_of_somewhere_else_lower_their_loss(seed: int) -> None:
    network = network_of(seed)
    seen = RefinementLabel(8 * 16 + 40, 8 * 16 + 90, 900)
    each = [features_of(network, image) for image in noise(network, 4)]
    learned = initial_weights(network)
    before = sum(loss(network, features, seen) for features in each)
    for _ in range(15):
        for features in each:
            learned = take_gradient_step(network, learned, features, seen, RATE)
    after = sum(loss(apply_weights(network, learned), features, seen) for features in each)
    assert after < 0.7 * before


def test_an_empty_image_takes_belief_away_and_a_rate_of_0_nothing() -> None:
    network, nobody = network_of(0), RefinementLabel(0, 0, 0)
    features = features_of(network, noise(network, 1)[0])
    learned = initial_weights(network)
    same = take_gradient_step(network, learned, features, nobody, 0)
    np.testing.assert_array_equal(same.weight, learned.weight)
    np.testing.assert_array_equal(same.bias, learned.bias)
    for _ in range(10):
        learned = take_gradient_step(network, learned, features, nobody, RATE)
    head = network.confidence

    def belief(of: IntegerNetwork) -> float:
        return float(convolve(find_last_layer(of), features)[head.channel].max())

    assert belief(apply_weights(network, learned)) < belief(network)
    depth = list(network.heads).index("depth")
    np.testing.assert_array_equal(learned.weight[depth], initial_weights(network).weight[depth])


def test_what_was_not_learned_is_the_network_as_exported() -> None:
    network = network_of(0)
    again = apply_weights(network, initial_weights(network))
    np.testing.assert_array_equal(again.layers[-1].weight, network.layers[-1].weight)
    np.testing.assert_array_equal(again.layers[-1].bias, network.layers[-1].bias)


@pytest.mark.heavy
@pytest.mark.parametrize("seed", [0, 10, 20])
def test_the_c_learns_bit_for_bit_the_same(seed: int, tmp_path: Path) -> None:
    network = network_of(seed, cells=2)
    write_c(network, tmp_path, [], refine=True)
    target = Target("sanitizers", (Build("-O1", "gcc", SANITIZER_FLAGS),))
    result = verify_target(network, tmp_path, target, compute_expected(network, noise(network, 4)))
    assert (result.error, result.mismatches) == ("", 0)
    assert [build.label for build in result.builds] == ["-O1", "-O1, learning"]


def test_a_weight_that_the_c_learns_otherwise_is_noticed(tmp_path: Path) -> None:
    network = network_of(0)
    write_c(network, tmp_path, [], refine=True)
    code = (tmp_path / "random_refine.c").read_text()
    (tmp_path / "random_refine.c").write_text(code.replace("ONE / 2", "ONE / 4"))
    target = Target("gcc", (Build("-O0", "gcc", ("-O0",)),))
    result = verify_target(network, tmp_path, target, compute_expected(network, noise(network, 2)))
    assert [build.mismatches for build in result.builds] == [0, 2]


def test_other_last_layers_are_refused() -> None:
    network = network_of(0)
    last = network.layers[-1]
    other = replace(network.confidence, tensor=len(network.layers))
    assert find_last_layer(replace(network, confidence=other)) is last
    odd = next(
        n for n in map(quantised_network, range(60)) if n.layers[n.layers[-1].sources[0] - 1].signed
    )
    with pytest.raises(ModelError, match="cannot be refined: that requires one 1x1 convolution"):
        find_last_layer(odd)
