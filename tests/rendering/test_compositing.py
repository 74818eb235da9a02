"""Labels and pixels of robots composited over a backdrop, from square layers."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.geometry.frames import AIDECK, Camera
from dmrl.rendering.camera.distortion import image_from_pinhole, pinhole_canvas
from dmrl.rendering.camera.sensor import Sensor
from dmrl.rendering.compositing import compose_shot
from dmrl.rendering.shot import Layer, Light, Look, Robot, find_crop
from dmrl.rendering.sketch_renderer import Pose

PINHOLE = replace(AIDECK, distortion=())
LIGHT = Light("x", (0.0, 0.0, 0.0), 1.0, np.array([0.0, 0.0, 1.0]), 0.0, (1.0, 1.0, 1.0), 0.1)


def build_look(camera: Camera) -> Look:
    """Return the look of a grey backdrop under a linear sensor without noise."""
    grey = np.full((camera.height_px, camera.width_px, 3), 0.2, np.float32)
    return Look(grey, LIGHT, Sensor(contrast_gamma=1.0))


def build_robot(depth_m: float, move_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Robot:
    """Return a robot straight ahead, which moves by metres in the camera frame."""
    return Robot(Pose(np.array([depth_m, 0.0, 0.0]), np.eye(3)), {}, np.array(move_m))


def build_square(left: int, top: int, size: int, depth_m: float) -> Layer:
    """Return a white, opaque layer of size x size pixels."""
    light = np.ones((size, size, 4), np.float32)
    return Layer(left, top, light, np.full((size, size), depth_m, np.float32))


def test_a_box_holds_exactly_the_covered_pixels() -> None:
    shot = compose_shot(
        PINHOLE, [build_robot(1.0)], build_look(PINHOLE), {0: build_square(100, 50, 20, 1.0)}
    )
    assert shot.box_px[0].tolist() == [100, 50, 120, 70]
    assert shot.visible_share.tolist() == [1.0]
    assert shot.uv_px[0].tolist() == [PINHOLE.cx_px, PINHOLE.cy_px]
    assert (shot.opacity[0] == 255).sum() == 400
    assert (shot.surface_m[50:70, 100:120] == 1.0).all()
    assert np.count_nonzero(shot.surface_m) == 400


def test_a_near_robot_hides_a_far_one_in_any_order() -> None:
    layers = {0: build_square(100, 50, 20, 2.0), 1: build_square(110, 50, 20, 1.0)}
    shot = compose_shot(PINHOLE, [build_robot(2.0), build_robot(1.0)], build_look(PINHOLE), layers)
    assert shot.visible_share.tolist() == [0.5, 1.0]
    assert shot.box_px[0].tolist() == [100, 50, 110, 70]
    assert shot.surface_m[60, 115] == 1.0


def test_robot_blur_softens_the_edge_without_changing_labels() -> None:
    black = build_square(100, 50, 20, 1.0)
    black.light[..., :3] = 0
    layers = {0: black}
    sharp = compose_shot(PINHOLE, [build_robot(1.0)], build_look(PINHOLE), layers)
    soft = compose_shot(
        PINHOLE, [build_robot(1.0)], replace(build_look(PINHOLE), robot_blur_px=1.0), layers
    )
    across = soft.rgb[60, 95:125, 0].astype(float)
    assert across == pytest.approx(across[::-1], abs=1)
    assert soft.rgb[60, 110, 0] == sharp.rgb[60, 110, 0] == 0
    assert (np.diff(across[:9]) <= 0).all()
    assert 0 < across[5] < across[3] < across[0]
    assert np.array_equal(soft.box_px, sharp.box_px)
    assert np.array_equal(soft.opacity, sharp.opacity)


def test_a_fully_hidden_robot_has_no_box() -> None:
    layers = {0: build_square(100, 50, 20, 2.0), 1: build_square(90, 40, 40, 1.0)}
    shot = compose_shot(PINHOLE, [build_robot(2.0), build_robot(1.0)], build_look(PINHOLE), layers)
    assert shot.visible_share[0] == 0
    assert np.isnan(shot.box_px[0]).all()


@pytest.mark.heavy
def test_tiny_distortion_gives_the_image_without_distortion() -> None:
    light = np.random.default_rng(0).random((30, 30, 4), np.float32)
    depth_m = np.linspace(0.9, 1.1, 900, dtype=np.float32).reshape(30, 30)
    shots = []
    for camera in (PINHOLE, replace(AIDECK, distortion=(1e-9,))):
        left, top = pinhole_canvas(camera).shift_px.astype(int).tolist()
        # The layer lies at the edge of the image.
        layers = {0: Layer(left, top + 60, light, depth_m)}
        blurred = replace(build_look(camera), robot_blur_px=0.4)
        shots.append(compose_shot(camera, [build_robot(1.0)], blurred, layers))
    plain, bent = shots
    assert np.abs(plain.rgb.astype(int) - bent.rgb).max() <= 1
    assert np.abs(plain.opacity.astype(int) - bent.opacity).max() <= 1
    assert np.allclose(plain.surface_m, bent.surface_m)
    assert np.allclose(plain.box_px, bent.box_px, atol=1e-3)


@pytest.mark.heavy
def test_lens_distortion_applies_to_box_and_centre() -> None:
    canvas = pinhole_canvas(AIDECK)
    corner = np.array([30, 150])
    layer = build_square(*(corner + canvas.shift_px.astype(int)).tolist(), 20, 1.0)
    shot = compose_shot(AIDECK, [build_robot(1.0)], build_look(AIDECK), {0: layer})
    edges = [(30.0, 150.0), (50.0, 150.0), (30.0, 170.0), (50.0, 170.0)]
    bent = image_from_pinhole(np.array(edges), AIDECK)
    wanted = [*bent.min(axis=0), *bent.max(axis=0)]
    assert shot.box_px[0] == pytest.approx(wanted, abs=0.05)
    rows, cols = np.nonzero(shot.opacity[0])
    assert cols.min() == pytest.approx(shot.box_px[0, 0], abs=1)
    assert rows.max() + 1 == pytest.approx(shot.box_px[0, 3], abs=1)


def test_motion_blurs_the_picture_without_changing_labels() -> None:
    layers = {0: build_square(150, 70, 10, 1.0)}
    still = compose_shot(PINHOLE, [build_robot(1.0)], build_look(PINHOLE), layers)
    moved = compose_shot(PINHOLE, [build_robot(1.0, (0.0, 0.05, 0.0))], build_look(PINHOLE), layers)
    assert np.array_equal(still.box_px, moved.box_px)
    bright = [
        np.count_nonzero(shot.rgb[75, :, 0] > shot.rgb[0, 0, 0] + 2) for shot in (still, moved)
    ]
    assert bright[0] == 10
    assert bright[1] == pytest.approx(10 + 0.05 * PINHOLE.fx_px, abs=2)


@pytest.mark.heavy
def test_an_empty_scene_is_its_backdrop() -> None:
    shot = compose_shot(AIDECK, [], build_look(AIDECK), {})
    assert len(shot.uv_px) == len(shot.box_px) == 0
    assert np.ptp(shot.rgb) == 0


def test_a_robot_behind_the_camera_or_outside_is_not_rendered() -> None:
    points = np.array([[-0.05, -0.05, -0.01], [0.05, 0.05, 0.01]])
    canvas = pinhole_canvas(PINHOLE)
    assert find_crop(canvas, Pose(np.array([-1.0, 0.0, 0.0]), np.eye(3)), points) is None
    assert find_crop(canvas, Pose(np.array([1.0, 5.0, 0.0]), np.eye(3)), points) is None
    crop = find_crop(canvas, Pose(np.array([1.0, 0.0, 0.0]), np.eye(3)), points)
    assert crop is not None
    assert crop[0] < PINHOLE.cx_px < crop[2]
