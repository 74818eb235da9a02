"""Network architectures, selected by name.

To add one, write a subclass of `Network` and a row of ``ARCHITECTURES``, or a plug-in.

A network takes images as `normalize_images` returns them and returns (N, C, rows, cols). One
cell covers ``stride_px`` pixels both ways. ``channels`` names each of the C outputs. The first two
are the same for all architectures.

========== =======================================================================
channel    meaning
========== =======================================================================
log_depth  natural log of the depth, metres
confidence logit of the confidence that a robot's centre lies in the cell
offset_u   centre minus middle of the cell, to the right, in cells
offset_v   the same, downwards
log_spread natural log of the scale b of log depth's error, exp(-abs(error) / b)
class_0    logit that the robot is of class 0; class_1 and so on for the others
========== =======================================================================
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import nullcontext
from typing import ClassVar, cast

import torch
from torch import Tensor, nn

from dmrl import entry_points
from dmrl.errors import SettingError
from dmrl.learn.networks.depthwise import DepthwiseConv

INPUT_CHANNELS = 3
DETECTION_CHANNELS = ("log_depth", "confidence")
"""Channels of a network that locates a robot to the cell."""
SUB_CELL_CHANNELS = (*DETECTION_CHANNELS, "offset_u", "offset_v")
"""Channels of a network that also regresses the position within the cell."""
SPREAD_CHANNEL, CLASS_PREFIX = "log_spread", "class_"
"""Channels that a recipe may add to an architecture's own; class channels are numbered."""
CONFIDENCE_BIAS = -4.0
"""Initial bias of the confidence logit. One cell in 1120 contains a robot. From a bias of 0, the
loss starts near 190 and the first epochs only learn that most cells are empty."""


class Network(nn.Module, ABC):
    """Base class of all architectures, as training, prediction and export use it.

    ``stride_px`` is the side of a grid cell; images measure a whole number of cells. ``channels``
    are names of the table above, in output order: first the architecture's ``own`` channels,
    then the extra ones that the caller requested.
    """

    stride_px: ClassVar[int] = 8
    own: ClassVar[tuple[str, ...]] = DETECTION_CHANNELS

    def __init__(self, extra: Sequence[str] = ()) -> None:
        super().__init__()
        self.channels = (*self.own, *extra)

    @abstractmethod
    def forward(self, images: Tensor) -> Tensor:
        """Return (N, C, rows, cols) outputs, ordered as ``channels``, for (N, 3, H, W) images."""


class LocaNet(Network):
    """Network of the paper: 24,778 parameters, receptive field 38 px.

    It has four blocks of 3x3 convolution, batch normalisation and ReLU, and a final 1x1
    convolution. A 2x2 max-pool precedes each block but the first. Layers, padding and constants
    equal those of the published Keras weights, so these weights load into it.
    """

    widths: ClassVar[tuple[int, ...]] = (8, 16, 32, 64)

    def __init__(self, extra: Sequence[str] = ()) -> None:
        super().__init__(extra)
        ins = (INPUT_CHANNELS, *self.widths)
        self.convs = nn.ModuleList(
            nn.Conv2d(a, b, 3, padding=1, bias=False)
            for a, b in zip(ins, self.widths, strict=False)
        )
        # torch's momentum is the weight of the new batch: 0.01 equals Keras' 0.99.
        self.norms = nn.ModuleList(nn.BatchNorm2d(w, eps=1e-3, momentum=0.01) for w in self.widths)
        self.head = nn.Conv2d(self.widths[-1], len(self.channels), 1)
        self._init_weights()

    def _init_weights(self) -> None:
        for conv in (*self.convs, self.head):
            assert isinstance(conv, nn.Conv2d)
            nn.init.normal_(conv.weight, std=0.01)  # as in the published code
        _init_head(self.head, self.channels)

    def forward(self, images: Tensor) -> Tensor:
        """Return (N, C, H/8, W/8) outputs, ordered as ``channels``, for (N, 3, H, W) images."""
        x = images
        for index, (conv, norm) in enumerate(zip(self.convs, self.norms, strict=True)):
            if index:
                x = torch.max_pool2d(x, 2)
            x = torch.relu(norm(conv(x)))
        out: Tensor = self.head(x)
        return out


def _init_head(head: nn.Conv2d, channels: Sequence[str]) -> None:
    """Set the biases of a head so that it initially predicts nearly every cell to be empty."""
    assert head.bias is not None
    with torch.no_grad():
        head.bias.zero_()
        head.bias[channels.index("confidence")] = CONFIDENCE_BIAS


class ConvNorm(nn.Sequential):
    """Convolution without bias, batch normalisation, and an optional ReLU.

    The three fold into one convolution, which int8 inference requires.
    """

    def __init__(
        self,
        ins: int,
        outs: int,
        kernel: int = 3,
        *,
        stride: int = 1,
        dilation: int = 1,
        depthwise: bool = False,
        relu: bool = True,
    ) -> None:
        if depthwise:
            conv: nn.Conv2d = DepthwiseConv(ins, stride=stride, dilation=dilation)
        else:
            conv = nn.Conv2d(ins, outs, kernel, stride, kernel // 2, bias=False)
        fan_out = kernel**2 * (1 if depthwise else outs)
        nn.init.normal_(conv.weight, std=(2 / fan_out) ** 0.5)  # He et al. 2015
        last = (nn.ReLU(inplace=True),) if relu else ()
        super().__init__(conv, nn.BatchNorm2d(outs), *last)


class ResidualBlock(nn.Module):
    """Residual block: a dilated depthwise 3x3 and a 1x1 convolution beside a shortcut.

    The ReLU follows the sum.
    """

    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.depthwise = ConvNorm(width, width, dilation=dilation, depthwise=True)
        self.pointwise = ConvNorm(width, width, 1, relu=False)

    def forward(self, x: Tensor) -> Tensor:
        """Return (N, width, rows, cols) for an input of the same shape."""
        return torch.relu_(x + self.pointwise(self.depthwise(x)))


class DmrlNano(Network):
    """Default small network of dmrl: 24,836 parameters, 57.7 million MACs, receptive field 287 px.

    Two dense strided 3x3 convolutions lead to stride 4, where a robot 2 m away still covers a few
    cells. Two residual blocks and a separable step to stride 8 follow. There, five residual blocks
    increase the dilation until the receptive field covers a near robot. A 1x1 convolution gives
    the four channels.
    """

    own: ClassVar[tuple[str, ...]] = SUB_CELL_CHANNELS
    widths: ClassVar[tuple[int, int, int]] = (16, 32, 48)
    dilations: ClassVar[tuple[tuple[int, ...], tuple[int, ...]]] = ((1, 1), (1, 2, 4, 8, 1))

    def __init__(self, extra: Sequence[str] = ()) -> None:
        super().__init__(extra)
        stem, fine, coarse = self.widths
        self.body = nn.Sequential(
            ConvNorm(INPUT_CHANNELS, stem, stride=2),
            ConvNorm(stem, fine, stride=2),
            *(ResidualBlock(fine, dilation) for dilation in self.dilations[0]),
            ConvNorm(fine, fine, stride=2, depthwise=True),
            ConvNorm(fine, coarse, 1),
            *(ResidualBlock(coarse, dilation) for dilation in self.dilations[1]),
        )
        self.head = nn.Conv2d(coarse, len(self.channels), 1)
        nn.init.normal_(self.head.weight, std=0.01)
        _init_head(self.head, self.channels)

    def forward(self, images: Tensor) -> Tensor:
        """Return (N, C, H/8, W/8) outputs, ordered as ``channels``, for (N, 3, H, W) images."""
        features = self.body(images)
        with torch.autocast(features.device.type, enabled=False):
            out: Tensor = self.head(features.float())
        return out


class DmrlNanoFine(DmrlNano):
    """Variant of dmrl-nano with more layers at stride 4, for distant robots.

    It has 24,740 parameters, 75.1 million MACs and a receptive field of 311 px. The budget is
    25,000 parameters and 80 million MACs.
    """

    dilations: ClassVar[tuple[tuple[int, ...], tuple[int, ...]]] = ((1, 2, 1, 2, 1, 2), (2, 4, 8))


class DmrlLarge(DmrlNano):
    """Wider variant of dmrl-nano: a teacher, too large for a microcontroller."""

    widths: ClassVar[tuple[int, int, int]] = (24, 64, 96)


ARCHITECTURES: dict[str, type[Network]] = {
    "dmrl-nano": DmrlNano,
    "dmrl-nano-fine": DmrlNanoFine,
    "dmrl-large": DmrlLarge,
    "locanet": LocaNet,
}


def list_architectures() -> list[str]:
    """Return the names of all architectures, built in and from plug-ins, sorted."""
    return sorted({*ARCHITECTURES, *entry_points.find_plugins(entry_points.NETWORKS)})


def find_architecture(name: str) -> type[Network]:
    """Return the class of an architecture.

    Raises
    ------
    SettingError
        If there is no architecture of this name.
    PluginError
        If it belongs to a plug-in that cannot be loaded.
    """
    if name in ARCHITECTURES:
        return ARCHITECTURES[name]
    plugin = entry_points.find_plugins(entry_points.NETWORKS).get(name)
    if plugin is None:
        raise SettingError(
            f"no architecture {name}. Choose one of: {', '.join(list_architectures())}"
        )
    loaded = plugin.load()
    fits = isinstance(loaded, type) and issubclass(loaded, Network)
    plugin.require(fits, "a subclass of dmrl.plugins.Network")
    return cast(type[Network], loaded)


def build_network(name: str, *, seed: int = 0, extra: Sequence[str] = ()) -> Network:
    """Build a network with random weights, in channels-last memory format.

    Parameters
    ----------
    name
        Architecture, one of `list_architectures`.
    seed
        Seed of the initial weights.
    extra
        Channels in addition to the architecture's own.

    Raises
    ------
    SettingError
        If there is no architecture of this name.
    PluginError
        If it belongs to a plug-in that cannot be loaded.
    """
    form = find_architecture(name)
    plugin = entry_points.find_plugins(entry_points.NETWORKS).get(name)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        with plugin.naming_the_package("cannot be built") if plugin else nullcontext():
            network = form(extra)
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload,no-any-return]


def unbind_channels(channels: Sequence[str], output: Tensor) -> dict[str, Tensor]:
    """Split an output (N, C, rows, cols) into one (N, rows, cols) tensor per channel name."""
    return dict(zip(channels, output.unbind(1), strict=True))


def normalize_images(images: Tensor) -> Tensor:
    """Normalize uint8 images to network input, x / 128 - 1, float32; the memory format is kept.

    Parameters
    ----------
    images
        (N, 3, H, W) uint8, RGB.
    """
    return images.to(torch.float32).mul_(1 / 128).sub_(1)


def count_macs(network: Network, height_px: int = 224, width_px: int = 320) -> int:
    """Count the multiply-accumulates of all convolutions for one image."""
    total = 0

    def count(layer: nn.Module, _: object, out: Tensor) -> None:
        nonlocal total
        assert isinstance(layer, nn.Conv2d)
        total += out.shape[2] * out.shape[3] * layer.weight.numel()

    hooks = [m.register_forward_hook(count) for m in network.modules() if isinstance(m, nn.Conv2d)]
    training = network.training
    with torch.inference_mode():
        image = next(network.parameters()).new_zeros(1, INPUT_CHANNELS, height_px, width_px)
        network.eval()(image)
    network.train(training)
    for hook in hooks:
        hook.remove()
    return total


def count_parameters(network: Network) -> int:
    """Count the trainable parameters."""
    return sum(p.numel() for p in network.parameters())
