"""Images without robots, sampled by the confidence of the network."""

import numpy as np
import pytest
import torch

from dmrl.learn.data.batches import ROBOT_FIELDS, ExampleSet
from dmrl.learn.networks.architectures import DETECTION_CHANNELS, Network
from dmrl.learn.training.hard_negatives import (
    compute_peak_confidences,
    find_empty_images,
    mine_hard_negatives,
)


class Bright(Network):
    """A network whose confidence is the brightness of the image."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = torch.nn.Parameter(torch.tensor(1.0))

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        light = torch.nn.functional.avg_pool2d(images.mean(dim=1, keepdim=True), 8)
        return torch.cat([light, self.scale * light], dim=1)


def build_examples() -> ExampleSet:
    """Return two images with a robot, then three without: dark, grey and bright."""
    pixels = np.zeros((5, 16, 24, 3), np.uint8)
    pixels[3], pixels[4] = 128, 255
    robots = np.full((5, 1, len(ROBOT_FIELDS)), np.nan, np.float32)
    robots[:2, 0, :6] = (12, 8, 1, 0, 0, 0)
    return ExampleSet([pixels], robots)


def test_confident_negatives_are_sampled_more_often() -> None:
    network = Bright().train()
    assert network.channels == DETECTION_CHANNELS
    believed = compute_peak_confidences(network, build_examples(), np.arange(5))
    assert (np.diff(believed[2:]) > 0).all()
    shares = mine_hard_negatives(network, build_examples(), None, 0.4)
    assert shares is not None
    assert network.training
    assert shares.mean() == pytest.approx(1)
    assert shares[2:].sum() / shares.sum() == pytest.approx(0.4)
    np.testing.assert_allclose(shares[2:] / shares[4], (believed[2:] / believed[4]) ** 2)
    assert shares[0] == shares[1]


def test_images_with_a_robot_keep_their_proportions() -> None:
    shares = mine_hard_negatives(
        Bright(), build_examples(), np.array([1.0, 3.0, 1.0, 0.5, 0.5]), 0.2
    )
    assert shares is not None
    assert shares[1] == pytest.approx(3 * shares[0])
    assert shares[:2].sum() / shares.sum() == pytest.approx(0.8)


def test_an_image_of_zero_share_is_not_mined() -> None:
    shares = mine_hard_negatives(
        Bright(), build_examples(), np.array([1.0, 1.0, 1.0, 1.0, 0.0]), 0.4
    )
    assert shares is not None
    assert shares[4] == 0
    assert shares[2:].sum() / shares.sum() == pytest.approx(0.4)


def test_without_empty_images_nothing_is_mined() -> None:
    full = build_examples().select(np.array([True, True, False, False, False]))
    assert find_empty_images(full).tolist() == [False, False]
    assert mine_hard_negatives(Bright(), full, None, 0.4) is None
