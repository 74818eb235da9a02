"""Views of panoramas that are backgrounds of robots."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.geometry.frames import AIDECK
from dmrl.rendering.backgrounds.panorama import Panorama, find_angles

CAMERA = replace(AIDECK, distortion=())


def test_angles_equal_those_of_numpy() -> None:
    rays = np.random.default_rng(0).standard_normal((3, 10_000))
    axes = [[0, 0, 0, 0, 1, -1], [0, 0, 1, -1, 0, 0], [1, -1, 0, 0, 0, 0]]
    rays = np.concatenate([rays / np.linalg.norm(rays, axis=0), axes], axis=1)
    x, y, z = rays
    azimuth, elevation = find_angles(rays.astype(np.float32))
    assert np.abs(azimuth - np.arctan2(y, x)).max() < 1e-5
    assert np.abs(elevation - np.arctan2(z, np.hypot(x, y))).max() < 1e-5


@pytest.mark.parametrize(
    ("turn_rad", "column", "row"),
    [
        ((0.0, 0.0, 0.0), 0.5, 0.5),  # forward, the middle of the panorama
        ((0.0, 0.0, np.pi / 2), 0.25, 0.5),  # a quarter turn to the left
        ((0.0, np.pi / 4, 0.0), 0.5, 0.75),  # nose down
    ],
)
def test_the_camera_sees_the_right_part_of_a_panorama(
    turn_rad: tuple[float, float, float], column: float, row: float
) -> None:
    v, u = (np.mgrid[:64, :128] + 0.5) / np.array([64, 128])[:, None, None]
    panorama = Panorama(np.stack([u, v, u], axis=-1).astype(np.float32))
    view = panorama.render(CAMERA, turn_rad)
    middle = view[int(CAMERA.cy_px), int(CAMERA.cx_px)]
    assert middle[:2] == pytest.approx([column, row], abs=0.01)


def test_a_view_interpolates_between_pixels_and_around_the_seam() -> None:
    light = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    # The only pixel of this camera looks along x.
    camera = replace(CAMERA, width_px=1, height_px=1, cx_px=0.5, cy_px=0.5)
    for columns in range(-1, 15):
        # The middle of column c, counted from the seam, is at a turn of pi - 2 pi (c + 0.5) / 16.
        turn_rad = np.pi - 2 * np.pi * (columns + 1.0) / 16
        seen = Panorama(light).render(camera, (0.0, 0.0, turn_rad))[0, 0]
        around = light[3:5, [columns % 16, (columns + 1) % 16]]
        assert seen == pytest.approx(around.mean(axis=(0, 1)), abs=1e-3)
    assert np.array_equal(Panorama(light).light, light)
