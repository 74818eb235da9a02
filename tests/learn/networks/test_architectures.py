"""Architectures of networks: their sizes, layers and initial weights."""

import math

import pytest
import torch

from dmrl.errors import SettingError
from dmrl.learn.networks import architectures
from dmrl.learn.networks.architectures import (
    ARCHITECTURES,
    LocaNet,
    ResidualBlock,
    build_network,
    count_macs,
    count_parameters,
    normalize_images,
)


def test_locanet_has_the_published_number_of_parameters() -> None:
    assert count_parameters(build_network("locanet")) == 24_778


@pytest.mark.heavy
def test_small_networks_have_documented_parameters_and_operations() -> None:
    assert count_parameters(build_network("dmrl-nano")) == 24_836
    assert count_macs(build_network("dmrl-nano")) == 57_720_320
    assert count_parameters(build_network("dmrl-nano-fine")) == 24_740
    assert count_macs(build_network("dmrl-nano-fine")) == 75_102_720
    assert count_macs(build_network("locanet")) == 77_557_760


@pytest.mark.parametrize(("name", "wide_px"), [("dmrl-nano", 287), ("dmrl-nano-fine", 311)])
@pytest.mark.heavy
def test_receptive_field_has_its_documented_width(name: str, wide_px: int) -> None:
    network = build_network(name).eval()
    for layer in network.modules():
        if isinstance(layer, torch.nn.Conv2d):
            layer.weight.data.abs_()
    image = torch.ones(1, 3, 320, 640, requires_grad=True)
    network(image)[0, 0, 20, 40].backward()  # type: ignore[no-untyped-call]
    assert image.grad is not None
    seen = image.grad.abs().sum(dim=(0, 1, 2)).nonzero()
    assert int(seen.max() - seen.min()) + 1 == wide_px


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_networks_use_only_layers_that_int8_export_supports(name: str) -> None:
    kinds = (torch.nn.Conv2d, torch.nn.BatchNorm2d, torch.nn.ReLU)
    leaves = [m for m in build_network(name).modules() if not list(m.children())]
    assert all(isinstance(leaf, kinds) for leaf in leaves)
    assert {m.kernel_size for m in leaves if isinstance(m, kinds[0])} == {(1, 1), (3, 3)}


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_every_network_has_a_cell_for_each_stride(name: str) -> None:
    network = build_network(name).eval()
    rows, cols = 224 // network.stride_px, 320 // network.stride_px
    with torch.no_grad():
        out = network(torch.zeros(2, 3, 224, 320))
    assert out.shape == (2, len(network.channels), rows, cols)
    assert network.channels[:2] == ("log_depth", "confidence")
    assert all(f"\n{channel} " in architectures.__doc__ for channel in network.channels)


def test_seed_sets_weights_without_changing_the_torch_generator() -> None:
    torch.manual_seed(7)
    wanted = torch.rand(1)
    torch.manual_seed(7)
    first, again, other = (
        build_network("locanet", seed=1),
        build_network("locanet", seed=1),
        build_network("locanet", seed=2),
    )
    assert torch.equal(torch.rand(1), wanted)
    assert torch.equal(first.convs[0].weight, again.convs[0].weight)  # type: ignore[union-attr, index, arg-type]
    assert not torch.equal(first.convs[0].weight, other.convs[0].weight)  # type: ignore[union-attr, index, arg-type]


def test_initial_network_has_low_confidence() -> None:
    network = build_network("locanet").eval()
    with torch.no_grad():
        logit = network(normalize_images(torch.randint(0, 256, (1, 3, 64, 64), dtype=torch.uint8)))[
            :, 1
        ]
    assert logit.sigmoid().max() < 0.05


def test_input_is_scaled_to_about_one_and_stays_channels_last() -> None:
    images = torch.tensor([0, 128, 255], dtype=torch.uint8).reshape(1, 1, 1, 3).permute(0, 3, 1, 2)
    assert normalize_images(images).flatten().tolist() == [-1.0, 0.0, 127 / 128]
    many = torch.zeros(2, 8, 8, 3, dtype=torch.uint8).permute(0, 3, 1, 2)
    assert normalize_images(many).is_contiguous(memory_format=torch.channels_last)


def test_unknown_architecture_error_lists_known_ones() -> None:
    with pytest.raises(
        SettingError, match=r"no architecture resnet\. Choose one of: dmrl-large, dmrl-nano, "
    ):
        build_network("resnet")


@pytest.mark.parametrize("name", [name for name in ARCHITECTURES if name != "locanet"])
def test_initial_kernels_keep_the_variance_of_gradients(name: str) -> None:
    *convs, head = (m for m in build_network(name).modules() if isinstance(m, torch.nn.Conv2d))
    for conv in convs:
        outs = conv.out_channels // conv.groups
        wanted = (2 / (conv.kernel_size[0] * conv.kernel_size[1] * outs)) ** 0.5
        spread = float(conv.weight.detach().std())
        assert spread == pytest.approx(wanted, rel=4 / conv.weight.numel() ** 0.5)
        assert conv.bias is None
    assert float(head.weight.detach().std()) == pytest.approx(0.01, rel=0.2)
    assert head.bias is not None
    empty = head.bias.tolist()
    assert 1 / (1 + math.exp(-empty.pop(1))) < 0.05 and not any(empty)


def test_locanet_layers_equal_the_publication() -> None:
    network = build_network("locanet", seed=4).eval()
    assert isinstance(network, LocaNet)
    images = torch.randn(1, 3, 32, 40)
    x = images
    for k, (conv, norm) in enumerate(zip(network.convs, network.norms, strict=True)):
        assert isinstance(conv, torch.nn.Conv2d) and isinstance(norm, torch.nn.BatchNorm2d)
        assert float(conv.weight.detach().std()) == pytest.approx(0.01, rel=0.2)
        assert (norm.eps, norm.momentum) == (1e-3, 0.01)
        torch.nn.init.uniform_(norm.running_mean, -1, 1)  # type: ignore[arg-type]
        x = torch.nn.functional.max_pool2d(x, 2) if k else x
        x = torch.nn.functional.conv2d(x, conv.weight, padding=1)
        mean, var = norm.running_mean, norm.running_var
        x = torch.nn.functional.batch_norm(x, mean, var, norm.weight, norm.bias, eps=1e-3)
        x = x.clamp(min=0)
    wanted = torch.nn.functional.conv2d(x, network.head.weight, network.head.bias)
    torch.testing.assert_close(network(images), wanted)
    assert [conv.out_channels for conv in network.convs] == [8, 16, 32, 64]  # type: ignore[union-attr]


def test_residual_block_adds_its_input() -> None:
    block = ResidualBlock(4, 2).eval()
    x = torch.randn(1, 4, 9, 11)
    wanted = (x + block.pointwise(block.depthwise(x))).clamp(min=0)
    torch.testing.assert_close(block(x), wanted)
    assert (block.pointwise(x) < 0).any() and not (block.depthwise(x) < 0).any()
    assert block.depthwise[0].dilation == (2, 2)
