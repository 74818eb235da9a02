"""Consistency of a network's output for two images that show the same robots.

A loss without labels, after the state consistency of arXiv 2603.02936. Two images of one camera
are compared by the odometry of the robot: a peer is found again where it was, but for its own
motion; a single false alarm is not. Images of two robots at the same time are compared with each
other: robots that see each other measure the same distance and opposite heights.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

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
MUTUAL_GAP_S = 0.03
"""Time between images of two robots that are compared, at most: 3 cm at 1 m/s."""
MUTUAL_STD_LOG, MUTUAL_STD_M = 0.2, 0.1
"""Standard deviations between two robots of the log distance, for depth errors of 15 % each, and of
the sum of the heights, for 1 px and 0.015 rad of each at 2 m and two cameras off the centre."""
TIME, PATH, YAW, ROLL, PITCH, LENS, CAMERA = 0, slice(1, 4), 4, 5, 6, slice(7, 11), 11
"""Columns of a pose: seconds, metres, radians, fx, fy, cx, cy in pixels or cells, and the number
of the camera."""


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
        (N, 12): ``TIME`` to ``CAMERA``, dead-reckoned; times of a flight have one origin. Rows of a
        camera are together and in order of time.
    flight
        (N,) number of the flight; only images of the same flight are paired.
    """

    paths: tuple[Path, ...]
    pixels: NDArray[np.uint8]
    poses: NDArray[np.float32]
    flight: NDArray[np.int64]

    def draw(self, pairs: int, seed: Sequence[int]) -> Batch:
        """Draw pairs of images, 2k and 2k + 1: of two robots, and of one camera if too few."""
        rng = np.random.default_rng(seed)
        mutual = rng.permutation(self._pair_robots())[:pairs]
        rows = np.concatenate([mutual, self._pair_times(rng)[: pairs - len(mutual)]]).ravel()
        images = torch.from_numpy(self.pixels[rows]).permute(0, 3, 1, 2)
        nobody = torch.full((len(rows), 1, len(ROBOT_FIELDS)), torch.nan)
        return Batch(images, nobody, torch.from_numpy(self.poses[rows]))

    def _pair_times(self, rng: np.random.Generator) -> NDArray[np.int64]:
        """Return (M, 2) rows of images of one camera that are close in time, in random order."""
        time_s, camera = self.poses[:, TIME], self.poses[:, CAMERA]
        first = rng.permutation(len(time_s) - 1)
        last = np.minimum(first + rng.integers(1, 5, len(first)), len(time_s) - 1)
        gap_s = time_s[last] - time_s[first]
        good = (gap_s >= GAP_S[0]) & (gap_s <= GAP_S[1]) & (camera[first] == camera[last])
        return np.column_stack([first[good], last[good]])

    def _pair_robots(self) -> NDArray[np.int64]:
        """Return (M, 2) rows of images of two robots of a flight at the same time."""
        time_s, camera = self.poses[:, TIME], self.poses[:, CAMERA]
        order = np.lexsort((time_s, self.flight))
        first, last = order[:-1], order[1:]
        near = np.abs(time_s[last] - time_s[first]) <= MUTUAL_GAP_S
        good = near & (self.flight[first] == self.flight[last]) & (camera[first] != camera[last])
        return np.column_stack([first[good], last[good]])


class Peaks(NamedTuple):
    """Most confident peaks of images.

    ``confidence`` and ``cell`` (N, PEAKS); ``place_m`` (N, PEAKS, 3) in the camera's axes: ahead,
    left and up.
    """

    confidence: Tensor
    cell: Tensor
    place_m: Tensor


def find_peaks(confidence: Tensor, log_depth: Tensor, offset: Tensor, poses: Tensor) -> Peaks:
    """Find the peaks of each image.

    Parameters
    ----------
    confidence, log_depth, offset
        (N, rows, cols), (N, rows, cols) and (N, 2, rows, cols) of a network.
    poses
        (N, 12), see `UnlabelledImages`; the lens in cells.
    """
    cols = confidence.shape[2]
    peak = confidence * (max_pool2d(confidence[:, None], 3, 1, 1)[:, 0] == confidence)
    best, cell = peak.flatten(1).topk(PEAKS)
    u, v = (cell % cols) + 0.5, (cell // cols) + 0.5
    u = u + offset[:, 0].flatten(1).gather(1, cell)
    v = v + offset[:, 1].flatten(1).gather(1, cell)
    depth = log_depth.flatten(1).gather(1, cell).exp()
    return Peaks(best, cell, _rays(u, v, poses) * depth[..., None])


def carry_over(peaks: Peaks, poses: Tensor, rows: int, cols: int) -> tuple[Tensor, Tensor]:
    """Carry the peaks of each image over to the other one of its pair, of the same camera.

    Returns
    -------
    support, depth_m
        (N, rows, cols) confidence carried over to each cell, and the depth of its peak there.
    """
    fx, fy, cx, cy = poses[:, LENS, None].unbind(1)
    turn = _rotations(poses)
    other = torch.arange(len(poses), device=poses.device) ^ 1
    world = peaks.place_m @ turn.mT + poses[:, None, PATH]
    seen = (world - poses[other][:, None, PATH]) @ turn[other]
    ahead = seen[..., 0].clamp(min=0.1)
    spread = PEER_SPEED_MPS * (poses[other, TIME] - poses[:, TIME]).abs()[:, None] * fx / ahead
    to_u, to_v = cx - fx * seen[..., 1] / ahead, cy - fy * seen[..., 2] / ahead
    best = peaks.confidence * (seen[..., 0] > 0.1)
    cells = partial(torch.arange, device=poses.device, dtype=best.dtype)
    du = cells(cols) + 0.5 - to_u[..., None]
    dv = cells(rows) + 0.5 - to_v[..., None]
    scale = (-0.5 / (spread.square() + PLACE_STD_CELLS**2))[..., None]
    near = (scale * du.square()).exp()[:, :, None, :] * (scale * dv.square()).exp()[..., None]
    support, by = (best[..., None, None] * near).max(dim=1)
    depth_m = ahead.gather(1, by.flatten(1)).reshape_as(support)
    return support[other], depth_m[other]


def compare_robots(peaks: Peaks, poses: Tensor, rows: int, cols: int) -> Tensor:
    """Compare the peaks of each image with those of the other one of its pair, of another robot.

    Two robots that see each other measure the same distance, and heights of opposite sign.

    Returns
    -------
    support
        (N, rows, cols) confidence of the other image in a peak, at and beside its cell.
    """
    other = torch.arange(len(poses), device=poses.device) ^ 1
    distance_m = peaks.place_m.norm(dim=-1)
    up_m = (peaks.place_m @ _rotations(poses).mT)[..., 2]
    ratio = distance_m[other][:, None, :] / distance_m[:, :, None]
    sum_m = up_m[other][:, None, :] + up_m[:, :, None]
    error = (ratio.log() / MUTUAL_STD_LOG).square() + (sum_m / MUTUAL_STD_M).square()
    best = (peaks.confidence[other][:, None, :] * (-0.5 * error).exp()).amax(dim=2)
    grid = best.new_zeros(len(poses), rows * cols).scatter(1, peaks.cell, best)
    support: Tensor = max_pool2d(grid.reshape(-1, 1, rows, cols), 3, 1, 1)[:, 0]
    return support


def compare(
    confidence: Tensor, log_depth: Tensor, offset: Tensor, poses: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compare the images of each pair, by the odometry of a camera or between two robots.

    Parameters
    ----------
    confidence, log_depth, offset, poses
        As in `find_peaks`.

    Returns
    -------
    probability, support, depth_m
        (N, rows, cols) probability of a peer given both images; confidence that the other image of
        the same camera adds, 0 between robots; and the depth by that image.
    """
    rows, cols = confidence.shape[1:]
    peaks = find_peaks(confidence, log_depth, offset, poses)
    camera = poses[:, CAMERA].reshape(-1, 2)
    mutual = (camera[:, 0] != camera[:, 1]).repeat_interleave(2)[:, None, None]
    support, depth_m = carry_over(peaks, poses, rows, cols)
    both = torch.where(mutual, compare_robots(peaks, poses, rows, cols), support)
    # Two robots that agree on any distance would do, so the distance is no target.
    return fuse(confidence, both, mutual), support * ~mutual, depth_m


def fuse(confidence: Tensor, support: Tensor, mutual: Tensor) -> Tensor:
    """Return the probability of a peer, given the confidence and the support of another image.

    A peer that the other robot does not see may be behind that robot: this counts for nothing.
    """
    hit, miss = SEEN_SHARE / LASTING_SHARE, (1 - SEEN_SHARE) / (1 - LASTING_SHARE)
    least = torch.where(mutual, 1.0, miss)
    odds = confidence * (least + (hit - least) * support)
    return odds / (odds + 1 - confidence)


def _rays(u: Tensor, v: Tensor, poses: Tensor) -> Tensor:
    """Return (N, K, 3) directions of places (N, K) in images, of depth 1."""
    fx, fy, cx, cy = poses[:, LENS, None].unbind(1)
    return torch.stack([torch.ones_like(u), (cx - u) / fx, (cy - v) / fy], dim=-1)


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
