"""Depthwise 3x3 convolution with fast forward and backward passes on the CPU.

oneDNN has fast kernels for every forward pass up to dilation 4, but not for every backward pass. At
dilation 4, the gradients of a 48-channel layer take 20 times as long as the layer itself, in
bfloat16 70 times. At dilation 8 the layer takes ten times as long, too. Fast kernels can compute
all of them:

* a kernel of dilation d combines pixels that are d apart. Each of the d x d grids of such pixels is
  treated as an image, on which the kernel is not dilated;
* input gradient: the forward pass over the output gradient with the kernel rotated by 180 degrees
  (for a stride over 1, the output gradient is first spaced out with zeros).
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, pad

FAST_DILATION = 4
"""Largest dilation of oneDNN's fast forward pass."""


class DepthwiseConv(nn.Conv2d):
    """Depthwise 3x3 convolution without bias that keeps the size or divides it by the stride."""

    def __init__(self, channels: int, *, stride: int = 1, dilation: int = 1) -> None:
        super().__init__(
            channels, channels, 3, stride, dilation, dilation, groups=channels, bias=False
        )

    def forward(self, x: Tensor) -> Tensor:
        """Return (N, C, H / stride, W / stride) for an input (N, C, H, W)."""
        stride, dilation = self.stride[0], self.dilation[0]
        odd = x.shape[2] % stride or x.shape[3] % stride
        slow = self.training or dilation > FAST_DILATION
        if not slow or x.device.type != "cpu" or odd:
            return super().forward(x)
        weight = self.weight
        if torch.is_autocast_enabled("cpu"):
            x, weight = (t.to(torch.get_autocast_dtype("cpu")) for t in (x, weight))
        out: Tensor = _DepthwiseFunction.apply(x, weight, stride, dilation)  # type: ignore[no-untyped-call]
        return out


class _DepthwiseFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, stride: int, dilation: int) -> Tensor:
        ctx.save_for_backward(x, weight)
        ctx.stride, ctx.dilation = stride, dilation
        return _convolve(x, weight, stride, dilation)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None, None]:
        x, weight = ctx.saved_tensors
        stride, dilation = ctx.stride, ctx.dilation
        grad = grad.contiguous(memory_format=torch.channels_last)
        spread = grad
        if stride > 1:
            spread = torch.zeros_like(x, memory_format=torch.channels_last)
            spread[:, :, ::stride, ::stride] = grad
        of_x = _convolve(spread, weight.flip(2, 3), 1, dilation)
        if dilation > 1 and stride == 1:
            x, grad, dilation = _split_into_grids(x, dilation), _split_into_grids(grad, dilation), 1
        of_weight = torch.ops.aten.convolution_backward(
            *(grad, x, weight, [0], [stride, stride], [dilation, dilation], [dilation, dilation]),
            *(False, [0, 0], len(weight), [False, True, False]),
        )[1]
        return of_x, of_weight, None, None


def _convolve(x: Tensor, weight: Tensor, stride: int, dilation: int) -> Tensor:
    if stride > 1 or dilation <= FAST_DILATION:
        return conv2d(x, weight, None, stride, dilation, dilation, len(weight))
    out = conv2d(_split_into_grids(x, dilation), weight, None, 1, 1, 1, len(weight))
    return _join_grids(out, dilation, x.shape)


def _split_into_grids(x: Tensor, apart: int) -> Tensor:
    """Split images into (N * apart^2, C, rows, cols) grids of pixels ``apart`` from each other.

    Zeros pad the end of each grid.
    """
    images, channels, height, width = x.shape
    rows, cols = -(-height // apart), -(-width // apart)
    x = pad(x, (0, cols * apart - width, 0, rows * apart - height)).permute(0, 2, 3, 1)
    x = x.reshape(images, rows, apart, cols, apart, channels).permute(0, 2, 4, 1, 3, 5)
    return x.reshape(images * apart**2, rows, cols, channels).permute(0, 3, 1, 2)


def _join_grids(x: Tensor, apart: int, shape: torch.Size) -> Tensor:
    """Join grids to (N, C, H, W) images of a shape, as `_split_into_grids` split them."""
    images, channels, height, width = shape
    rows, cols = x.shape[2:]
    x = x.permute(0, 2, 3, 1).reshape(images, apart, apart, rows, cols, channels)
    x = x.permute(0, 3, 1, 4, 2, 5).reshape(images, rows * apart, cols * apart, channels)
    return x[:, :height, :width].contiguous().permute(0, 3, 1, 2)
