"""Quantization of float networks to int8."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.deploy.backends import FloatBackend, build_reference_backend
from dmrl.deploy.int8 import reference
from dmrl.deploy.int8.activation_ranges import calibrate_ranges
from dmrl.deploy.int8.equalisation import equalise_channels
from dmrl.deploy.int8.graph import (
    FloatConv,
    FloatGraph,
    compute_tensors,
    normalize_images,
    rgb_to_grey,
    select_outputs,
)
from dmrl.deploy.int8.layer_errors import compute_layer_errors
from dmrl.deploy.int8.layers import Conv
from dmrl.deploy.int8.quantise import (
    HEAD_CONVERSIONS,
    NetworkInfo,
    _limit_bits,
    _round_to_odd,
    _to_fixed_point,
    quantise_network,
)
from dmrl.errors import ModelError, SettingError

from ..graphs import draw_rgb_images, quantised_network, random_graph

ABOUT = NetworkInfo("small", "small", 8, ("log_depth", "confidence"), 0.3)
NOISE = np.random.default_rng(1).integers(0, 256, (3, 16, 24, 3)).astype(np.uint8)


def build_small_graph(weight: float = 1.0, bias: float = 0.0) -> FloatGraph:
    """Return a 3x3 convolution with ReLU and a head of two channels."""
    rng = np.random.default_rng(0)
    first = FloatConv("first", (0,), weight * rng.normal(0, 0.3, (4, 3, 3, 3)),
                      np.full(4, bias), padding=1, relu=True)  # fmt: skip
    head = FloatConv("head", (1,), rng.normal(0, 0.5, (2, 4, 1, 1)), np.array([0.1, -2.0]))
    return FloatGraph((first, head), ((2, 0), (2, 1)))


@pytest.mark.heavy
def test_int8_is_near_float_on_most_random_networks() -> None:
    sqnr_db = []
    for seed in range(60):
        graph, channels, _ = random_graph(seed)
        images = draw_rgb_images(seed)
        wanted = FloatBackend(graph, channels).outputs(images)
        got = build_reference_backend(quantised_network(seed)).outputs(images)
        for name, value in wanted.items():
            error = ((value - got[name]) ** 2).mean()
            sqnr_db.append(10 * np.log10((value**2).mean() / error))
    assert np.median(sqnr_db) > 30
    assert np.quantile(sqnr_db, 0.05) > 15


@pytest.mark.heavy
def test_channel_equalisation_keeps_outputs() -> None:
    moved = 0
    for seed in range(30):
        graph, _, images = random_graph(seed)
        ranges = calibrate_ranges(graph, [draw_rgb_images(seed)])
        even, even_ranges = equalise_channels(graph, ranges)
        wanted = select_outputs(graph, compute_tensors(graph, normalize_images(images)))
        tensors = compute_tensors(even, normalize_images(images))
        np.testing.assert_allclose(
            select_outputs(even, tensors), wanted, atol=1e-4 * np.abs(wanted).max()
        )
        for tensor, high in zip(tensors, even_ranges.high, strict=True):
            np.testing.assert_allclose(tensor.max(axis=(0, 2, 3)), high, rtol=1e-3, atol=1e-4)
        moved += any(
            not np.allclose(a, b) for a, b in zip(ranges.high, even_ranges.high, strict=True)
        )
    assert moved > 20


def test_channel_equalisation_balances_residual_blocks() -> None:
    rng = np.random.default_rng(0)
    size = np.array([1, 0.1, 0.01, 0.3])
    first = FloatConv("first", (0,), size[:, None, None, None] * rng.normal(0, 1, (4, 3, 3, 3)),
                      np.zeros(4), padding=1, relu=True)  # fmt: skip
    block = FloatConv("block", (1, 1), size[:, None, None, None] * rng.normal(0, 1, (4, 4, 1, 1)),
                      np.zeros(4), relu=True)  # fmt: skip
    head = FloatConv("head", (2,), rng.normal(0, 0.5, (2, 4, 1, 1)), np.zeros(2))
    graph = FloatGraph((first, block, head), ((3, 0), (3, 1)))
    ranges = calibrate_ranges(graph, [NOISE])
    _, even = equalise_channels(graph, ranges)
    for tensor in (1, 2):
        before, after = (np.ptp(np.log(each.high[tensor])) for each in (ranges, even))
        assert before > 2.5
        assert after < before / 2


def test_large_bias_fits_int32() -> None:
    graph = build_small_graph(weight=1e-7, bias=3.0)
    network = quantise_network(graph, calibrate_ranges(graph, [NOISE]), ABOUT)
    first, head = compute_layer_errors(graph, network, NOISE)[0], network.layers[0]
    assert isinstance(head, Conv)
    assert np.abs(head.bias.astype(np.int64)).max() < 2**31 - 1
    assert first.sqnr_db is not None
    assert first.sqnr_db > 40


def test_the_levels_cover_the_calibrated_range_and_zero() -> None:
    graph = build_small_graph()
    network = quantise_network(graph, calibrate_ranges(graph, [NOISE]), ABOUT)
    wanted = select_outputs(graph, compute_tensors(graph, normalize_images(NOISE)))
    for head, values in ((network.depth, wanted[:, 0]), (network.confidence, wanted[:, 1])):
        ends = head.scale * (np.array([-128, 127]) - head.zero_point)
        assert ends[0] <= values.min() < values.max() <= ends[1]
        assert ends[0] <= 0 <= ends[1]


def test_lookup_tables_convert_levels_to_confidence_and_depth() -> None:
    network = quantise_network(
        build_small_graph(), calibrate_ranges(build_small_graph(), [NOISE]), ABOUT
    )
    logit = network.confidence.scale * (np.arange(-128, 128) - network.confidence.zero_point)
    np.testing.assert_allclose(
        network.confidence.table / 65535, 1 / (1 + np.exp(-logit)), atol=1e-5
    )
    log_depth = network.depth.scale * (np.arange(-128, 128) - network.depth.zero_point)
    np.testing.assert_allclose(network.depth.table / 1000, np.exp(log_depth), atol=6e-4)
    q = network.threshold_q
    assert network.confidence.table[q + 127] < 0.3 * 65535 <= network.confidence.table[q + 128]


def test_images_of_one_colour_are_refused() -> None:
    plain = np.stack([np.full((16, 24, 3), level, np.uint8) for level in (0, 90, 255)])
    with pytest.raises(SettingError, match=r"the 3 calibration images is of a single colour"):
        calibrate_ranges(build_small_graph(), [plain])
    assert (
        calibrate_ranges(build_small_graph(), [NOISE, plain]).images == 6
    )  # one varying image is enough


def test_no_images_are_refused() -> None:
    with pytest.raises(SettingError, match="no images to calibrate on"):
        calibrate_ranges(build_small_graph(), [])


def test_a_layer_that_is_always_zero_is_named() -> None:
    with pytest.raises(SettingError, match="layer first is zero for all of the 3 calibration"):
        calibrate_ranges(build_small_graph(bias=-100.0), [NOISE])


def test_a_network_without_confidence_is_refused() -> None:
    ranges = calibrate_ranges(build_small_graph(), [NOISE])
    with pytest.raises(SettingError, match="gives no confidence"):
        quantise_network(
            build_small_graph(), ranges, replace(ABOUT, channels=("log_depth", "class"))
        )


def test_network_that_violates_its_invariants_is_refused() -> None:
    network = quantise_network(
        build_small_graph(), calibrate_ranges(build_small_graph(), [NOISE]), ABOUT
    )
    first = network.layers[0]
    assert isinstance(first, Conv)
    loud = replace(first, bias=np.full(4, 2**31 - 1, np.int32))
    with pytest.raises(ModelError, match="layer first can overflow int32"):
        replace(network, layers=(loud, *network.layers[1:]))
    late = replace(first, source=2)
    with pytest.raises(ModelError, match="layer first reads tensors"):
        replace(network, layers=(late, *network.layers[1:]))


@given(st.lists(st.floats(0.25, 2.0**32), min_size=1, max_size=5))
def test_fixed_point_multipliers_round_by_less_than_an_eighth_of_a_step(
    divisors: list[float],
) -> None:
    multipliers, shift = _to_fixed_point(np.array(divisors))
    assert 1 <= shift <= 32
    for divisor, multiplier in zip(divisors, multipliers.tolist(), strict=True):
        assert 1 <= multiplier < 2**31
        largest = min(2.0**24, 256 * divisor)  # the sum of 500 weights, or where values clamp
        assert abs(multiplier / 2**shift - 1 / divisor) * largest <= 1 / 8


@pytest.mark.parametrize(
    ("divisor", "wanted"),
    [(8.0, (2**29, 32)), (4.0, (2**29, 31)), (1.0, (2**29, 29)), (2.0**40, (1, 32))],
)
def test_shift_is_32_if_the_high_word_suffices(divisor: float, wanted: tuple[int, int]) -> None:
    (multiplier,), shift = _to_fixed_point(np.array([divisor]))
    assert (multiplier, shift) == wanted


@given(st.integers(2, 2047).map(lambda half: 2 * half + 1), st.integers(0, 255), st.integers(-2, 2))
def test_multiplying_and_shifting_equals_division_rounded_down(
    divisor: int, level: int, beside: int
) -> None:
    (multiplier,), shift = _to_fixed_point(np.array([float(divisor)]))
    total = max(level * divisor + beside, 0)
    assert total * int(multiplier) >> shift == total // divisor
    assert np.rint((total - divisor // 2) / divisor) == total // divisor


def test_divisors_are_odd_and_gains_have_16_bits() -> None:
    divisors = _round_to_odd(np.array([0.3, 1.0, 2.9, 3.0, 100.2, 101.0]))
    assert divisors.tolist() == [0.25, 1.0, 1.0, 3.0, 99.0, 101.0]
    gains = _limit_bits(np.array([0.2, 3.4, 65535.0, 131_071.0, 8_388_000.0]))
    assert gains.tolist() == [0.0, 3.0, 65535.0, 131_072.0, 8_387_968.0]
    for seed in range(10):
        for layer in quantised_network(seed).layers:
            if isinstance(layer, Conv):
                assert ((layer.divisor % 2 == 1) | (1 / layer.divisor % 1 == 0)).all()


@pytest.mark.parametrize("shortcut", [False, True])
def test_sums_are_rounded_to_the_nearest_level(shortcut: bool) -> None:
    """The error is about half a level at most, without a bias to either side."""
    first, head = build_small_graph().layers
    assert isinstance(first, FloatConv)
    sources = (1, 1) if shortcut else (1,)
    second = FloatConv("second", sources, np.eye(4)[:, :, None, None], np.zeros(4), relu=True)
    graph = FloatGraph((first, second, replace(head, sources=(2,))), ((3, 0), (3, 1)))
    network = quantise_network(graph, calibrate_ranges(graph, [NOISE]), ABOUT)
    _, before, after, _ = reference.iter_tensors(network, NOISE[0])
    one, two = network.layers[:2]
    wanted = before * one.scale * (2 if shortcut else 1) / two.scale
    beside = (after - wanted)[(after > 0) & (after < 255)]
    assert np.abs(beside).max() < 0.6
    assert abs(beside.mean()) < 0.05


def test_largest_calibration_value_maps_to_the_last_level() -> None:
    """Unsigned tensors use the full range 0 to 255, signed ones -127 to 127."""
    rng = np.random.default_rng(2)
    first = build_small_graph().layers[0]
    assert isinstance(first, FloatConv)
    second = FloatConv("second", (1,), rng.normal(0, 0.5, (4, 4, 1, 1)), np.zeros(4))
    head = FloatConv("head", (2,), rng.normal(0, 0.5, (2, 4, 1, 1)), np.array([0.1, -2.0]))
    graph = FloatGraph((first, second, head), ((3, 0), (3, 1)))
    network = quantise_network(graph, calibrate_ranges(graph, [NOISE]), ABOUT)
    tensors = [list(reference.iter_tensors(network, image)) for image in NOISE]
    unsigned, signed = (np.stack([t[k] for t in tensors]) for k in (1, 2))
    assert (unsigned.min(), unsigned.max()) == (0, pytest.approx(255, abs=2))
    assert np.abs(signed).max() == pytest.approx(127, abs=2)
    assert signed.min() < 0


def test_calibration_ranges_cover_all_images_in_network_colours() -> None:
    alone = calibrate_ranges(build_small_graph(), [NOISE])
    for parts in ([NOISE[:1], NOISE[1:]], [NOISE[1:], NOISE[:1]], [NOISE[2:], NOISE[:2]]):
        together = calibrate_ranges(build_small_graph(), parts)
        for one, other in ((together.low, alone.low), (together.high, alone.high)):
            for a, b in zip(one, other, strict=True):
                np.testing.assert_array_equal(a, b)
    assert (together.images, together.height_px, together.width_px) == (3, 16, 24)
    grey = calibrate_ranges(build_small_graph().to_grey(), [NOISE])
    assert grey.high[0].tolist() == [float(normalize_images(rgb_to_grey(NOISE)).max())]


def test_lookup_tables_convert_units_by_output_name() -> None:
    """Offsets from the middle of a cell become distances from its edge in 1/16 px."""
    for name in ("offset_u", "offset_v"):
        assert HEAD_CONVERSIONS[name](np.array([0.0, -0.5, 0.5, 1.0]), 8).tolist() == [
            64,
            0,
            128,
            192,
        ]
        assert HEAD_CONVERSIONS[name](np.array([-1e6, 1e6]), 8).tolist() == [-32768, 32767]
    logits = np.array([0.0, 2.0, -1e3, 1e3])
    wanted = [32767.5, 65535 / (1 + np.exp(-2)), 0, 65535]
    assert HEAD_CONVERSIONS["confidence"](logits, 8) == pytest.approx(np.array(wanted), abs=1e-6)
    depths = HEAD_CONVERSIONS["depth"](np.array([0.0, np.log(2.5), 9.0, 99.0]), 8)
    assert depths == pytest.approx(np.array([1000, 2500, 65535, 65535]))
