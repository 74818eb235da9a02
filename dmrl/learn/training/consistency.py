"""Consistency of a network's output for two images with the camera's own motion between them.

A loss without labels, after the state consistency of arXiv 2603.02936: the confidence and depth of
an image are compared with those of another one, carried over by the odometry of the robot. A peer
is found again where it was, but for its own motion; a single false alarm is not.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import max_pool2d

from dmrl.learn.data.batches import ROBOT_FIELDS, Batch

SEEN_SHARE, LASTING_SHARE = 0.7, 0.3
"""Probability that a peer, and that a false alarm, is found in the next image as well: the recall
and the share of lasting alarms that the tracker assumes of dmrl-nano."""
PEAKS = 6
"""Most confident peaks of an image that are carried over."""
PEER_SPEED_MPS, PLACE_STD_CELLS = 0.35, 0.5
"""Standard deviation of a peer's speed, and of a place in the image."""
GAP_S = 0.05, 0.45
"""Time between the two images of a pair, at least and at most."""
TIME, PATH, YAW, ROLL, PITCH, LENS = 0, slice(1, 4), 4, 5, 6, slice(7, 11)
"""Columns of a pose: seconds, metres, radians, and fx, fy, cx, cy in pixels or cells."""


@dataclass(frozen=True, slots=True)
class UnlabelledImages:
    """Images of one or more flights, with the poses of the camera.

    Parameters
    ----------
    paths
        Recordings that they are from.
    pixels
        (N, H, W, 3) uint8, RGB.
    poses
        (N, 11): ``TIME`` to ``LENS``, dead-reckoned.
    camera
        (N,) number of the robot and flight; only images of the same camera are paired.
    """

    paths: tuple[Path, ...]
    pixels: NDArray[np.uint8]
    poses: NDArray[np.float32]
    camera: NDArray[np.int64]

    def draw(self, pairs: int, seed: Sequence[int]) -> Batch:
        """Draw pairs of images that are close in time: images 2k and 2k + 1 are a pair."""
        rng, time_s = np.random.default_rng(seed), self.poses[:, TIME]
        first = rng.permutation(len(time_s) - 1)
        last = np.minimum(first + rng.integers(1, 5, len(first)), len(time_s) - 1)
        gap_s = time_s[last] - time_s[first]
        good = (gap_s >= GAP_S[0]) & (gap_s <= GAP_S[1]) & (self.camera[first] == self.camera[last])
        rows = np.column_stack([first[good], last[good]])[:pairs].ravel()
        images = torch.from_numpy(self.pixels[rows]).permute(0, 3, 1, 2)
        nobody = torch.full((len(rows), 1, len(ROBOT_FIELDS)), torch.nan)
        return Batch(images, nobody, torch.from_numpy(self.poses[rows]))


def carry_over(
    confidence: Tensor, log_depth: Tensor, offset: Tensor, poses: Tensor
) -> tuple[Tensor, Tensor]:
    """Carry the peaks of each image over to the other one of its pair.

    Parameters
    ----------
    confidence, log_depth, offset
        (N, rows, cols), (N, rows, cols) and (N, 2, rows, cols) of a network.
    poses
        (N, 11), see `UnlabelledImages`; the lens in cells.

    Returns
    -------
    support, depth_m
        (N, rows, cols) confidence carried over to each cell, and the depth of its peak there.
    """
    count, rows, cols = confidence.shape
    peak = confidence * (max_pool2d(confidence[:, None], 3, 1, 1)[:, 0] == confidence)
    best, cell = peak.flatten(1).topk(PEAKS)
    v, u = (cell // cols) + 0.5, (cell % cols) + 0.5
    u = u + offset[:, 0].flatten(1).gather(1, cell)
    v = v + offset[:, 1].flatten(1).gather(1, cell)
    depth = log_depth.flatten(1).gather(1, cell).exp()
    fx, fy, cx, cy = poses[:, LENS, None].unbind(1)
    place = torch.stack([depth, depth * (cx - u) / fx, depth * (cy - v) / fy], dim=-1)
    turn = _rotations(poses)
    other = torch.arange(count, device=poses.device) ^ 1
    world = place @ turn.mT + poses[:, None, PATH]
    seen = (world - poses[other][:, None, PATH]) @ turn[other]
    ahead = seen[..., 0].clamp(min=0.1)
    spread = PEER_SPEED_MPS * (poses[other, TIME] - poses[:, TIME]).abs()[:, None] * fx / ahead
    to_u, to_v = cx - fx * seen[..., 1] / ahead, cy - fy * seen[..., 2] / ahead
    best = best * (seen[..., 0] > 0.1)
    cells = partial(torch.arange, device=poses.device, dtype=confidence.dtype)
    du = cells(cols) + 0.5 - to_u[..., None]
    dv = cells(rows) + 0.5 - to_v[..., None]
    scale = (-0.5 / (spread.square() + PLACE_STD_CELLS**2))[..., None]
    near = (scale * du.square()).exp()[:, :, None, :] * (scale * dv.square()).exp()[..., None]
    support, by = (best[..., None, None] * near).max(dim=1)
    depth_m = ahead.gather(1, by.flatten(1)).reshape_as(support)
    return support[other], depth_m[other]


def fuse(confidence: Tensor, support: Tensor) -> Tensor:
    """Return the probability of a peer, given the confidence and the support of another image."""
    hit, miss = SEEN_SHARE / LASTING_SHARE, (1 - SEEN_SHARE) / (1 - LASTING_SHARE)
    odds = confidence * (miss + (hit - miss) * support)
    return odds / (odds + 1 - confidence)


def _rotations(poses: Tensor) -> Tensor:
    """Return (N, 3, 3) rotations from the camera to the world: Rz(yaw) Ry(pitch) Rx(roll)."""
    (cy, cp, cr), (sy, sp, sr) = (
        [turn(poses[:, k]) for k in (YAW, PITCH, ROLL)] for turn in (torch.cos, torch.sin)
    )
    entries = (
        *(cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        *(sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        *(-sp, cp * sr, cp * cr),
    )
    return torch.stack(entries, dim=1).reshape(-1, 3, 3)
