"""Random small int8 networks with strides, dilations, depthwise layers, sums and heads."""

from functools import cache

import numpy as np

from dmrl.deploy.int8.layers import PIXEL_ZERO, SIGNED_OFFSET, Add, AnyLayer, Conv, MaxPool, Shape
from dmrl.deploy.int8.network import CONFIDENCE_ONE, Head, IntegerNetwork
from dmrl.deploy.int8.reference import accumulate, compute_layer

Rng = np.random.Generator


class _NetworkBuilder:
    """A network that grows layer by layer; a noise image runs through it to set the scales."""

    def __init__(self, rng: Rng, shape: Shape) -> None:
        self.rng = rng
        self.layers: list[AnyLayer] = []
        self.tensors = [rng.integers(0, 256, shape).astype(np.int16)]
        self.signed = [False]

    @property
    def shape(self) -> Shape:
        return self.tensors[-1].shape  # type: ignore[return-value]

    def grow(self, layer: AnyLayer) -> None:
        self.layers.append(layer)
        self.tensors.append(compute_layer(layer, *(self.tensors[k] for k in layer.sources)))
        self.signed.append(layer.signed)

    def conv(self, outs: int, kernel: int, *, depthwise: bool = False, stride: int = 1,
             dilation: int = 1, signed: bool = False, shortcut: int = -1) -> None:  # fmt: skip
        rng, channels = self.rng, self.shape[0]
        outs = channels if depthwise else outs
        ins = 1 if depthwise else channels
        padding = dilation * (kernel // 2) if rng.random() < 0.9 else 0
        if min(self.shape[1:]) + 2 * padding < dilation * (kernel - 1) + 1:
            padding = dilation
        draft = Conv(
            name=f"conv{len(self.layers)}",
            source=len(self.tensors) - 1,
            weight=rng.integers(-127, 128, (outs, ins, kernel, kernel)).astype(np.int8),
            bias=rng.integers(-20000, 20000, outs).astype(np.int32),
            multiplier=np.full(outs, 2**30, np.int32),
            shift=1,
            stride=stride,
            dilation=dilation,
            padding=padding,
            groups=channels if depthwise else 1,
            signed=signed,
            pad_value=0 if self.layers else PIXEL_ZERO,
            shortcut=shortcut,
            gain=rng.integers(0, 50_000, outs if shortcut >= 0 else 0).astype(np.int32),
        )
        inputs = [self.tensors[k] for k in draft.sources]
        acc = np.abs(accumulate(draft, *inputs)).reshape(outs, -1).max(axis=1)
        factor = rng.uniform(0.5, 1.5, outs) * (127 if signed else 255) / np.maximum(acc, 1)
        shift = min(32, 30 - int(np.frexp(factor.max())[1])) - int(rng.choice([0, 0, 2]))
        multiplier = np.maximum(np.round(factor * 2.0**shift), 1).astype(np.int32)
        fields = {name: getattr(draft, name) for name in draft.__slots__}
        offset = SIGNED_OFFSET * 2.0**shift / multiplier if signed else np.zeros(outs)
        bias = (draft.bias + np.rint(offset)).astype(np.int32)
        fields |= {"multiplier": multiplier, "shift": shift, "bias": bias}
        self.grow(Conv(**fields))

    def add(self, other: int, *, signed: bool) -> None:
        a, b = self.rng.integers(2**18, 2**21, 2)
        top = int(self.rng.integers(2**20, 2**21))
        multipliers = (top, int(b)) if self.rng.random() < 0.5 else (int(a), top)
        sources = (len(self.tensors) - 1, other)
        name = f"add{len(self.layers)}"
        self.grow(Add(name, sources, multipliers, int(self.rng.integers(20, 23)), signed=signed))


@cache
def random_network(seed: int) -> IntegerNetwork:
    """Draw a network of 3 to 9 layers for images of at most 40 x 40 px."""
    rng = np.random.default_rng(seed)
    channels = int(rng.choice([1, 3]))
    height, width = (int(x) for x in rng.integers(12, 41, 2))
    net = _NetworkBuilder(rng, (channels, height, width))
    for _ in range(int(rng.integers(2, 6))):
        _grow_some(net, rng)
    return _with_heads(net, rng)


def _grow_some(net: _NetworkBuilder, rng: Rng) -> None:
    """Append a random layer, or a residual block, to a network."""
    small = min(net.shape[1:]) < 8
    kind = rng.choice(["conv", "conv", "depthwise", "pool", "residual", "pointwise"])
    stride = 1 if small else int(rng.choice([1, 1, 2]))
    dilation = int(rng.choice([1, 1, 2, 4]))
    if kind == "pool" and not small and net.layers:
        net.grow(MaxPool(f"pool{len(net.layers)}", len(net.tensors) - 1, signed=net.signed[-1]))
    elif kind == "depthwise" and net.layers:
        net.conv(0, 3, depthwise=True, stride=stride, dilation=dilation)
    elif kind == "pointwise":
        net.conv(int(rng.integers(1, 13)), 1, stride=stride, signed=bool(rng.random() < 0.3))
    elif kind == "residual" and net.layers:
        _grow_residual(net, rng, dilation)
    else:
        net.conv(int(rng.integers(1, 13)), 3, stride=stride, dilation=1)


def _grow_residual(net: _NetworkBuilder, rng: Rng, dilation: int) -> None:
    """Add x + f(x), with or without ReLU, where f is a depthwise and a 1x1 convolution."""
    source, shape = len(net.tensors) - 1, net.shape
    net.conv(0, 3, depthwise=True, dilation=dilation)
    if net.shape == shape and rng.random() < 0.5:
        net.conv(shape[0], 1, signed=bool(rng.random() < 0.3), shortcut=source)
    elif net.shape == shape:
        net.conv(shape[0], 1, signed=bool(rng.random() < 0.5))
        net.add(source, signed=bool(rng.random() < 0.3))


def _with_heads(net: _NetworkBuilder, rng: Rng) -> IntegerNetwork:
    """Append the heads, with offsets in half of all cases; return the network."""
    offsets = bool(rng.random() < 0.5)
    net.conv(4 if offsets else 2, 1, signed=True)
    tensor, stride_px = len(net.tensors) - 1, 8
    steps = np.arange(256)
    confidence = np.round(CONFIDENCE_ONE / (1 + np.exp(-(steps - 128) / 20)))
    depth = np.round(1000 * np.exp((steps - 128) / 80))
    offset = np.clip(steps - 64, 0, 127)
    tables = [confidence, depth, offset, offset][: 4 if offsets else 2]
    heads = [Head(tensor, k, 0.05, 0, table.astype(np.int32)) for k, table in enumerate(tables)]
    _, rows, cols = net.tensors[0].shape
    return IntegerNetwork(
        "random", "random", net.tensors[0].shape[0], rows, cols, stride_px, tuple(net.layers),
        *heads, threshold=0.3,
    )  # fmt: skip
