"""Training targets of every grid cell, built from the labelled robots of an image.

One rule gives both the paper's labels and softer ones. The presence of a robot in a cell is g =
exp(-d^2 / 2 s^2), d the distance from the cell centre to the robot centre in cells. At s = 0, g is
1 in the cell of the centre and 0 elsewhere (paper eq. 4). Depth and offset of a cell are those of
the robot with the highest presence there; of equal ones, the nearer robot.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from dmrl.learn.data.batches import CLASS_ID, DEPTH, SIGMA_DEPTH, SIGMA_U, SIGMA_V, U, V
from dmrl.learn.networks.architectures import unbind_channels

MIN_PRESENCE = 0.1
"""Lower bound of g for cells that train depth and offset."""
SIGMA_TOLERANCE_PX, SIGMA_TOLERANCE_DEPTH = 8.0, 0.1
"""Sigma (pixels; fraction of the depth) at which a label has half weight."""

LabelNoise = Literal["ignore", "weight", "soften"]


class Targets(NamedTuple):
    """Targets of N images, float32 except ``class_id``.

    Parameters
    ----------
    confidence
        (N, rows, cols), 0 to 1.
    confidence_weight
        (N, rows, cols) weight of a cell in the confidence loss; 1 where labels are exact.
    weight, offset_weight
        (N, rows, cols) weight of a cell in the loss of the depth and of the offset; 0 away from
        robots. That of the depth is 0 too where the depth is unknown.
    depth_m
        (N, rows, cols) metres; 1 where the weight is 0.
    offset
        (N, 2, rows, cols) robot centre minus cell centre, (u, v), cells.
    class_id
        (N, rows, cols) int64 class of the robot; -1 where it is unknown or there is no robot.
    poses
        (N, 12) of the camera, for pairs of images without labels; else None.
    """

    confidence: Tensor
    confidence_weight: Tensor
    weight: Tensor
    offset_weight: Tensor
    depth_m: Tensor
    offset: Tensor
    class_id: Tensor
    poses: Tensor | None = None


def build_targets(
    robots: Tensor,
    shape: tuple[int, int],
    *,
    sigma_cells: float,
    stride_px: int = 8,
    label_noise: LabelNoise = "ignore",
) -> Targets:
    """Build the targets of a batch.

    Parameters
    ----------
    robots
        (N, K, 11), see ``ROBOT_FIELDS`` of `batches`. A robot whose centre is outside the image has
        no cell of its own, but may be present in cells nearby.
    shape
        Rows and columns of the grid.
    sigma_cells
        Width s of the presence, cells.
    stride_px
        Pixels per cell, both ways.
    label_noise
        Use of the labels' sigmas. "weight": the weight of a robot's cells is
        1 / (1 + (sigma / tolerance)^2). "soften": the square of the sigma is added to s^2 and the
        height of g is reduced, which gives the mean of g over the robot's possible positions.
    """
    robots = robots.to(torch.float32)
    unknown = torch.isinf(robots[..., SIGMA_DEPTH])  # no depth is known
    ahead = torch.isfinite(robots[..., :3]).all(dim=-1) & ((robots[..., DEPTH] > 0) | unknown)
    # ``ahead`` removes robots by a product with 0, which NaN would survive.
    clean = torch.nan_to_num(robots, nan=0.0, posinf=0.0)
    sigma_px = (clean[..., SIGMA_U].square() + clean[..., SIGMA_V].square()).div(2).sqrt()
    du, dv = _offsets_from_cells(clean[..., (U, V)] / stride_px, shape)
    present = _compute_presence(
        du, dv, sigma_cells, sigma_px / stride_px, soften=label_noise == "soften"
    )
    present = present * ahead[..., None, None]
    # Slightly raise the presence of nearer robots, to break ties; unknown depths count as far.
    bonus = 1e-3 / (1 + clean[..., DEPTH]) * ~unknown
    rank = present * (1 + bonus[..., None, None])
    best = rank.argmax(dim=1, keepdim=True)
    confidence = present.amax(dim=1)
    near = confidence * (confidence >= MIN_PRESENCE)
    trust_px, trust_depth = torch.ones_like(near), torch.ones_like(near)
    if label_noise == "weight":
        relative = clean[..., SIGMA_DEPTH] / clean[..., DEPTH].clamp(min=1e-3)
        trust_px = _gather_best(best, _label_weight(sigma_px / SIGMA_TOLERANCE_PX))
        trust_depth = _gather_best(best, _label_weight(relative / SIGMA_TOLERANCE_DEPTH))
    trust_depth = trust_depth * _gather_best(best, ~unknown[..., None, None])
    depth_m = torch.where(unknown, 1.0, clean[..., DEPTH])
    found = near > 0
    class_id = torch.nan_to_num(robots[..., CLASS_ID, None, None], nan=-1.0)
    return Targets(
        confidence,
        # Background cells have full weight: their emptiness does not depend on a label's sigma.
        torch.where(confidence > 0.01, trust_px, 1.0),
        near * trust_depth,
        near * trust_px,
        # 1 m without a robot or its depth, so that the logarithm is finite; the weight there is 0.
        torch.where(found, _gather_best(best, depth_m[..., None, None]), 1.0),
        torch.stack((_gather_best(best, du), _gather_best(best, dv)), dim=1) * found[:, None],
        torch.where(found, _gather_best(best, class_id), -1.0).to(torch.int64),
    )


def _offsets_from_cells(centre: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return the offsets (N, K, 1, cols) and (N, K, rows, 1) from cell to robot centres, cells."""
    rows, cols = (torch.arange(n, device=centre.device) + 0.5 for n in shape)
    return centre[..., 0, None, None] - cols, centre[..., 1, None, None] - rows[:, None]


def _gather_best(best: Tensor, values: Tensor) -> Tensor:
    """Return (N, rows, cols) the value of the robot with the highest presence in each cell.

    ``best`` is (N, 1, rows, cols), the index of that robot. ``values`` are (N, K, ...), broadcast
    over the cells.
    """
    every = values.expand(*values.shape[:2], *best.shape[2:])
    return every.gather(1, best)[:, 0]


def build_teacher_targets(channels: Sequence[str], output: Tensor, labelled: Targets) -> Targets:
    """Build targets for N images from a teacher's output, for distillation (Hinton et al. 2015).

    The teacher's confidence is the target in all cells. Depth and offset are weighted by that
    confidence and only count where it reaches `MIN_PRESENCE`. Classes are those of the labels.

    Parameters
    ----------
    channels
        Channels of the output.
    output
        (N, C, rows, cols).
    labelled
        Targets of the same images from their labels.
    """
    out = unbind_channels(channels, output)
    confidence = out["confidence"].sigmoid()
    near = confidence * (confidence >= MIN_PRESENCE)
    offset = labelled.offset
    if "offset_u" in out:
        offset = torch.stack((out["offset_u"], out["offset_v"]), dim=1)
    return labelled._replace(
        confidence=confidence,
        confidence_weight=torch.ones_like(confidence),
        weight=near,
        offset_weight=near,
        depth_m=torch.where(near > 0, out["log_depth"].exp(), 1.0),
        offset=offset,
    )


def _compute_presence(
    du: Tensor, dv: Tensor, sigma_cells: float, sigma_label: Tensor, *, soften: bool
) -> Tensor:
    """Return (N, K, rows, cols) the presence g of every robot in every cell."""
    if sigma_cells == 0:
        # Half open, so that a centre on a border is in one cell.
        inside: Tensor = (du >= -0.5) & (du < 0.5) & (dv >= -0.5) & (dv < 0.5)
        return inside.to(torch.float32)
    variance = torch.full_like(sigma_label, sigma_cells**2)
    height = torch.ones_like(variance)
    if soften:
        height = variance / (variance + sigma_label.square())
        variance = variance + sigma_label.square()
    scale = (-0.5 / variance)[..., None, None]
    # exp of a sum is a product: compute it per row and per column, not per cell.
    return (scale * du.square()).exp() * (scale * dv.square()).exp() * height[..., None, None]


def _label_weight(ratio: Tensor) -> Tensor:
    """Return the weight of labels by the ratio of sigma and tolerance."""
    return (1 / (1 + ratio.square()))[..., None, None]
