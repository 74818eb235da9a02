"""Preview of the robot model from four sides, with its axes and its box."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dmrl.geometry.frames import Array, Camera, project
from dmrl.plots import Side, plot_model_sides
from dmrl.rendering.camera.sensor import Sensor
from dmrl.rendering.randomise import random_paint
from dmrl.rendering.renderer import Renderer
from dmrl.rendering.robots.primitives import RobotDesign
from dmrl.rendering.robots.robot_models import DESIGNS
from dmrl.rendering.settings import Settings
from dmrl.rendering.shot import Light, Look, Robot
from dmrl.rendering.sketch_renderer import Pose

SIDE_PX = 480
DISTANCE_RADII = 12.0
"""Distance of the camera, in radii of the robot. A large distance avoids strong perspective."""
FILL_SHARE = 0.68
"""Share of the image that the robot's ball fills. The rest leaves room for the axes."""
AXIS_LENGTH = 1.1
"""Length of the axes, in halves of the box's longest side."""
WALL_GREY = 0.5
SIDES = (
    ("from the front, its left and above", (1.6, 1.1, 1.0), (0.0, 0.0, 1.0)),
    ("from its left", (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    ("from the front", (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    ("from above", (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
)
"""Name of each view, position of the camera, and the direction that is up; body frame."""
BOX_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b).bit_count() == 1]
"""Pairs of box corners joined by an edge. Corner k has the bits of x, y and z."""


@dataclass(frozen=True, slots=True)
class Preview:
    """Preview of a robot before rendering.

    Parameters
    ----------
    png
        Image from all `SIDES`, with axes, box and size.
    size_m
        Size of its box along x, y and z, metres.
    px_wide_at_1_m
        Width in the image at 1 m from the camera, pixels.
    """

    png: bytes
    size_m: tuple[float, float, float]
    px_wide_at_1_m: float


def render_preview(renderer: Renderer, settings: Settings, camera: Camera) -> Preview:
    """Render the settings' robot from all sides, and compute its size.

    Parameters
    ----------
    renderer
        Renderer with that robot.
    settings
        Settings of the images.
    camera
        Camera of the images.
    """
    words = f"{settings.design}, scale {settings.scale:g}"
    if settings.model is not None:
        words = f"{settings.model.name}, scale {settings.scale:g}, model_up {settings.model_up}"
    x_m, y_m, z_m = np.ptp(renderer.box, axis=0).tolist()
    sides = list(render_sides(renderer, DESIGNS[settings.design]))
    png = plot_model_sides(sides, words, (x_m, y_m, z_m))
    return Preview(png, (x_m, y_m, z_m), camera.fx_px * y_m)


def render_sides(renderer: Renderer, design: RobotDesign) -> Iterator[Side]:
    """Render the robot from four sides.

    Parameters
    ----------
    renderer
        Renderer with the model.
    design
        Design that provides the paint.
    """
    box = renderer.box
    middle, radius_m = box.mean(axis=0), float(np.linalg.norm(box[1] - box[0])) / 2
    focal_px = FILL_SHARE * SIDE_PX / 2 * DISTANCE_RADII
    camera = Camera(SIDE_PX, SIDE_PX, focal_px, focal_px, SIDE_PX / 2, SIDE_PX / 2)
    poses = [_look_at_pose(side, up, middle, DISTANCE_RADII * radius_m) for _, side, up in SIDES]
    corners = np.array([[box[k >> axis & 1, axis] for axis in range(3)] for k in range(8)])
    edges = np.array([corners[list(pair)] for pair in BOX_EDGES])
    length_m = AXIS_LENGTH * float((box[1] - box[0]).max()) / 2
    axes = np.stack([np.zeros((3, 3)), length_m * np.eye(3)], axis=1)
    paint = random_paint(np.random.default_rng(0), design, wear=0.0, spread=0.0)
    paint |= {"rotor_first_rad": 0.6, "rotor_sweep_rad": 0.0}
    look = _neutral_look(renderer.lights[0])
    shots = renderer.render_shots((camera, [Robot(pose, paint)], look) for pose in poses)
    for (name, *_), pose, shot in zip(SIDES, poses, shots, strict=True):
        places = (_project_to_pixels(one, pose, camera) for one in (axes, edges))
        yield Side(name, shot.rgb, *places)


def _look_at_pose(
    towards: tuple[float, float, float],
    upright: tuple[float, float, float],
    middle: Array,
    distance_m: float,
) -> Pose:
    """Return the robot's pose for a camera that points at the middle of its box."""
    forward = -np.array(towards) / np.linalg.norm(towards)
    left = np.cross(upright, forward)
    left /= np.linalg.norm(left)
    camera_from_body = np.array([forward, left, np.cross(forward, left)])
    return Pose(np.array([distance_m, 0.0, 0.0]) - camera_from_body @ middle, camera_from_body)


def _project_to_pixels(points: Array, pose: Pose, camera: Camera) -> Array:
    """Project (..., 3) points of the body to (..., 2) pixels."""
    xyz = points.reshape(-1, 3) @ pose.camera_from_body.T + pose.xyz_camera
    uv, _ = project(xyz, camera.image_from_optical)
    return np.asarray(uv.reshape(*points.shape[:-1], 2))


def _neutral_look(light: str) -> Look:
    """Return a fixed look: a grey wall, and a lamp above the camera's shoulder."""
    backdrop = np.full((SIDE_PX, SIDE_PX, 3), WALL_GREY, np.float32)
    sun = np.array([-1.0, 0.5, 1.0]) / 1.5
    shine = Light(light, (0.0, 0.0, 0.0), 0.5, sun, 2.0, (1.0, 1.0, 1.0), 0.1)
    return Look(backdrop, shine, Sensor(brightness=None))
