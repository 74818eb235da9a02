"""Invariants of integer layers and heads, at their limits."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dmrl.deploy.int8.layers import Add, Conv, MaxPool
from dmrl.deploy.int8.network import Head, IntegerNetwork
from dmrl.errors import ModelError

SHAPE = (3, 8, 10)


def build_conv(outs: int = 2, kernel: int = 3, ins: int = 3, **more: Any) -> Conv:
    """Return a convolution whose weights are 1."""
    full = {
        "weight": np.ones((outs, ins, kernel, kernel), np.int8),
        "bias": np.zeros(outs, np.int32),
        "multiplier": np.full(outs, 2**30, np.int32),
        "shift": 30,
    }
    return Conv("conv", **{"source": 0, **full, **more})


def is_sound(
    layer: Any, *shapes: tuple[int, int, int], signed: tuple[bool, ...] = (False,)
) -> bool:
    """Return whether a layer accepts inputs of these shapes and signedness."""
    return next(layer.iter_faults(shapes or (SHAPE,), signed), None) is None


@pytest.mark.parametrize("signed", [False, True])
def test_a_sum_may_be_as_large_as_int32(signed: bool) -> None:
    most = 27 * (128 if signed else 255)  # the largest input times 27 weights of 1
    for bias, good in ((2**31 - 1 - most, True), (2**31 - most, False)):
        for sign in (1, -1):
            layer = build_conv(bias=np.array([0, sign * bias], np.int32))
            assert is_sound(layer, signed=(signed,)) == good


@pytest.mark.parametrize(
    ("field", "value", "good"),
    [
        ("shift", 0, False),
        ("shift", 1, True),
        ("shift", 32, True),
        ("shift", 33, False),
        ("multiplier", np.array([0, 9]), False),
        ("multiplier", np.array([1, 2**31 - 1]), True),
    ],
)
def test_multipliers_have_31_bits_and_shifts_1_to_32(field: str, value: Any, good: bool) -> None:
    assert is_sound(build_conv(**{field: value})) == good


def test_shortcut_needs_the_output_shape_and_a_size_preserving_convolution() -> None:
    both, gain = (False, True), np.full(2, 7 << 8, np.int32)

    def beside(shape: tuple[int, int, int], **more: Any) -> bool:
        layer = build_conv(**{"padding": 1, "shortcut": 1, "gain": gain, **more})
        return is_sound(layer, SHAPE, shape, signed=both)

    assert beside((2, 8, 10))
    assert not beside((3, 8, 10))
    assert not beside((2, 8, 9))
    assert not beside((2, 6, 8), padding=0)
    assert not beside((2, 4, 5), stride=2)
    assert not beside((3, 8, 10), outs=3, ins=1, groups=3, gain=np.full(3, 7 << 8, np.int32))
    assert beside((2, 8, 10), gain=gain * 0 + 2**23 - 1)
    assert not beside((2, 8, 10), gain=gain * 0 + 2**23)
    assert not beside((2, 8, 10), gain=-gain)
    most = 2**31 - 1 - 27 * 255
    for signed, largest in ((False, 255), (True, 128)):
        for left, good in ((0, True), (-1, False)):
            bias = np.array([0, most - 7 * largest - left], np.int32)
            layer = build_conv(padding=1, shortcut=1, gain=gain, bias=bias)
            assert is_sound(layer, SHAPE, (2, 8, 10), signed=(False, signed)) == good


def test_weights_fit_the_channels_they_read() -> None:
    assert is_sound(build_conv(kernel=1))
    assert not is_sound(build_conv(ins=2))
    assert not is_sound(build_conv(weight=np.ones((2, 3, 2, 2), np.int8)))
    assert not is_sound(build_conv(weight=np.ones((2, 3, 3, 1), np.int8)))
    assert is_sound(build_conv(outs=3, ins=1, groups=3))
    assert not is_sound(build_conv(outs=2, ins=1, groups=3))
    assert not is_sound(build_conv(outs=4, ins=2, groups=2), (4, 8, 8))


@pytest.mark.parametrize(
    ("kernel", "stride", "dilation", "padding"),
    [(3, 1, 1, 1), (3, 2, 1, 1), (3, 1, 4, 4), (3, 2, 2, 0), (1, 1, 1, 0), (1, 2, 1, 0)],
)
def test_convolution_shape_and_mac_count_follow_kernel_positions(
    kernel: int, stride: int, dilation: int, padding: int
) -> None:
    layer = build_conv(kernel=kernel, stride=stride, dilation=dilation, padding=padding)

    def places(side: int) -> int:
        last = side + 2 * padding - dilation * (kernel - 1) - 1
        return len([k for k in range(side + 2 * padding) if k % stride == 0 and k <= last])

    wanted = (2, places(8), places(10))
    assert layer.output_shape((SHAPE,)) == wanted
    assert layer.count_macs((SHAPE,)) == np.prod(wanted) * 3 * kernel**2
    assert MaxPool("pool", 0).output_shape(((4, 9, 6),)) == (4, 4, 3)


def test_pools_keep_signedness_and_sums_need_equal_shapes() -> None:
    assert is_sound(MaxPool("pool", 0, signed=True), signed=(True,))
    assert not is_sound(MaxPool("pool", 0, signed=True))
    both = (False, True)
    assert not is_sound(Add("add", (0, 1), (2**20, 1), 20), SHAPE, (3, 8, 9), signed=both)
    for multipliers, shift, good in (
        ((2**20, 0), 1, True),
        ((0, 2**21 - 1), 30, True),
        ((2**20, 2**21), 20, False),
        ((2**20 - 1, 5), 20, False),
        ((-1, 2**20), 20, False),
        ((2**20, 0), 0, False),
        ((2**20, 0), 31, False),
    ):
        assert is_sound(Add("add", (0, 1), multipliers, shift), SHAPE, SHAPE, signed=both) == good


def build_network(**more: Any) -> IntegerNetwork:
    """Return a network of one layer with two heads, whose confidence rises by 257 per level."""
    table = (np.arange(256) * 257).astype(np.int32)
    heads = {"confidence": Head(1, 0, 0.1, 0, table), "depth": Head(1, 1, 0.1, 0, table)}
    layers = (build_conv(signed=True, padding=1, pad_value=128),)
    fields = {"layers": layers, "threshold": 0.5, **heads, **more}
    return IntegerNetwork("a", "b", 3, 8, 10, 8, **fields)


def test_threshold_is_the_first_level_at_or_above_it() -> None:
    believed = 0.5 * 65535
    q = build_network().threshold_q
    assert (
        build_network().confidence.table[q + 128]
        >= believed
        > build_network().confidence.table[q + 127]
    )
    assert build_network(threshold=0.0).threshold_q == -128
    assert build_network(threshold=1.0).threshold_q == 127
    low = replace(build_network().confidence, table=np.zeros(256, np.int32))
    assert build_network(confidence=low).threshold_q == 128


def test_heads_are_signed_grid_tensors_without_consumers() -> None:
    build_network()
    unsigned = (build_conv(padding=1, pad_value=128),)
    read = (*build_network().layers, build_conv(ins=2, kernel=1, signed=True, source=1))
    small = (*build_network().layers, build_conv(ins=2, stride=2, signed=True, source=1))
    other = Head(2, 1, 0.1, 0, build_network().depth.table)
    for change in ({"layers": unsigned}, {"layers": read}, {"layers": small, "depth": other}):
        with pytest.raises(ModelError, match="is not a signed tensor of the grid"):
            build_network(**change)
    late = (replace(build_network().layers[0], source=1),)
    with pytest.raises(ModelError, match="layer conv reads tensors"):
        build_network(layers=late)
    with pytest.raises(ModelError, match="layer conv has a multiplier or shift out of range"):
        build_network(layers=(replace(build_network().layers[0], shift=0),))
