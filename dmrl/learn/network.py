"""The networks, by name. A new one is a class here, or in a file beside, and a row below.

Every network takes images as ``to_input`` gives them and returns (N, 2, rows, cols), one cell
per ``stride_px`` pixels both ways: channel 0 is log depth (metres), channel 1 the logit of the
confidence that a robot's centre lies in the cell.
"""

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from torch import Tensor, nn

from dmrl.errors import SettingError

CHANNELS = 3
# One cell in 1120 holds a robot. With a zero-mean head the loss starts near 190 and the first
# epochs go into learning that most cells are empty.
CONFIDENCE_BIAS = -4.0


class Network(nn.Module, ABC):
    """What training, prediction and export ask of a network.

    ``stride_px`` is the side of a grid cell; images are a whole number of cells.
    """

    stride_px: ClassVar[int] = 8

    @abstractmethod
    def forward(self, images: Tensor) -> Tensor:
        """(N, 2, rows, cols) log depth and confidence logit of (N, 3, H, W) images."""


class LocaNet(Network):
    """The network of the paper: 24,778 parameters, receptive field 38 px.

    Four blocks of 3x3 convolution, batch normalisation and ReLU, a 2x2 max-pool before all
    but the first, then a 1x1 convolution. Layers, paddings and constants are those of the
    published Keras weights, so these load into it.
    """

    widths: ClassVar[tuple[int, ...]] = (8, 16, 32, 64)

    def __init__(self) -> None:
        super().__init__()
        ins = (CHANNELS, *self.widths)
        self.convs = nn.ModuleList(
            nn.Conv2d(a, b, 3, padding=1, bias=False)
            for a, b in zip(ins, self.widths, strict=False)
        )
        # torch's momentum is the share of the new batch: 0.01 is Keras' 0.99.
        self.norms = nn.ModuleList(nn.BatchNorm2d(w, eps=1e-3, momentum=0.01) for w in self.widths)
        self.head = nn.Conv2d(self.widths[-1], 2, 1)
        self._initialise()

    def _initialise(self) -> None:
        for conv in (*self.convs, self.head):
            assert isinstance(conv, nn.Conv2d)
            nn.init.normal_(conv.weight, std=0.01)  # as published
        assert self.head.bias is not None
        with torch.no_grad():
            self.head.bias.copy_(torch.tensor([0.0, CONFIDENCE_BIAS]))

    def forward(self, images: Tensor) -> Tensor:
        """(N, 2, H/8, W/8) log depth and confidence logit of (N, 3, H, W) images."""
        x = images
        for index, (conv, norm) in enumerate(zip(self.convs, self.norms, strict=True)):
            if index:
                x = torch.max_pool2d(x, 2)
            x = torch.relu(norm(conv(x)))
        out: Tensor = self.head(x)
        return out


ARCHITECTURES: dict[str, type[Network]] = {"locanet": LocaNet}


def build(name: str, *, seed: int = 0) -> Network:
    """A new network, its weights drawn with ``seed``, channels last in memory.

    Raises
    ------
    SettingError
        If there is no architecture of this name.
    """
    if name not in ARCHITECTURES:
        known = ", ".join(sorted(ARCHITECTURES))
        raise SettingError(f"no architecture {name}. Choose one of: {known}")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = ARCHITECTURES[name]()
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload,no-any-return]


def to_input(images: Tensor) -> Tensor:
    """Network input, x / 128 - 1, of uint8 images; float32, memory order unchanged.

    Parameters
    ----------
    images
        (N, 3, H, W) uint8, RGB.
    """
    return images.to(torch.float32).mul_(1 / 128).sub_(1)


def parameter_count(network: Network) -> int:
    """Number of trained parameters."""
    return sum(p.numel() for p in network.parameters())
