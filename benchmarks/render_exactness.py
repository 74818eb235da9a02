"""Measure the accuracy of boxes in renders, and the noise of renders with few samples."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from dmrl.geometry.frames import Array, Camera, project
from dmrl.render_recording import read_render_camera, read_render_settings
from dmrl.rendering.backgrounds.panorama import Panorama
from dmrl.rendering.backgrounds.photos import open_photos
from dmrl.rendering.blender_environment import ensure_environment
from dmrl.rendering.camera.distortion import image_from_pinhole
from dmrl.rendering.camera.sensor import Sensor
from dmrl.rendering.randomise import SceneSource, draw_scene
from dmrl.rendering.renderer import Renderer, RobotModel
from dmrl.rendering.robots import crazyflie
from dmrl.rendering.shot import Shot
from dmrl.rendering.sketch_renderer import Pose
from dmrl.terminal.progress import say

MANY_SAMPLES = 512


def project_box(camera: Camera, pose: Pose, points: Array) -> Array:
    """Return left, top, right and bottom of a projected mesh, pixels, clipped to the image.

    Parameters
    ----------
    camera
        Camera.
    pose
        Pose of the robot.
    points
        (N, 3) vertices, body frame, metres.
    """
    xyz = points @ pose.camera_from_body.T + pose.xyz_camera
    uv, _ = project(xyz[xyz[:, 0] > 0.01], camera.image_from_optical)
    uv = image_from_pinhole(uv, camera)
    box = np.concatenate([uv.min(axis=0), uv.max(axis=0)])
    return np.clip(box, 0, (camera.width_px, camera.height_px) * 2)


def measure_reprojection(recipe: str, images: int) -> dict[str, float]:
    """Measure the errors of box edges in renders against the projected mesh, pixels.

    Only robots that are fully visible count.

    Parameters
    ----------
    recipe
        Name of the preset.
    images
        Number of images.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recipe.toml"
        path.write_text(f'kind = "render"\npreset = "{recipe}"\nempty_share = 0.0\n')
        settings = read_render_settings(str(path), images=images)
    camera = read_render_camera(settings)
    model = RobotModel(settings.model, settings.scale, settings.model_up)
    errors, middles = [], []
    with Renderer(ensure_environment(say), model) as renderer:
        world = SceneSource(
            settings,
            camera,
            renderer.radius_m,
            tuple(renderer.lights),
            renderer.load_panorama,
            None,
        )
        world = replace(world, panorama=build_grey_panorama)
        scenes = [draw_scene(world, k) for k in range(images)]
        shots = renderer.render_shots((camera, scene.robots, scene.look) for scene in scenes)
        for scene, shot in zip(scenes, shots, strict=True):
            for k, robot in enumerate(scene.robots):
                if shot.visible_share[k] < 1 or np.isnan(shot.box_px[k]).any():
                    continue
                turn = (robot.paint["rotor_first_rad"], robot.paint["rotor_sweep_rad"])
                points = crazyflie.outline_points(settings.scale, *turn)
                box = project_box(camera, robot.pose, points)
                errors.append(shot.box_px[k] - box)
                middles.append((shot.box_px[k] - box).reshape(2, 2).mean(axis=0))
    edges = np.array(errors)
    return {
        "robots": len(edges),
        "median_px": float(np.median(np.abs(edges))),
        "p95_px": float(np.percentile(np.abs(edges), 95)),
        **{
            f"median_{name}_px": float(value)
            for name, value in zip(
                ("left", "top", "right", "bottom"), np.median(edges, axis=0), strict=True
            )
        },
        "median_middle_px": float(np.median(np.abs(middles))),
    }


def measure_noise(recipe: str, images: int, backgrounds: Path) -> dict[str, float]:
    """Measure the noise of few light paths on robots, and that of the sensor, grey levels of 256.

    The noise is the standard deviation of the difference from an image with many paths, over pixels
    that a robot covers fully. The sensor has no noise, except for the figure of the sensor.

    Parameters
    ----------
    recipe
        Name of a recipe.
    images
        Number of images.
    backgrounds
        Folder of photos.
    """
    settings = read_render_settings(recipe, images=images, robots_max=1, empty_share=0.0)
    photos = open_photos(backgrounds)
    camera = read_render_camera(settings)
    shots: dict[str, list[Shot]] = {}
    for samples in (MANY_SAMPLES, 4, 8, 16):
        model = RobotModel(None, settings.scale)
        with Renderer(ensure_environment(say), model, workers=1, samples=samples) as renderer:
            world = SceneSource(
                settings,
                camera,
                renderer.radius_m,
                tuple(renderer.lights),
                build_grey_panorama,
                photos,
            )
            drawn = [draw_scene(world, k) for k in range(images)]
            calm = [replace(d.look, sensor=_without_noise(d.look.sensor)) for d in drawn]
            scenes = [(camera, d.robots, look) for d, look in zip(drawn, calm, strict=True)]
            shots[f"paths_{samples}"] = list(renderer.render_shots(scenes))
            if samples == MANY_SAMPLES:
                noisy = [(camera, d.robots, d.look) for d in drawn]
                shots["sensor"] = list(renderer.render_shots(noisy))
    exact = shots.pop(f"paths_{MANY_SAMPLES}")
    return {name: _measure_difference(found, exact) for name, found in shots.items()}


def build_grey_panorama(name: str) -> Panorama:
    """Return a uniform grey panorama."""
    return Panorama(np.full((8, 16, 3), 0.3, np.float32))


def _without_noise(sensor: Sensor) -> Sensor:
    """Return a sensor without noise."""
    return replace(sensor, shot_noise=0.0, read_noise=0.0)


def _measure_difference(found: list[Shot], exact: list[Shot]) -> float:
    """Return the standard deviation of the difference where a robot covers pixels fully."""
    apart = [
        (one.rgb.astype(float) - other.rgb)[(other.opacity == 255).any(axis=0)].ravel()
        for one, other in zip(found, exact, strict=True)
    ]
    return float(np.std(np.concatenate(apart)))
