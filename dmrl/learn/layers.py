"""Windows of images and the rectangles that show them: the geometry of ``augment``."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

from dmrl.learn.batches import BOX, DEPTH, SIGMA_DEPTH, SIGMA_U, SIGMA_V, Robots, U, V

FEATHER_PX = 3.0
"""Width of a pasted patch's soft border."""
LEFT_RIGHT, TOP_BOTTOM = np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1])

Rng = np.random.Generator
Rect = tuple[int, int, int, int]
"""Left, top, right, bottom on the canvas, whole pixels."""


class Window(NamedTuple):
    """Where a canvas rectangle looks: source = matrix @ (canvas - corner) + origin, pixels."""

    matrix: NDArray[np.float64]
    origin: NDArray[np.float64]
    zoom: float


def sample(raw: NDArray[np.uint8], window: Window, shape: tuple[int, int]) -> Tensor:
    """(h, w, 3) float32 pixels that a rectangle of this shape shows of an image (H, W, 3)."""
    if shape == raw.shape[:2] and window.zoom == 1 and (window.matrix == np.eye(2)).all():
        return torch.from_numpy(raw.astype(np.float32))
    # Only what the window looks at is made float.
    corners = window.matrix @ (shape[1] * LEFT_RIGHT, shape[0] * TOP_BOTTOM)
    seen = corners + window.origin[:, None]
    size = np.array([raw.shape[1], raw.shape[0]])
    low = np.clip(np.floor(seen.min(axis=1)).astype(int) - 1, 0, size - 2)
    high = np.clip(np.ceil(seen.max(axis=1)).astype(int) + 1, low + 2, size)
    part = raw[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    image = torch.from_numpy(part).permute(2, 0, 1)[None]
    # grid_sample counts from -1 to 1 over the image's edges.
    scale = 2 / (high - low)
    step = (window.matrix * scale[:, None]).astype(np.float32)
    start = ((window.origin - low) * scale - 1).astype(np.float32)
    down, across = (torch.arange(n, dtype=torch.float32) + 0.5 for n in shape)
    grid = torch.empty(1, *shape, 2)
    for axis in range(2):
        rows = down * float(step[axis, 1]) + float(start[axis])
        torch.add(rows[:, None], across * float(step[axis, 0]), out=grid[0, ..., axis])
    out = grid_sample(image, grid, padding_mode="border", align_corners=False)
    return out[0].permute(1, 2, 0)


def parts(whole: Rect, rng: Rng) -> list[Rect]:
    """A rectangle cut in two or four, cut between a third and two thirds of its sides."""
    left, top, right, bottom = whole
    x = round(left + (right - left) * rng.uniform(1 / 3, 2 / 3))
    y = round(top + (bottom - top) * rng.uniform(1 / 3, 2 / 3))
    kind = rng.integers(3)
    if kind == 0:
        return [(left, top, x, bottom), (x, top, right, bottom)]
    if kind == 1:
        return [(left, top, right, y), (left, y, right, bottom)]
    return [(left, top, x, y), (x, top, right, y), (left, y, x, bottom), (x, y, right, bottom)]


def present(robots: Robots) -> Robots:
    """The rows that are robots."""
    return robots[np.isfinite(robots[:, U])]


def inside(robots: Robots, rect: Rect) -> NDArray[np.bool_]:
    """(n,) which robots have their centres in a rectangle."""
    u, v = robots[:, U], robots[:, V]
    within: NDArray[np.bool_] = (rect[0] <= u) & (u < rect[2]) & (rect[1] <= v) & (v < rect[3])
    return within


def under(robots: Robots, rect: Rect, opacity: Tensor | None) -> NDArray[np.bool_]:
    """(n,) which robots have their centres under a layer (h, w, 1), None: opaque."""
    within = inside(robots, rect)
    if opacity is not None:
        u, v = (robots[within][:, [U, V]] - rect[:2]).astype(int).T
        within[within] = opacity[v, u, 0].numpy() > 0.5
    return within


def moved(robots: Robots, window: Window, rect: Rect) -> Robots:
    """Robots of a source where a window puts them on the canvas."""
    back = np.linalg.inv(window.matrix)
    out = robots.copy()
    out[:, BOX] = np.nan  # not carried along: nothing asks for it
    corner = np.array(rect[:2])
    out[:, [U, V]] = (robots[:, [U, V]] - window.origin) @ back.T + corner
    out[:, DEPTH] = robots[:, DEPTH] / window.zoom
    out[:, SIGMA_DEPTH] = robots[:, SIGMA_DEPTH] / window.zoom
    out[:, [SIGMA_U, SIGMA_V]] = robots[:, [SIGMA_U, SIGMA_V]] * window.zoom
    return out


def feather(height: int, width: int) -> Tensor:
    """(h, w, 1) opacity: 1 within, falling to 0 over the border."""
    down, across = (
        ((torch.minimum(r, n - 1 - r) + 1) / (FEATHER_PX + 1)).clamp(max=1)
        for n, r in ((n, torch.arange(n, dtype=torch.float32)) for n in (height, width))
    )
    return (down[:, None] * across)[..., None]
