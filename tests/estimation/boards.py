"""Rendered chessboards with known corners."""

from dataclasses import dataclass

import cv2
import numpy as np

from dmrl.geometry.frames import AIDECK, Array, Camera

COLUMNS, ROWS, SQUARE_M = 7, 5, 0.03
FINER = 3
"""Rays along each side of a pixel, so that edges are not limited by the pixel raster."""


@dataclass(frozen=True)
class Look:
    """Appearance of a rendered board: blur, pixel noise, and grey levels of its squares."""

    blur_px: float = 0.7
    noise: float = 0.0
    black: float = 30.0
    white: float = 220.0


def draw_lens(rng: np.random.Generator) -> Camera:
    """Draw a small camera with a random focal length, centre and distortion."""
    width, height = ((320, 224), (324, 244))[rng.integers(2)]
    fx = width * rng.uniform(0.5, 1.1)
    middle = width / 2 + rng.uniform(-8, 8), height / 2 + rng.uniform(-20, 20)
    bend = (rng.uniform(-0.15, 0.02), rng.uniform(-0.02, 0.05), *rng.uniform(-1e-3, 1e-3, 2), 0.0)
    return Camera(width, height, fx, fx * rng.uniform(0.99, 1.01), *middle, tuple(bend))


def draw_pose(rng: np.random.Generator, camera: Camera = AIDECK) -> tuple[Array, Array]:
    """Draw rotation vector and position of a board that is fully in view, optical frame."""
    while True:
        turn = rng.uniform((-0.7, -0.7, -0.4), (0.7, 0.7, 0.4))
        middle = np.array([(COLUMNS - 1) / 2, (ROWS - 1) / 2, 0.0]) * SQUARE_M
        far = rng.uniform(0.6, 1.3) * camera.fx_px / camera.width_px * COLUMNS * SQUARE_M / 0.6
        side = rng.uniform(-0.3, 0.3, 2) * far * np.array((camera.width_px, camera.height_px))
        place = np.array([*(side / camera.fx_px), far]) - cv2.Rodrigues(turn)[0] @ middle
        uv = project_corners(turn, place, camera)
        if ((uv > 6) & (uv < np.array([camera.width_px, camera.height_px]) - 6)).all():
            return turn, place


def project_corners(turn: Array, place: Array, camera: Camera = AIDECK) -> Array:
    """Return (columns x rows, 2) true corners of a board, pixel-edge coordinates."""
    flat = np.zeros((COLUMNS * ROWS, 3))
    flat[:, :2] = np.mgrid[:COLUMNS, :ROWS].T.reshape(-1, 2) * SQUARE_M
    bend = np.array(camera.distortion or (0.0,) * 5)
    uv, _ = cv2.projectPoints(flat, turn, place, camera.image_from_optical, bend)
    return np.asarray(uv, np.float64).reshape(-1, 2)


def render_board(
    turn: Array,
    place: Array,
    camera: Camera = AIDECK,
    look: Look | None = None,
    rng: np.random.Generator | None = None,
) -> np.ndarray:
    """Render the board by intersecting the rays of every pixel with its plane."""
    look = look or Look()
    height, width = camera.height_px, camera.width_px
    v, u = (np.mgrid[: height * FINER, : width * FINER] + 0.5) / FINER
    bend = np.array(camera.distortion or (0.0,) * 5)
    at = np.stack([u, v], -1).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(at, camera.image_from_optical, bend).reshape(-1, 2)
    rays = np.column_stack([rays, np.ones(len(rays))])
    rotation = cv2.Rodrigues(turn)[0]
    scale = (rotation[:, 2] @ place) / (rays @ rotation[:, 2])
    x, y, _ = ((rays * scale[:, None] - place) @ rotation / SQUARE_M).T
    on = (x > -1) & (x < COLUMNS) & (y > -1) & (y < ROWS)
    black = (np.floor(x) + np.floor(y)) % 2 == 0
    fine = np.where(on & black, look.black, look.white).reshape(height * FINER, width * FINER)
    fine = cv2.GaussianBlur(fine, (0, 0), look.blur_px * FINER)
    grey = fine.reshape(height, FINER, width, FINER).mean(axis=(1, 3))
    if rng is not None:
        grey += rng.normal(0.0, look.noise, grey.shape)
    return np.clip(np.round(grey), 0, 255).astype(np.uint8)
