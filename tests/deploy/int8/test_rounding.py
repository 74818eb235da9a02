"""Rounding of weights such that errors compensate each other."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.deploy.backends import FloatBackend, build_reference_backend
from dmrl.deploy.int8.activation_ranges import calibrate_ranges
from dmrl.deploy.int8.equalisation import equalise_channels
from dmrl.deploy.int8.graph import FloatConv, FloatGraph, compute_tensors, normalize_images
from dmrl.deploy.int8.quantise import NetworkInfo, quantise_network
from dmrl.deploy.int8.rounding import MAX_LEVEL, _round_rows, measure_moments, round_weights

from ..graphs import draw_rgb_images, random_graph

STEPS = np.random.default_rng(3).integers(0, 9, (4, 24, 32, 3))
SMOOTH = np.cumsum(STEPS, axis=2).astype(np.uint8)


def layer(groups: int) -> FloatConv:
    """Return a random convolution of 3 x 3 pixels and three channels."""
    rng = np.random.default_rng(4)
    weight = rng.normal(0, 0.3, (3, 3 // groups, 3, 3))
    return FloatConv("conv", (0,), weight, rng.normal(0, 0.1, 3), padding=1, groups=groups)


def compute_output(one: FloatConv) -> np.ndarray:
    """Return the output of a convolution for the smooth images."""
    return compute_tensors(FloatGraph((one,), ()), normalize_images(SMOOTH))[1].astype(np.float64)


@pytest.mark.parametrize(("groups", "gain"), [(1, 4), (3, 2)])
def test_correlated_rounding_beats_nearest_rounding(groups: int, gain: float) -> None:
    one = layer(groups)
    scale = np.abs(one.weight).max(axis=(1, 2, 3)) / 7  # four bits, for a visible effect
    moments = measure_moments(FloatGraph((one,), ()), SMOOTH)[0]
    weight, bias = round_weights(one, scale, moments)
    steps = scale[:, None, None, None]
    nearest = replace(one, weight=np.rint(one.weight / steps) * steps)
    wanted = compute_output(one)
    worse = ((compute_output(nearest) - wanted) ** 2).mean()
    better = ((compute_output(replace(one, weight=weight * steps, bias=bias)) - wanted) ** 2).mean()
    assert better < worse / gain


def test_second_moments_are_mean_products_of_inputs() -> None:
    one = layer(1)
    moments = measure_moments(FloatGraph((one,), ()), SMOOTH)[0]
    x = normalize_images(SMOOTH)
    assert moments.shape == (1, 28, 28)
    # Tap 4 of 9 is the central pixel, and the last row is the mean.
    assert moments[0, 4, 9 + 4] == pytest.approx((x[:, 0] * x[:, 1]).mean(), rel=1e-4)
    assert moments[0, 4, 27] == pytest.approx(x[:, 0].mean(), rel=1e-4)
    assert moments[0, 27, 27] == 1


def test_constant_zero_inputs_fall_back_to_nearest_rounding() -> None:
    one = layer(1)
    moments = measure_moments(FloatGraph((one,), ()), [np.full((8, 8, 3), 128, np.uint8)])[0]
    scale = np.abs(one.weight).max(axis=(1, 2, 3)) / MAX_LEVEL
    weight, bias = round_weights(one, scale, moments)
    assert (weight == np.rint(one.weight / scale[:, None, None, None])).all()
    np.testing.assert_allclose(bias, one.bias)


@pytest.mark.heavy
def test_random_networks_are_more_accurate_than_with_nearest_rounding() -> None:
    gained_db = []
    for seed in range(40):
        graph, channels, _ = random_graph(seed)
        rgb = draw_rgb_images(seed)
        graph, ranges = equalise_channels(graph, calibrate_ranges(graph, [rgb]))
        about = NetworkInfo("random", "random", 8, channels, 0.3)
        wanted = FloatBackend(graph, channels).outputs(rgb)
        lost = [
            sum(
                float(((value - got[name]) ** 2).mean() / (value**2).mean())
                for name, value in wanted.items()
            )
            for got in (
                build_reference_backend(quantise_network(graph, ranges, about, moments)).outputs(
                    rgb
                )
                for moments in (None, measure_moments(graph, rgb))
            )
        ]
        gained_db.append(10 * np.log10(lost[0] / lost[1]))
    assert np.median(gained_db) > 0.5


def test_weights_stay_within_seven_bits_and_a_sign() -> None:
    wanted = np.array([[-127.4, -127.4, -140.0, 200.0, 3.0]])
    together = np.full((5, 5), 0.9) + 0.1 * np.eye(5)  # later weights compensate earlier errors
    levels = _round_rows(wanted, together)
    assert np.abs(levels[:, :-1]).max() == MAX_LEVEL == 127
