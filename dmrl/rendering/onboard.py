"""What a robot's own camera sees of others: poses in the world in, poses in the camera out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from dmrl.geometry import Array, Camera, camera_from_horizontal
from dmrl.rendering.quadrotor import RADIUS_M
from dmrl.rendering.scene import random_look
from dmrl.rendering.sketch import Pose, Sketch, draw

NEAREST_M = 2 * RADIUS_M
"""Robots nearer to the image plane than this are not drawn: they would touch it."""

Renderer = Callable[[Camera, Sequence[Pose], Generator], Sketch]
"""Camera, poses and a source of randomness for everything else, to a picture with labels."""


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


def sketched(camera: Camera, poses: Sequence[Pose], rng: Generator) -> Sketch:
    """A picture drawn by code, before a background of its own."""
    return draw(camera, poses, random_look(rng, camera))
