"""Conversion of poses in the world to views of a robot's camera."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from dmrl.geometry.frames import Array, Camera
from dmrl.images.canvas import Levels
from dmrl.rendering.backgrounds.rooms import draw_room
from dmrl.rendering.robots.quadrotor import RADIUS_M
from dmrl.rendering.shot import Shot
from dmrl.rendering.sketch_renderer import Look, Pose, Sketch, render_sketch
from dmrl.rendering.sketch_scene import random_look, random_noise
from dmrl.samples.flight import RobotPose

MIN_DEPTH_M = 2 * RADIUS_M
"""Minimum depth of a drawn robot, metres: nearer ones would touch the image plane."""


def relative_pose(peer: RobotPose, observer: RobotPose) -> Pose:
    """Return the pose of a peer in the camera frame of ``observer``."""
    camera_from_world = observer.body_from_world
    return Pose(
        camera_from_world @ (peer.xyz_world - observer.xyz_world),
        camera_from_world @ peer.body_from_world.T,
    )


def is_in_front(pose: Pose) -> bool:
    """Return whether a pose is far enough in front of the camera to be drawn."""
    return bool(pose.xyz_camera[0] > MIN_DEPTH_M)


@dataclass(frozen=True, slots=True)
class CameraView:
    """Poses and motion of the peers in front of one camera at one time.

    Parameters
    ----------
    here
        Robot that carries the camera.
    poses
        Peers in front of the camera, by name.
    velocity_mps
        (3,) velocities of the peers in the camera frame, by name. Includes the camera's rotation.
    turning_rps
        (2,) angular velocity of distant points in the image, right and down, radians per second.
    key
        Seed of the flight, index of the camera, index of the image.
    """

    here: RobotPose
    poses: Mapping[str, Pose]
    velocity_mps: Mapping[str, Array]
    turning_rps: Array
    key: tuple[int, int, int]


ViewRenderer = Callable[[Camera, Iterable[CameraView]], Iterator[Sketch | Shot]]
"""Function that renders the views of one robot's camera, in their order, with labels."""

DIFFERENCE_STEP_S = 0.005
"""Half the step of the central differences that give velocities, seconds."""


def build_view(
    bodies: Callable[[float], Mapping[str, RobotPose]],
    robot: str,
    time_s: float,
    key: tuple[int, int, int],
) -> CameraView:
    """Return the view of a robot's camera.

    Parameters
    ----------
    bodies
        Returns the poses of all robots by name at a time, seconds.
    robot
        Robot that carries the camera.
    time_s
        Time of the image, seconds.
    key
        See `CameraView`.
    """
    before, now, after = (
        bodies(time_s + step) for step in (-DIFFERENCE_STEP_S, 0.0, DIFFERENCE_STEP_S)
    )
    peers = {name: relative_pose(peer, now[robot]) for name, peer in now.items() if name != robot}
    poses = {name: pose for name, pose in peers.items() if is_in_front(pose)}
    velocity = {
        name: (
            relative_pose(after[name], after[robot]).xyz_camera
            - relative_pose(before[name], before[robot]).xyz_camera
        )
        / (2 * DIFFERENCE_STEP_S)
        for name in poses
    }
    ahead = after[robot].body_from_world @ before[robot].body_from_world.T[:, 0]
    turning = -ahead[1:] / ahead[0] / (2 * DIFFERENCE_STEP_S)
    return CameraView(now[robot], poses, velocity, turning, key)


def render_sketches(camera: Camera, views: Iterable[CameraView]) -> Iterator[Sketch]:
    """Yield a sketch of every view, each with its own random background."""
    for one in views:
        rng = np.random.default_rng(one.key)
        yield render_sketch(camera, list(one.poses.values()), random_look(rng, camera))


WALLS, MARGIN_SHARE = 4, 0.3
"""Backgrounds around a sketched place; and its height above and below an image, over an image's."""


class SketchedPlace:
    """Draw the images of one flight: one place, light and sensor for all of them.

    Parameters
    ----------
    seed
        Seed of the flight.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._draw = cache(self._draw_place)

    def __call__(self, camera: Camera, views: Iterable[CameraView]) -> Iterator[Sketch]:
        """Yield a sketch of every view of one robot, in their order."""
        walls, look = self._draw(camera)
        for one in views:
            rng = np.random.default_rng(one.key)
            seen = replace(
                look,
                background=_crop_walls(walls, camera, one.here),
                light_camera=one.here.body_from_world @ look.light_camera,
                blade_rad=rng.uniform(0, np.pi),
                noise=random_noise(rng, camera),
            )
            yield render_sketch(camera, list(one.poses.values()), seen)

    def _draw_place(self, camera: Camera) -> tuple[Levels, Look]:
        """Return the walls all around, and the light and the sensor of the place."""
        rng = np.random.default_rng((self._seed, 3))
        around_px = round(2 * np.pi * camera.fx_px / WALLS)
        high_px = camera.height_px + 2 * round(MARGIN_SHARE * camera.height_px)
        walls = [draw_room(rng, around_px, high_px) for _ in range(WALLS)]
        again = -(-camera.width_px // around_px)
        return np.concatenate(walls + walls[:again], axis=1), random_look(rng, camera)


def _crop_walls(walls: Levels, camera: Camera, here: RobotPose) -> Levels:
    """Return the part of the walls that a robot sees: its columns by yaw, its rows by pitch."""
    around_px = WALLS * round(2 * np.pi * camera.fx_px / WALLS)
    left = round(-here.yaw_rad * camera.fx_px) % around_px
    spare = len(walls) - camera.height_px
    top = min(max(round(spare / 2 + here.pitch_rad * camera.fy_px), 0), spare)
    return walls[top : top + camera.height_px, left : left + camera.width_px]
