"""Random appearance of robots and scenes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl.geometry.frames import PUBLISHED_RENDER, Camera, project
from dmrl.images.codec import encode_png
from dmrl.rendering.backgrounds.panorama import Panorama
from dmrl.rendering.backgrounds.photos import open_photos
from dmrl.rendering.camera.sensor import expose
from dmrl.rendering.randomise import SceneSource, draw_scene, random_two_colours
from dmrl.rendering.robots.crazyflie import CRAZYFLIE
from dmrl.rendering.settings import PRESETS, Settings

SMALL = Camera(40, 28, 15.0, 15.0, 20.0, 14.0)
"""PUBLISHED_RENDER with every length an eighth, so that many scenes take the time of one."""


def test_two_strong_hues_colour_all_non_emissive_parts() -> None:
    paint = random_two_colours(np.random.default_rng(3), CRAZYFLIE)
    dull = {
        f"colour_{k}" for k, name in enumerate(CRAZYFLIE.materials) if not CRAZYFLIE.paint[name][3]
    }
    assert paint.keys() == dull
    hues = {tuple(np.round(np.array(c) / max(c), 6)) for c in paint.values() if max(c) < 1}
    assert len(hues) == 2


def test_two_robots_have_different_colours() -> None:
    rng = np.random.default_rng(3)
    assert random_two_colours(rng, CRAZYFLIE) != random_two_colours(rng, CRAZYFLIE)


def build_source(
    settings: Settings, folder: Path, camera: Camera = PUBLISHED_RENDER
) -> SceneSource:
    """Return a source of scenes with a uniform panorama and one photo of a single colour."""
    photo = np.full((224, 320, 3), (200, 100, 50), np.uint8)
    (folder / "photo.png").write_bytes(encode_png(photo))
    return SceneSource(
        settings,
        camera,
        0.1,
        ("sky",),
        lambda _: Panorama(np.ones((8, 16, 3), np.float32)),
        open_photos(folder),
    )


def test_pasted_robots_leave_the_photo_unchanged(tmp_path: Path) -> None:
    keys: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in PRESETS["published"].items()
    }
    settings = Settings(**keys)
    scene = draw_scene(build_source(settings, tmp_path), 0)
    rgb = expose(scene.look.backdrop, scene.look.sensor, np.random.default_rng(0))
    # The sensor approximates the curve of sRGB by a power of 2.2.
    assert np.abs(rgb.astype(int) - (200, 100, 50)).max() <= 4
    assert scene.look.robot_gain == 1
    assert scene.look.light.sun_camera.tolist() == [-1, 0, 0]
    assert not scene.look.light.sun_shadow


def test_without_photos_nothing_is_pasted(tmp_path: Path) -> None:
    bright = Panorama(np.full((8, 16, 3), 5, np.float32))
    scenes = replace(
        build_source(Settings(pasted=True), tmp_path), photos=None, panorama=lambda _: bright
    )
    look = draw_scene(scenes, 0).look
    assert look.sensor.brightness is not None
    assert look.light.sun_shadow


@pytest.mark.heavy
def test_colours_of_a_photo_are_exchanged(tmp_path: Path) -> None:
    scenes = build_source(Settings(recoloured_share=1.0, pasted=True), tmp_path)
    seen = {tuple(draw_scene(scenes, k).look.backdrop[0, 0].argsort()) for k in range(40)}
    assert len(seen) == 6


@pytest.mark.heavy
def test_robots_stay_in_the_configured_part_of_the_image(tmp_path: Path) -> None:
    settings = Settings(place_u=(0.25, 0.5), place_v=(0.5, 1.0), empty_share=0.0)
    scenes = build_source(settings, tmp_path, SMALL)
    robots = [draw_scene(scenes, k).robots[0] for k in range(200)]
    xyz = np.array([robot.pose.xyz_camera for robot in robots])
    u, v = project(xyz, SMALL.image_from_optical)[0].T
    assert [u.min(), u.max(), v.min(), v.max()] == pytest.approx([10, 20, 14, 28], abs=0.375)


@pytest.mark.parametrize(("order", "level"), [("zyx", 1), ("xzy", 0)])
@pytest.mark.heavy
def test_robots_turn_about_their_axes_in_the_configured_order(
    tmp_path: Path, order: Any, level: int
) -> None:
    """With zyx robots tilt equally in all directions; with xzy they tilt less ahead.

    In xzy the roll is about the horizontal x axis, so it always tilts sideways.
    """
    settings = Settings(robot_turns=order, camera_tilt_max_deg=0, empty_share=0.0)
    scenes = build_source(settings, tmp_path, SMALL)
    robots = [draw_scene(scenes, k).robots[0] for k in range(300)]
    up = np.array([robot.pose.camera_from_body[:, 2] for robot in robots])
    ahead, aside = up[:, 0].std(), up[:, 1].std()
    assert ahead / aside == pytest.approx((0.57, 1.0)[level], abs=0.12)


@pytest.mark.heavy
def test_depths_are_spaced_logarithmically_or_linearly(tmp_path: Path) -> None:
    shares = []
    for spacing in ("log", "linear"):
        settings = Settings(depth_spacing=spacing, depth_m=(0.2, 2.0), empty_share=0.0)
        scenes = build_source(settings, tmp_path, SMALL)
        robots = [draw_scene(scenes, k).robots[0] for k in range(300)]
        depths = np.array([robot.pose.xyz_camera[0] for robot in robots])
        shares.append(np.mean(depths < 1.1))
    assert shares == pytest.approx([np.log(5.5) / np.log(10), 0.5], abs=0.08)
