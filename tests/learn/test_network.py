import pytest
import torch

from dmrl.errors import SettingError
from dmrl.learn.network import ARCHITECTURES, build, parameter_count, to_input


def test_locanet_has_the_published_number_of_parameters() -> None:
    assert parameter_count(build("locanet")) == 24_778


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_every_network_gives_one_cell_per_stride(name: str) -> None:
    network = build(name).eval()
    rows, cols = 224 // network.stride_px, 320 // network.stride_px
    with torch.no_grad():
        assert network(torch.zeros(2, 3, 224, 320)).shape == (2, 2, rows, cols)


def test_the_seed_decides_the_weights_and_leaves_torch_as_it_was() -> None:
    torch.manual_seed(7)
    wanted = torch.rand(1)
    torch.manual_seed(7)
    first, again, other = (
        build("locanet", seed=1),
        build("locanet", seed=1),
        build("locanet", seed=2),
    )
    assert torch.equal(torch.rand(1), wanted)
    assert torch.equal(first.convs[0].weight, again.convs[0].weight)  # type: ignore[union-attr, index, arg-type]
    assert not torch.equal(first.convs[0].weight, other.convs[0].weight)  # type: ignore[union-attr, index, arg-type]


def test_a_new_network_believes_in_nothing_yet() -> None:
    network = build("locanet").eval()
    with torch.no_grad():
        logit = network(to_input(torch.randint(0, 256, (1, 3, 64, 64), dtype=torch.uint8)))[:, 1]
    assert logit.sigmoid().max() < 0.05


def test_input_is_scaled_to_about_one_and_stays_channels_last() -> None:
    images = torch.tensor([0, 128, 255], dtype=torch.uint8).reshape(1, 1, 1, 3).permute(0, 3, 1, 2)
    assert to_input(images).flatten().tolist() == [-1.0, 0.0, 127 / 128]
    many = torch.zeros(2, 8, 8, 3, dtype=torch.uint8).permute(0, 3, 1, 2)
    assert to_input(many).is_contiguous(memory_format=torch.channels_last)


def test_an_unknown_architecture_is_answered_with_the_known_ones() -> None:
    with pytest.raises(SettingError, match=r"no architecture resnet\. Choose one of: locanet"):
        build("resnet")
