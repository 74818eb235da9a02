"""Random small float networks, and their int8 networks from the quantiser."""

from dataclasses import replace
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from dmrl.deploy.int8.activation_ranges import calibrate_ranges
from dmrl.deploy.int8.equalisation import equalise_channels
from dmrl.deploy.int8.graph import (
    FloatAdd,
    FloatConv,
    FloatGraph,
    FloatLayer,
    FloatPool,
    build_graph,
    compute_tensors,
    normalize_images,
)
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.quantise import NetworkInfo, quantise_network
from dmrl.deploy.int8.rounding import measure_moments
from dmrl.learn.networks.architectures import build_network
from dmrl.learn.networks.trace import trace_operations

SUB_CELL = ("log_depth", "confidence", "offset_u", "offset_v")


class _GraphBuilder:
    """A float network that grows layer by layer, with images to compute its shapes."""

    def __init__(self, rng: np.random.Generator, images: NDArray[np.uint8]) -> None:
        self.rng = rng
        self.layers: list[FloatLayer] = []
        self.channels = images.shape[3]
        self.input = normalize_images(images)

    @property
    def graph(self) -> FloatGraph:
        return FloatGraph(tuple(self.layers), (), self.channels)

    @property
    def shape(self) -> tuple[int, ...]:
        """Return channels, rows and columns of the last tensor."""
        return compute_tensors(self.graph, self.input)[-1].shape[1:]

    def conv(self, outs: int, kernel: int, *, depthwise: bool = False, stride: int = 1,
             dilation: int = 1, relu: bool = True) -> None:  # fmt: skip
        ins = self.shape[0]
        shape = (ins, 1, kernel, kernel) if depthwise else (outs, ins, kernel, kernel)
        spread = 1.5 / np.sqrt(np.prod(shape[1:]))
        # The scales of channels differ widely, as after folding a normalisation.
        size = np.exp(self.rng.normal(0, 1, shape[0]))
        weight = self.rng.normal(0, spread, shape) * size[:, None, None, None]
        bias = self.rng.normal(0.2, 0.3, shape[0]) * size
        padding = dilation * (kernel // 2)
        groups = ins if depthwise else 1
        source = (len(self.layers),)
        name = f"conv{len(self.layers)}"
        self.layers.append(
            FloatConv(name, source, weight, bias, stride, dilation, padding, groups, relu)
        )

    def residual(self, dilation: int) -> None:
        source, width = len(self.layers), self.shape[0]
        self.conv(0, 3, depthwise=True, dilation=dilation)
        self.conv(width, 1, relu=False)
        relu = bool(self.rng.random() < 0.7)
        last = self.layers[-1]
        assert isinstance(last, FloatConv)
        if self.rng.random() < 0.7:
            self.layers[-1] = replace(last, sources=(*last.sources[:1], source), relu=relu)
        else:
            self.layers.append(FloatAdd(f"add{source}", (source, len(self.layers)), relu))

    def grow(self) -> None:
        rng, small = self.rng, min(self.shape[1:]) < 6
        stride = 1 if small else int(rng.choice([1, 2]))
        dilation = int(rng.choice([1, 2, 4]))
        match rng.choice(["conv", "depthwise", "pool", "residual", "pointwise"]):
            case "pool" if self.layers and not small:
                self.layers.append(FloatPool(f"pool{len(self.layers)}", (len(self.layers),)))
            case "depthwise" if self.layers:
                self.conv(0, 3, depthwise=True, stride=stride, dilation=dilation)
            case "residual" if self.layers:
                self.residual(dilation)
            case "pointwise":
                self.conv(int(rng.integers(1, 13)), 1, relu=bool(rng.random() < 0.8))
            case _:
                self.conv(int(rng.integers(2, 13)), 3, stride=stride)


def random_graph(seed: int) -> tuple[FloatGraph, tuple[str, ...], NDArray[np.uint8]]:
    """Draw a float network; return it, its outputs and (4, height, width, channels) images."""
    rng = np.random.default_rng(seed)
    height, width = (int(side) for side in rng.integers(12, 41, 2))
    images = rng.integers(0, 256, (4, height, width, int(rng.choice([1, 3])))).astype(np.uint8)
    net = _GraphBuilder(rng, images)
    for _ in range(int(rng.integers(2, 6))):
        net.grow()
    channels = SUB_CELL if rng.random() < 0.5 else SUB_CELL[:2]
    net.conv(len(channels), 1, relu=False)
    tensor = len(net.layers)
    outputs = tuple((tensor, place) for place in range(len(channels)))
    return FloatGraph(tuple(net.layers), outputs, images.shape[3]), channels, images


def draw_rgb_images(seed: int) -> NDArray[np.uint8]:
    """Return the images of ``random_graph(seed)`` with three channels."""
    images = random_graph(seed)[2]
    return np.repeat(images, 3, axis=3) if images.shape[3] == 1 else images


@cache
def quantised_network(seed: int) -> IntegerNetwork:
    """Quantise ``random_graph(seed)``, which takes images of at most 40 x 40 px."""
    graph, channels, _ = random_graph(seed)
    rgb = draw_rgb_images(seed)
    graph, ranges = equalise_channels(graph, calibrate_ranges(graph, [rgb]))
    about = NetworkInfo("random", "random", 8, channels, 0.3)
    return quantise_network(graph, ranges, about, measure_moments(graph, rgb))


def quantise_untrained(name: str, width_px: int = 320, height_px: int = 224) -> IntegerNetwork:
    """Return an architecture with initial weights, quantised to int8."""
    with torch.random.fork_rng(devices=[]):
        network = build_network(name).eval()
    graph = build_graph(trace_operations(network))
    images = np.random.default_rng(0).integers(0, 256, (1, height_px, width_px, 3), np.uint8)
    about = NetworkInfo(name, name, network.stride_px, network.channels, 0.3)
    return quantise_network(graph, calibrate_ranges(graph, [images]), about)
