import cv2
import numpy as np
import pytest

from dmrl.estimation.board import corners, intrinsics
from dmrl.geometry.frames import AIDECK, Array

COLUMNS, ROWS, SQUARE_M = 7, 5, 0.03
K = AIDECK.image_from_optical - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # OpenCV's centre


def pose(rng: np.random.Generator) -> tuple[Array, Array]:
    """Rotation vector and place of a board in view, optical frame."""
    turn = rng.uniform(-0.6, 0.6, 3) * [1.0, 1.0, 0.3]
    middle = np.array([(COLUMNS - 1) / 2, (ROWS - 1) / 2, 0.0]) * SQUARE_M
    place = np.array([rng.uniform(-0.05, 0.04), rng.uniform(0.0, 0.06), rng.uniform(0.25, 0.35)])
    return turn, place - cv2.Rodrigues(turn)[0] @ middle


def picture(turn: Array, place: Array) -> np.ndarray:
    """The board as the camera shows it: every pixel's ray meets the board's plane."""
    v, u = np.mgrid[:224, :320].astype(float)
    rays = cv2.undistortPoints(
        np.stack([u, v], -1).reshape(-1, 1, 2), K, np.array(AIDECK.distortion)
    )
    rays = np.column_stack([rays.reshape(-1, 2), np.ones(320 * 224)])
    rotation = cv2.Rodrigues(turn)[0]
    scale = (rotation[:, 2] @ place) / (rays @ rotation[:, 2])
    x, y, _ = ((rays * scale[:, None] - place) @ rotation / SQUARE_M).T
    on = (x > -1) & (x < COLUMNS) & (y > -1) & (y < ROWS)
    black = (np.floor(x) + np.floor(y)) % 2 == 0
    grey = np.where(on & black, 30.0, 220.0).reshape(224, 320)
    return cv2.GaussianBlur(grey, (0, 0), 0.7).astype(np.uint8)


def test_a_drawn_board_gives_the_camera_that_drew_it() -> None:
    rng = np.random.default_rng(0)
    poses = [pose(rng) for _ in range(20)]
    found = [corners(picture(*p), COLUMNS, ROWS) for p in poses]
    boards = [board for board in found if board is not None]
    assert len(boards) >= 8
    made = intrinsics(boards, (COLUMNS, ROWS), (320, 224))
    assert made.camera.fx_px == pytest.approx(AIDECK.fx_px, rel=0.02)
    assert made.camera.fy_px == pytest.approx(AIDECK.fy_px, rel=0.02)
    assert made.camera.cx_px == pytest.approx(AIDECK.cx_px, abs=2.0)
    assert made.camera.cy_px == pytest.approx(AIDECK.cy_px, abs=2.0)
    assert made.rms_px < 0.3
    assert (made.camera.width_px, made.camera.height_px) == (320, 224)


def test_a_picture_without_a_board_has_no_corners() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (224, 320), np.uint8)
    assert corners(noise, COLUMNS, ROWS) is None
