"""The consistency loss, which compares two images of one robot or of two robots."""

from pathlib import Path

import numpy as np
import pytest
import torch

from dmrl.geometry.frames import AIDECK_PINHOLE, camera_from_horizontal
from dmrl.learn.data.batches import Batch
from dmrl.learn.networks.architectures import build_network
from dmrl.learn.training.config import TrainConfig
from dmrl.learn.training.consistency import LENS, UnlabelledImages, compare
from dmrl.learn.training.train_step import LOSS_NAMES, compute_losses

LENS_PX = AIDECK_PINHOLE.image_from_optical[[0, 1, 0, 1], [0, 1, 2, 2]]
CELL_PX = 8


def build_pose(
    time_s: float, xyz: tuple[float, float, float], *angles: float, camera: int = 0
) -> np.ndarray:
    """Return a pose row of a camera: time, position, yaw, roll, pitch, lens and camera number."""
    return np.array([time_s, *xyz, *angles, *LENS_PX, camera], np.float32)


def project_to_cell(world: np.ndarray, pose: np.ndarray) -> tuple[float, float, float]:
    """Return column and row in cells from the image's corner, and depth, of a world point."""
    yaw, roll, pitch = pose[4:7]
    c, s = np.cos(yaw), np.sin(yaw)
    level = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ (world - pose[1:4])
    x, y, z = camera_from_horizontal(float(roll), float(pitch)) @ level
    fx, fy, cx, cy = LENS_PX
    return (cx - fx * y / x) / CELL_PX, (cy - fy * z / x) / CELL_PX, x


def draw_maps(places: list[np.ndarray], poses: list[np.ndarray], confidence: float = 0.8) -> list:
    """Return maps of a pair of images that show a peer, each at its own position.

    They are confidence (2, 28, 40), log depth (2, 28, 40), offset (2, 2, 28, 40) and poses (2, n),
    whose lenses are in cells.
    """
    sure, log_depth = torch.full((2, 28, 40), 0.001), torch.zeros(2, 28, 40)
    offset = torch.zeros(2, 2, 28, 40)
    for k, (place, pose) in enumerate(zip(places, poses, strict=True)):
        u, v, depth = project_to_cell(place, pose)
        sure[k, int(v), int(u)], log_depth[k, int(v), int(u)] = confidence, np.log(depth)
        offset[k, :, int(v), int(u)] = torch.tensor([u % 1 - 0.5, v % 1 - 0.5])
    lens = torch.from_numpy(np.stack(poses))
    lens[:, LENS] /= CELL_PX
    return [sure, log_depth, offset, lens]


def test_a_peak_supports_the_position_of_the_peer_in_the_other_image() -> None:
    peer = np.array([1.2, 0.1, 1.1])
    poses = [
        build_pose(0.0, (0.0, 0.0, 1.0), 0.1, 0.05, -0.04),
        build_pose(0.2, (0.2, -0.15, 1.05), 0.3, -0.06, 0.08),
    ]
    _, support, depth_m = compare(*draw_maps([peer, peer], poses))
    for k, pose in enumerate(poses):
        u, v, depth = project_to_cell(peer, pose)
        assert divmod(int(support[k].argmax()), 40) == (int(v), int(u))
        assert float(depth_m[k, int(v), int(u)]) == pytest.approx(depth, rel=1e-4)
    assert float(support.max()) > 0.5


def test_agreeing_images_raise_confidence_and_disagreeing_ones_do_not() -> None:
    peer, alarm = np.array([1.2, 0.1, 1.0]), np.array([1.0, -0.5, 1.0])
    poses = [build_pose(0.1 * k, (0.05 * k, 0.0, 1.0), 0.0, 0.0, 0.0) for k in range(2)]
    for places, grows in (([peer, peer], True), ([peer, alarm], False)):
        probability, _, _ = compare(*draw_maps(places, poses, confidence=0.5))
        assert bool((probability.amax(dim=(1, 2)) > 0.5).all()) is grows


def build_facing_pair() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return positions at which two robots see each other, and their poses.

    The robots are 1.5 m apart, one of them 0.2 m higher, and each has its own origin.
    """
    poses = [
        build_pose(0.1, (0.0, 0.0, 1.0), 0.0, 0.05, -0.04, camera=0),
        build_pose(0.1, (7.0, 2.0, 1.2), 2.0, -0.06, 0.08, camera=1),
    ]
    ahead = np.array([np.cos(2.0), np.sin(2.0), 0.0])
    return [np.array([1.5, 0.0, 1.2]), poses[1][1:4] + 1.5 * ahead + [0.0, 0.0, -0.2]], poses


def test_two_robots_that_see_each_other_support_each_other() -> None:
    places, poses = build_facing_pair()
    sure, log_depth, offset, lens = draw_maps(places, poses, confidence=0.5)
    log_depth[1] += np.log(1.1)  # The second robot overestimates the depth by a tenth.
    probability, support, _ = compare(sure, log_depth, offset, lens)
    for k, (place, pose) in enumerate(zip(places, poses, strict=True)):
        u, v, _ = project_to_cell(place, pose)
        assert float(probability[k, int(v), int(u)]) > 0.6
    assert not support.any()  # Pairs of two robots give no target for depth.


@pytest.mark.parametrize("change", ["farther", "higher"])
def test_a_robot_elsewhere_neither_supports_nor_refutes(change: str) -> None:
    places, poses = build_facing_pair()
    if change == "farther":
        places[1] = poses[1][1:4] + 2 * (places[1] - poses[1][1:4])
    else:
        places[1] = places[1] + [0.0, 0.0, 0.5]
    sure, *rest = draw_maps(places, poses, confidence=0.5)
    probability, _, _ = compare(sure, *rest)
    torch.testing.assert_close(probability, sure, atol=0.01, rtol=0.01)


def draw_numbers(images: int, cameras: int, offset_s: float, flights: list[int]) -> np.ndarray:
    """Draw pairs of images of some cameras; return the numbers (M, 2) of their images."""
    poses = [
        build_pose(0.1 * k + offset_s * c, (0.0, 0.0, 1.0), 0.0, 0.0, 0.0, camera=c)
        for c in range(cameras)
        for k in range(images)
    ]
    pixels = np.zeros((len(poses), 8, 8, 3), np.uint8)
    pixels[:, 0, 0, 0] = np.arange(len(poses))
    flight = np.repeat(flights, images)
    batch = UnlabelledImages((Path("a"),), pixels, np.stack(poses), flight).draw(6, (0, 1))
    assert batch.poses is not None and torch.isnan(batch.robots).all()
    return batch.images[:, 0, 0, 0].numpy().astype(int).reshape(6, 2)


@pytest.mark.parametrize(("offset_s", "flights"), [(0.05, [0, 0]), (0.0, [0, 1])])
def test_images_of_one_camera_that_are_close_in_time_are_paired(
    offset_s: float, flights: list[int]
) -> None:
    numbers = draw_numbers(20, 2, offset_s, flights)
    assert (numbers[:, 0] // 20 == numbers[:, 1] // 20).all()
    assert np.isin(np.diff(numbers)[:, 0], range(1, 5)).all()


@pytest.mark.parametrize(("images", "mutual"), [(20, 6), (4, 4)])
def test_images_of_two_robots_at_the_same_time_are_paired_first(images: int, mutual: int) -> None:
    numbers = draw_numbers(images, 2, 0.01, [0, 0])
    two = numbers[:, 0] // images != numbers[:, 1] // images
    assert len(numbers) >= 5 and two.sum() == mutual
    assert (numbers[two, 0] % images == numbers[two, 1] % images).all()


def test_images_without_labels_have_only_the_consistency_loss() -> None:
    network = build_network("locanet")
    poses = torch.from_numpy(np.stack([build_pose(0.1 * k, (0, 0, 1), 0, 0, 0) for k in range(2)]))
    rng = torch.Generator().manual_seed(1)
    pixels = torch.randint(0, 255, (2, 3, 224, 320), generator=rng, dtype=torch.uint8)
    batch = Batch(pixels, torch.full((2, 1, 11), torch.nan), poses)
    parts = compute_losses(network, batch, TrainConfig(consistency_weight=1.0))
    assert [n for n, part in zip(LOSS_NAMES, parts, strict=True) if part] == ["consistency_loss"]
    parts.sum().backward()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters() if p.grad is not None)
