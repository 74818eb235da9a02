"""Traces of networks into operations, from modules and from functions."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import max_pool2d, relu

from dmrl.learn.networks.architectures import Network
from dmrl.learn.networks.trace import Op, trace_operations


class Small(Network):
    """A network of a convolution, a given step and another convolution."""

    def __init__(self, step: Callable[[Tensor], Tensor], bias: bool = True) -> None:
        super().__init__()
        self.first = nn.Conv2d(3, 4, 3, stride=2, padding=2, dilation=2, bias=bias)
        self.last = nn.LazyConv2d(2, 1)
        self.step = step
        self(torch.zeros(1, 3, 64, 64))

    def forward(self, images: Tensor) -> Tensor:
        out: Tensor = self.last(self.step(self.first(images)))
        return out


def trace_step(step: Any) -> list[Op]:
    """Return the operations of a step, traced between two convolutions."""
    image, first, *found, last, output = trace_operations(Small(step))
    assert (image.kind, first.sources, last.kind) == ("image", (image.name,), "conv")
    assert (output.kind, output.sources) == ("output", (last.name,))
    return found


@pytest.mark.parametrize(
    ("step", "settings"),
    [
        (nn.MaxPool2d(2), {"kernel": 2, "stride": 2}),
        (nn.MaxPool2d(3, 1, (1, 1)), {"kernel": 3, "stride": 1, "padding": 1}),
        (lambda x: max_pool2d(x, 2), {"kernel": 2, "stride": 2}),
        (lambda x: max_pool2d(x, (3, 3), 2), {"kernel": 3, "stride": 2}),
        (lambda x: max_pool2d(x, kernel_size=3, stride=2), {"kernel": 3, "stride": 2}),
        (
            lambda x: max_pool2d(x, 2, padding=1, ceil_mode=True),
            {"kernel": 2, "stride": 2, "padding": 1, "ceil": True},
        ),
        (lambda x: max_pool2d(x, 2, dilation=2), {"kernel": 2, "stride": 2, "dilation": 2}),
        (nn.MaxPool2d((2, 3), 2), {"kernel": (2, 3), "stride": 2}),
    ],
)
def test_max_pool_is_traced_from_module_and_function(step: Any, settings: dict[str, Any]) -> None:
    (pool,) = trace_step(step)
    assert (pool.kind, pool.settings) == ("max_pool", settings)


def test_functions_are_traced_by_kind_and_no_ops_are_skipped() -> None:
    for step in (nn.ReLU(), torch.relu, relu, lambda x: x.relu()):
        assert [op.kind for op in trace_step(step)] == ["relu"]
    for nothing in (nn.Identity(), nn.Dropout(0.5), lambda x: x.float().contiguous().clone()):
        assert trace_step(nothing) == []
    twice = trace_step(lambda x: relu(relu(x)))
    assert [op.name for op in twice] == ["relu", "relu_1"]
    assert twice[1].sources == ("relu",)
    (added,) = trace_step(lambda x: x + x)
    assert (added.kind, added.sources) == ("add", ("first", "first"))
    for odd in (lambda x: x + 1, lambda x: torch.add(x, x, alpha=2)):
        assert [op.kind for op in trace_step(odd)] == ["add of a number"]
    (joined,) = trace_step(lambda x: torch.cat([x, x], 1))
    assert (joined.kind, joined.sources) == ("concatenate", ("first", "first"))


def test_traced_convolutions_and_norms_have_their_settings_and_values() -> None:
    norm = nn.BatchNorm2d(4)
    with torch.no_grad():
        for values in (norm.weight, norm.bias, norm.running_mean):
            values.copy_(torch.randn(4, generator=torch.manual_seed(0)))  # type: ignore[union-attr]
        norm.running_var.fill_(2.0)  # type: ignore[union-attr]
    network = Small(norm, bias=False)
    norm.running_mean.fill_(0.5)  # type: ignore[union-attr]
    norm.running_var.fill_(2.0)  # type: ignore[union-attr]
    _, conv, found, *_ = trace_operations(network)
    assert conv.settings == {"stride": 2, "dilation": 2, "padding": 2, "groups": 1}
    assert (conv.values["weight"] == network.first.weight.detach().numpy()).all()
    assert not conv.values["bias"].any()
    x = torch.randn(1, 4, 3, 3, generator=torch.manual_seed(1))
    with torch.no_grad():
        wanted = norm.eval()(x).numpy()
    factor, summand = (found.values[name][:, None, None] for name in ("factor", "summand"))
    np.testing.assert_allclose(x.numpy() * factor + summand, wanted, atol=1e-6)


def test_tracing_leaves_the_network_unchanged() -> None:
    network = Small(nn.BatchNorm2d(4)).train()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    trace_operations(network)
    assert network.training
    assert all(torch.equal(before[name], value) for name, value in network.state_dict().items())
    assert not any(module._forward_hooks for module in network.modules())
