"""The consistency loss: peaks are carried over by odometry, and what agrees is believed."""

from pathlib import Path

import numpy as np
import pytest
import torch

from dmrl.geometry.frames import AIDECK_PINHOLE, camera_from_horizontal
from dmrl.learn.data.batches import Batch
from dmrl.learn.networks.architectures import build_network
from dmrl.learn.training.config import TrainConfig
from dmrl.learn.training.consistency import LENS, UnlabelledImages, carry_over, fuse
from dmrl.learn.training.train_step import LOSS_NAMES, compute_losses

LENS_PX = AIDECK_PINHOLE.image_from_optical[[0, 1, 0, 1], [0, 1, 2, 2]]
CELL_PX = 8


def pose_of(time_s: float, xyz: tuple[float, float, float], *angles: float) -> np.ndarray:
    return np.array([time_s, *xyz, *angles, *LENS_PX], np.float32)


def cell_of(world: np.ndarray, pose: np.ndarray) -> tuple[float, float, float]:
    """Column, row (cells, from the corner) and depth of a point in a camera."""
    yaw, roll, pitch = pose[4:7]
    c, s = np.cos(yaw), np.sin(yaw)
    level = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ (world - pose[1:4])
    x, y, z = camera_from_horizontal(float(roll), float(pitch)) @ level
    fx, fy, cx, cy = LENS_PX
    return (cx - fx * y / x) / CELL_PX, (cy - fy * z / x) / CELL_PX, x


def see(places: list[np.ndarray], poses: list[np.ndarray], confidence: float = 0.8) -> list:
    """Maps of a pair of images that show a peer, each at its place."""
    sure, log_depth = torch.full((2, 28, 40), 0.001), torch.zeros(2, 28, 40)
    offset = torch.zeros(2, 2, 28, 40)
    for k, (place, pose) in enumerate(zip(places, poses, strict=True)):
        u, v, depth = cell_of(place, pose)
        sure[k, int(v), int(u)], log_depth[k, int(v), int(u)] = confidence, np.log(depth)
        offset[k, :, int(v), int(u)] = torch.tensor([u % 1 - 0.5, v % 1 - 0.5])
    lens = torch.from_numpy(np.stack(poses))
    lens[:, LENS] /= CELL_PX
    return [sure, log_depth, offset, lens]


def test_a_peak_is_carried_to_where_the_peer_is_in_the_other_image() -> None:
    peer = np.array([1.2, 0.1, 1.1])
    poses = [
        pose_of(0.0, (0.0, 0.0, 1.0), 0.1, 0.05, -0.04),
        pose_of(0.2, (0.2, -0.15, 1.05), 0.3, -0.06, 0.08),
    ]
    support, depth_m = carry_over(*see([peer, peer], poses))
    for k, pose in enumerate(poses):
        u, v, depth = cell_of(peer, pose)
        assert divmod(int(support[k].argmax()), 40) == (int(v), int(u))
        assert float(depth_m[k, int(v), int(u)]) == pytest.approx(depth, rel=1e-4)
    assert float(support.max()) > 0.5


def test_what_two_images_agree_on_is_believed_and_a_single_alarm_is_not() -> None:
    peer, alarm = np.array([1.2, 0.1, 1.0]), np.array([1.0, -0.5, 1.0])
    poses = [pose_of(0.1 * k, (0.05 * k, 0.0, 1.0), 0.0, 0.0, 0.0) for k in range(2)]
    for places, grows in (([peer, peer], True), ([peer, alarm], False)):
        sure, *rest = see(places, poses, confidence=0.5)
        fused = fuse(sure, carry_over(sure, *rest)[0])
        assert bool((fused.amax(dim=(1, 2)) > 0.5).all()) is grows


def test_only_images_of_one_camera_that_are_close_in_time_are_paired() -> None:
    time_s = np.tile(np.arange(20) * 0.1, 2)
    poses = np.stack([pose_of(t, (0.0, 0.0, 1.0), 0.0, 0.0, 0.0) for t in time_s])
    pixels = np.zeros((40, 8, 8, 3), np.uint8)
    pixels[:, 0, 0, 0] = np.arange(40)
    images = UnlabelledImages((Path("a"),), pixels, poses, np.repeat([0, 1], 20))
    batch = images.draw(6, (0, 1))
    numbers = batch.images[:, 0, 0, 0].numpy().astype(int).reshape(6, 2)
    assert (numbers[:, 0] // 20 == numbers[:, 1] // 20).all()
    assert np.isin(np.diff(numbers)[:, 0], range(1, 5)).all()
    assert batch.poses is not None and torch.isnan(batch.robots).all()


def test_images_without_labels_count_for_no_other_loss() -> None:
    network = build_network("locanet")
    poses = torch.from_numpy(np.stack([pose_of(0.1 * k, (0, 0, 1), 0, 0, 0) for k in range(2)]))
    rng = torch.Generator().manual_seed(1)
    pixels = torch.randint(0, 255, (2, 3, 224, 320), generator=rng, dtype=torch.uint8)
    batch = Batch(pixels, torch.full((2, 1, 11), torch.nan), poses)
    parts = compute_losses(network, batch, TrainConfig(consistency_weight=1.0))
    assert [n for n, part in zip(LOSS_NAMES, parts, strict=True) if part] == ["consistency_loss"]
    parts.sum().backward()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters() if p.grad is not None)
