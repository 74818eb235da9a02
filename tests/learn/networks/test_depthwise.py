"""The depthwise convolution, compared with that of torch."""

import pytest
import torch
from torch import nn

from dmrl.learn.networks.depthwise import DepthwiseConv


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("stride", "dilation", "shape"),
    [(1, 1, (28, 40)), (1, 2, (9, 11)), (1, 4, (28, 40)), (1, 8, (28, 40)), (2, 1, (12, 8))],
)
def test_depthwise_gradients_equal_torch(
    stride: int, dilation: int, shape: tuple[int, int]
) -> None:
    torch.manual_seed(0)
    layer = DepthwiseConv(6, stride=stride, dilation=dilation).double()
    x = torch.randn(3, 6, *shape, dtype=torch.double).requires_grad_()
    mine, torchs = layer(x), nn.Conv2d.forward(layer, x)
    torch.testing.assert_close(mine, torchs, rtol=1e-12, atol=1e-12)
    grad = torch.randn_like(mine)
    got = torch.autograd.grad(mine, (x, layer.weight), grad)
    want = torch.autograd.grad(torchs, (x, layer.weight), grad)
    for a, b in zip(got, want, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10)


def test_depthwise_accepts_odd_sizes_and_half_precision() -> None:
    layer = DepthwiseConv(6, stride=2)
    assert layer(torch.randn(1, 6, 7, 9)).shape == (1, 6, 4, 5)
    with torch.autocast("cpu", torch.bfloat16):
        out = layer(torch.randn(1, 6, 8, 10))
    assert out.dtype == torch.bfloat16
    out.float().sum().backward()
    assert layer.weight.grad is not None
    assert layer.weight.grad.dtype == torch.float32


@pytest.mark.parametrize("shape", [(7, 8), (8, 7), (7, 9), (8, 8), (1, 1)])
@pytest.mark.parametrize(("stride", "dilation"), [(2, 1), (1, 3), (1, 5), (2, 2)])
@pytest.mark.parametrize("training", [True, False])
@pytest.mark.heavy
def test_depthwise_outputs_equal_torch_for_any_size(
    shape: tuple[int, int], stride: int, dilation: int, training: bool
) -> None:
    torch.manual_seed(1)
    layer = DepthwiseConv(2, stride=stride, dilation=dilation).double().train(training)
    x = torch.randn(2, 2, *shape, dtype=torch.double).requires_grad_()
    mine, torchs = layer(x), nn.Conv2d.forward(layer, x)
    torch.testing.assert_close(mine, torchs)
    grad = torch.randn_like(mine)
    got = torch.autograd.grad(mine, (x, layer.weight), grad)
    want = torch.autograd.grad(torchs, (x, layer.weight), grad)
    for a, b in zip(got, want, strict=True):
        torch.testing.assert_close(a, b)
