"""The intrinsics of a camera, calibrated from exact corners and from rendered boards."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from dmrl.estimation.calibration import intrinsics as board
from dmrl.estimation.calibration.intrinsics import Intrinsics, calibrate_intrinsics, find_corners
from dmrl.geometry.frames import AIDECK, Array, Camera

from ..boards import COLUMNS, ROWS, Look, draw_lens, draw_pose, project_corners, render_board


def find_rendered_corners(
    camera: Camera, rng: np.random.Generator, views: int
) -> list[tuple[Array, Array]]:
    """Render some views; return found and true corners of those with a detected board."""
    pairs = []
    for _ in range(views):
        at = draw_pose(rng, camera)
        look = Look(rng.uniform(0.3, 1.2), rng.uniform(0.5, 4.0), rng.uniform(15, 50))
        found = find_corners(render_board(*at, camera, look, rng), COLUMNS, ROWS)
        true = project_corners(*at, camera)
        if found is not None:
            turned = np.abs(found[0] - true[0]).max() > np.abs(found[-1] - true[0]).max()
            pairs.append((found[::-1] if turned else found, true))
    return pairs


def calibrate(camera: Camera, pairs: list[tuple[Array, Array]]) -> Intrinsics:
    """Calibrate a camera on the found corners."""
    boards = [np.ascontiguousarray(found, np.float32) for found, _ in pairs]
    return calibrate_intrinsics(boards, (COLUMNS, ROWS), (camera.width_px, camera.height_px))


def normalise_errors(camera: Camera, made: Intrinsics) -> Array:
    """Return (4,) errors of focal lengths and centre over their estimated stds."""
    found = made.camera
    errors = np.subtract(
        (found.fx_px, found.fy_px, found.cx_px, found.cy_px),
        (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px),
    )
    return np.asarray(errors / (*made.focal_std_px, *made.centre_std_px))


@pytest.mark.heavy
def test_intrinsics_are_reproducible() -> None:
    rng = np.random.default_rng(0)
    seen = [project_corners(*draw_pose(rng)) for _ in range(8)]
    views = [(at + rng.normal(0, 0.1, at.shape)).astype(np.float32) for at in seen]
    made = [calibrate_intrinsics(views, (COLUMNS, ROWS), (320, 224)) for _ in range(20)]
    assert len({one.camera for one in made}) == 1


def test_exact_corners_give_the_exact_camera() -> None:
    rng = np.random.default_rng(3)
    seen = [(project_corners(*draw_pose(rng)),) * 2 for _ in range(8)]
    made = calibrate(AIDECK, seen)
    for name in ("fx_px", "fy_px", "cx_px", "cy_px"):
        assert getattr(made.camera, name) == pytest.approx(getattr(AIDECK, name), abs=0.02)
    assert made.rms_px < 1e-3
    assert made.focal_share < 0.01


@pytest.mark.heavy
@pytest.mark.parametrize("seed", range(3))
def test_boards_that_face_the_camera_do_not_determine_the_focal_length(seed: int) -> None:
    rng = np.random.default_rng(seed)
    flat, seen = np.mgrid[:COLUMNS, :ROWS].T.reshape(-1, 2), []
    for _ in range(8):
        at = rng.uniform(15, 25) * flat + rng.uniform([20, 20], [60, 60])
        seen.append(((at + rng.normal(0, 0.1, at.shape)).astype(np.float32),) * 2)
    assert calibrate(AIDECK, seen).focal_share > 0.1


@pytest.mark.heavy
def test_intrinsics_of_rendered_boards_equal_the_true_camera() -> None:
    pairs = find_rendered_corners(AIDECK, np.random.default_rng(0), 10)
    assert len(pairs) >= 8
    made = calibrate(AIDECK, pairs)
    assert made.camera.fx_px == pytest.approx(AIDECK.fx_px, rel=0.005)
    assert made.camera.fy_px == pytest.approx(AIDECK.fy_px, rel=0.005)
    assert made.camera.cx_px == pytest.approx(AIDECK.cx_px, abs=0.7)
    assert made.camera.cy_px == pytest.approx(AIDECK.cy_px, abs=0.7)
    assert np.abs(normalise_errors(AIDECK, made)).max() < 4
    assert (made.camera.width_px, made.camera.height_px) == (320, 224)


@pytest.mark.heavy
def test_corners_are_found_to_a_twentieth_of_a_pixel() -> None:
    pairs = find_rendered_corners(AIDECK, np.random.default_rng(1), 8)
    errors = np.concatenate([found - true for found, true in pairs])
    assert np.sqrt((errors**2).mean()) < 0.06
    assert np.abs(errors).max() < 0.4


@pytest.mark.heavy
def test_corners_are_found_downscaled_and_refined_at_full_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(1)
    at = draw_pose(rng)
    grey = render_board(*at)
    whole = find_corners(grey, COLUMNS, ROWS)
    monkeypatch.setattr(board, "MAX_DETECTION_PIXELS", grey.size // 3)
    monkeypatch.setattr(board.cv2, "findChessboardCornersSB", _limit_detector(grey.size // 4 + 1))
    found = find_corners(grey, COLUMNS, ROWS)
    assert whole is not None and found is not None
    assert np.abs(found - whole).max() < 0.05
    assert find_corners(grey[:1], COLUMNS, ROWS) is None


def _limit_detector(pixels: int) -> Callable[..., Any]:
    """Return OpenCV's detector that fails on images with more pixels."""
    detect = board.cv2.findChessboardCornersSB

    def detect_small(grey: Any, *given: Any, **named: Any) -> Any:
        assert grey.size <= pixels
        return detect(grey, *given, **named)

    return detect_small


@pytest.mark.slow
def test_sigmas_of_thirty_lenses_are_consistent() -> None:
    squares = []
    for seed in range(30):
        rng = np.random.default_rng(100 + seed)
        camera = draw_lens(rng)
        squares.append(
            normalise_errors(camera, calibrate(camera, find_rendered_corners(camera, rng, 12))) ** 2
        )
    low, high = chi2.ppf((0.025, 0.975), 30) / 30
    for mean in np.mean(squares, axis=0):
        assert low < mean < high


def test_a_picture_without_a_board_has_no_corners() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (224, 320), np.uint8)
    assert find_corners(noise, COLUMNS, ROWS) is None
