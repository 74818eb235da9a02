"""Poses in the world to poses in a robot's camera: which other robots it sees, and where."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from dmrl.geometry.frames import Array, Camera, camera_from_horizontal
from dmrl.rendering.robots.quadrotor import RADIUS_M
from dmrl.rendering.shot import Shot
from dmrl.rendering.sketch_renderer import Pose, Sketch, draw
from dmrl.rendering.sketch_scene import random_look

NEAREST_M = 2 * RADIUS_M
"""Robots nearer to the image plane than this are not drawn: they would touch it."""


@dataclass(frozen=True, slots=True)
class Body:
    """A robot in the world, which is level with z up.

    Parameters
    ----------
    xyz_world
        (3,) its centre, metres.
    yaw_rad, roll_rad, pitch_rad
        Attitude Rz(yaw) Ry(pitch) Rx(roll).
    """

    xyz_world: Array
    yaw_rad: float
    roll_rad: float
    pitch_rad: float

    @property
    def horizontal_from_world(self) -> Array:
        """(3, 3) rotation."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    @property
    def body_from_world(self) -> Array:
        """(3, 3) rotation. The camera looks along the body's x, from its centre."""
        tilt = camera_from_horizontal(self.roll_rad, self.pitch_rad)
        return np.asarray(tilt @ self.horizontal_from_world)


def pose_of(peer: Body, here: Body) -> Pose:
    """A peer as the camera of the robot ``here`` has it in front, or behind."""
    camera_from_world = here.body_from_world
    return Pose(
        camera_from_world @ (peer.xyz_world - here.xyz_world),
        camera_from_world @ peer.body_from_world.T,
    )


def in_front(pose: Pose) -> bool:
    """Whether a pose can be drawn."""
    return bool(pose.xyz_camera[0] > NEAREST_M)


@dataclass(frozen=True, slots=True)
class View:
    """What one camera has before it at one moment.

    Parameters
    ----------
    here
        The robot that carries the camera.
    poses
        By name, the peers in front.
    velocity_mps
        By name, (3,) how fast a peer moves in the camera frame, the camera's turning included.
    turning_rps
        (2,) how fast what is far away moves in the image, right and down, radians per second.
    key
        Seed of the flight, number of the camera, number of the picture.
    """

    here: Body
    poses: Mapping[str, Pose]
    velocity_mps: Mapping[str, Array]
    turning_rps: Array
    key: tuple[int, int, int]


Renderer = Callable[[Camera, Iterable[View]], Iterator[Sketch | Shot]]
"""Camera and views of one robot, to pictures with labels of the peers, in their order."""

MOMENT_S = 0.005


def view(
    bodies: Callable[[float], Mapping[str, Body]],
    robot: str,
    time_s: float,
    key: tuple[int, int, int],
) -> View:
    """What the camera of a robot has before it.

    Parameters
    ----------
    bodies
        Every robot by name at a time, seconds.
    robot
        Carries the camera.
    time_s
        Of the picture.
    key
        See `View`.
    """
    before, now, after = (bodies(time_s + step) for step in (-MOMENT_S, 0.0, MOMENT_S))
    peers = {name: pose_of(peer, now[robot]) for name, peer in now.items() if name != robot}
    poses = {name: pose for name, pose in peers.items() if in_front(pose)}
    velocity = {
        name: (
            pose_of(after[name], after[robot]).xyz_camera
            - pose_of(before[name], before[robot]).xyz_camera
        )
        / (2 * MOMENT_S)
        for name in poses
    }
    ahead = after[robot].body_from_world @ before[robot].body_from_world.T[:, 0]
    turning = -ahead[1:] / ahead[0] / (2 * MOMENT_S)
    return View(now[robot], poses, velocity, turning, key)


def sketched(camera: Camera, views: Iterable[View]) -> Iterator[Sketch]:
    """Pictures drawn by code, each before a background of its own."""
    for one in views:
        rng = np.random.default_rng(one.key)
        yield draw(camera, list(one.poses.values()), random_look(rng, camera))
