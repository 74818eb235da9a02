"""Depthwise 3x3 convolution with a fast backward pass on the CPU.

oneDNN has fast kernels for every forward pass but not for every backward pass. At dilation 4, the
gradients of a 48-channel layer take 20 times as long as the layer itself, in bfloat16 70 times.
Fast kernels can compute both gradients:

* input gradient: the forward pass over the output gradient with the kernel rotated by 180 degrees
  (for a stride over 1, the output gradient is first spaced out with zeros);
* kernel gradient: a kernel of dilation d combines pixels that are d apart. Each of the d x d
  grids of such pixels is treated as an image, on which the kernel is not dilated.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, pad


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
        if not self.training or x.device.type != "cpu" or odd:
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
        return conv2d(x, weight, None, stride, dilation, dilation, len(weight))

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None, None]:
        x, weight = ctx.saved_tensors
        stride, dilation = ctx.stride, ctx.dilation
        grad = grad.contiguous(memory_format=torch.channels_last)
        spread = grad
        if stride > 1:
            spread = torch.zeros_like(x, memory_format=torch.channels_last)
            spread[:, :, ::stride, ::stride] = grad
        of_x = conv2d(spread, weight.flip(2, 3), None, 1, dilation, dilation, len(weight))
        if dilation > 1 and stride == 1:
            x, grad, dilation = _space_to_batch(x, dilation), _space_to_batch(grad, dilation), 1
        of_weight = torch.ops.aten.convolution_backward(
            *(grad, x, weight, [0], [stride, stride], [dilation, dilation], [dilation, dilation]),
            *(False, [0, 0], len(weight), [False, True, False]),
        )[1]
        return of_x, of_weight, None, None


def _space_to_batch(x: Tensor, apart: int) -> Tensor:
    """Split images into (N * apart^2, C, rows, cols) grids of pixels ``apart`` from each other.

    Zeros pad the end of each grid.
    """
    images, channels, height, width = x.shape
    rows, cols = -(-height // apart), -(-width // apart)
    x = pad(x, (0, cols * apart - width, 0, rows * apart - height)).permute(0, 2, 3, 1)
    x = x.reshape(images, rows, apart, cols, apart, channels).permute(0, 2, 4, 1, 3, 5)
    return x.reshape(images * apart**2, rows, cols, channels).permute(0, 3, 1, 2)
