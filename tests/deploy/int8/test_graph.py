"""Conversion of torch networks to plain layers."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from dmrl.deploy.int8.graph import (
    FloatAdd,
    FloatGraph,
    build_graph,
    compute_tensors,
    normalize_images,
    rgb_to_grey,
    select_outputs,
)
from dmrl.errors import ModelError
from dmrl.learn.networks import architectures as networks
from dmrl.learn.networks.architectures import Network, build_network
from dmrl.learn.networks.trace import trace_operations

IMAGES = np.random.default_rng(0).integers(0, 256, (2, 48, 64, 3)).astype(np.uint8)


def build_settled_network(name: str) -> Network:
    """Return a network whose normalisations have the statistics of images, as after training."""
    network = build_network(name, seed=1).train()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=torch.manual_seed(2))
        for _ in range(5):
            network(to_torch_input(IMAGES))
    return network.eval()


def to_torch_input(images: np.ndarray) -> Tensor:
    """Return images (N, H, W, 3) as normalised input of torch."""
    return networks.normalize_images(torch.from_numpy(images).permute(0, 3, 1, 2))


def compute_outputs(graph: FloatGraph, images: np.ndarray) -> np.ndarray:
    """Return the outputs of a graph for images (N, H, W, 3)."""
    return select_outputs(graph, compute_tensors(graph, normalize_images(images)))


@pytest.mark.parametrize("name", ["locanet", "dmrl-nano", "dmrl-nano-fine"])
@pytest.mark.heavy
def test_layers_equal_torch(name: str) -> None:
    network = build_settled_network(name)
    with torch.no_grad():
        wanted = network(to_torch_input(IMAGES)).numpy()
    got = compute_outputs(build_graph(trace_operations(network)), IMAGES)
    assert np.ptp(wanted) > 0.1
    np.testing.assert_allclose(got, wanted, atol=2e-5 * np.abs(wanted).max())


def test_a_grey_network_gives_the_same_on_grey_images() -> None:
    graph = build_graph(trace_operations(build_settled_network("locanet")))
    grey = rgb_to_grey(IMAGES)
    wanted = compute_outputs(graph, np.repeat(grey, 3, axis=3))
    np.testing.assert_allclose(compute_outputs(graph.to_grey(), grey), wanted, rtol=1e-4, atol=1e-5)


def test_grey_conversion_keeps_grey_images() -> None:
    levels = np.arange(256, dtype=np.uint8).reshape(1, 16, 16, 1)
    np.testing.assert_array_equal(rgb_to_grey(np.repeat(levels, 3, axis=3)), levels)


class Odd(Network):
    """A network with any layer or function between two convolutions."""

    def __init__(self, part: nn.Module | Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.first, self.last = nn.Conv2d(3, 4, 3, padding=1), nn.LazyConv2d(2, 1)
        self.part = part
        self(torch.zeros(1, 3, 16, 16))

    def forward(self, images: Tensor) -> Tensor:
        out: Tensor = self.last(self.part(self.first(images)))
        return out


@pytest.mark.parametrize(
    ("part", "words"),
    [
        (nn.LeakyReLU(), r"layer part is a LeakyReLU, .* Use ReLU$"),
        (nn.AvgPool2d(2), r"layer part is an AvgPool2d, .* Use a strided convolution"),
        (nn.Conv2d(4, 4, 5), r"layer part is a 5 x 5 convolution, .* Use 1x1 or 3x3"),
        (nn.Conv2d(4, 4, 3, groups=2), r"layer part is a convolution in 2 groups, .* depthwise"),
        (nn.Conv2d(4, 4, 3, padding=2), r"layer part is a convolution with padding 2, .* 'same'"),
        (nn.Conv2d(4, 4, 3, (1, 2)), r"layer part .* differs by direction, .* one stride"),
        (nn.MaxPool2d(3), r"layer part is a max-pool with .* Use 2x2 max-pools"),
        (nn.MaxPool2d(2, ceil_mode=True), r"layer part is a max-pool with .*ceil.* Use 2x2"),
        (nn.Sequential(nn.ReLU(), nn.BatchNorm2d(4)), r"part.1 is a BatchNorm2d apart from a conv"),
        (lambda x: torch.cat([x, x], 1), r"layer cat is a concatenation inside the network"),
        (lambda x: x * x, r"layer mul is a mul, .* Use a convolution"),
        (lambda x: x + 1, r"layer add is an add of a number"),
        (lambda x: x if x.sum() > 0 else -x, r"layer sum is a sum, .* Use convolutions"),
    ],
)
def test_unsupported_layer_error_names_a_replacement(
    part: nn.Module | Callable[[Tensor], Tensor], words: str
) -> None:
    with pytest.raises(ModelError, match=words):
        build_graph(trace_operations(Odd(part)))


def test_heads_may_be_separate_convolutions() -> None:
    class TwoHeads(Network):
        def __init__(self) -> None:
            super().__init__()
            self.body = nn.Conv2d(3, 4, 3, padding=1)
            self.depth, self.confidence = nn.Conv2d(4, 1, 1), nn.Conv2d(4, 1, 1)

        def forward(self, images: Tensor) -> Tensor:
            x = self.body(images).relu()
            return torch.cat([self.depth(x), self.confidence(x)], 1)

    network = TwoHeads().eval()
    graph = build_graph(trace_operations(network))
    assert graph.outputs == ((2, 0), (3, 0))
    with torch.no_grad():
        wanted = network(to_torch_input(IMAGES)).numpy()
    np.testing.assert_allclose(compute_outputs(graph, IMAGES), wanted, atol=1e-5)


class Summed(Network):
    """A network with a sum of two branches, one of which may be used again."""

    def __init__(self, branch: nn.Module, *, twice: bool = False) -> None:
        super().__init__()
        self.first, self.branch, self.twice = nn.Conv2d(3, 4, 3, padding=1), branch, twice
        self.last = nn.Conv2d(4, 2, 1)

    def forward(self, images: Tensor) -> Tensor:
        x = self.first(images).relu()
        y = self.branch(x)
        both = (x + y).relu()
        out: Tensor = self.last(both + y if self.twice else both)
        return out


@pytest.mark.parametrize(
    ("network", "sums"),
    [
        (Summed(nn.Conv2d(4, 4, 1)), 0),
        (Summed(nn.Conv2d(4, 4, 3, padding=2, dilation=2)), 0),
        (Summed(nn.Conv2d(4, 4, 3, padding=1, groups=4)), 1),
        (Summed(nn.Sequential(nn.Conv2d(4, 4, 1), nn.ReLU())), 1),
        (Summed(nn.Conv2d(4, 4, 1), twice=True), 2),
    ],
)
def test_residual_sum_is_fused_into_the_preceding_dense_convolution(
    network: Network, sums: int
) -> None:
    network.eval()
    graph = build_graph(trace_operations(network))
    assert sum(isinstance(layer, FloatAdd) for layer in graph.layers) == sums
    with torch.no_grad():
        wanted = network(to_torch_input(IMAGES)).numpy()
    np.testing.assert_allclose(compute_outputs(graph, IMAGES), wanted, atol=1e-5)
