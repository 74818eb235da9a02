"""Random poses and looks of sketches."""

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.random import Generator

from dmrl.geometry.frames import Array, Camera, camera_from_horizontal, yaw_matrix
from dmrl.images.canvas import FloatImage, Levels
from dmrl.rendering.backgrounds.photos import Photos
from dmrl.rendering.backgrounds.rooms import draw_numbered_room
from dmrl.rendering.robots.quadrotor import RADIUS_M
from dmrl.rendering.sketch_renderer import Look, Pose

DEPTH_M = (0.2, 2.0)
TILT_MAX_RAD = float(np.radians(20))
MAX_TRIES_PER_ROBOT = 30
ROOM_COUNT = 60
"""Rooms behind sketches. All of them stay in memory."""
MAX_ZOOM = 2.5


def random_poses(rng: Generator, camera: Camera, count: int) -> list[Pose]:
    """Draw at most ``count`` poses, uniform over the image, log-uniform in depth, 0.2 to 2 m.

    No robot hides the centre of another. Where there is no room for another robot, the result
    has fewer poses.

    Parameters
    ----------
    rng
        Random generator.
    camera
        Camera whose image is filled.
    count
        Requested number of robots.
    """
    tilt = camera_from_horizontal(*rng.uniform(-TILT_MAX_RAD, TILT_MAX_RAD, 2).tolist())
    return place_apart(
        count, lambda: Pose(_draw_position(rng, camera), tilt @ _draw_attitude(rng)), _are_apart
    )


def place_apart(
    count: int, draw: Callable[[], Pose], are_apart: Callable[[Array, Array], bool]
) -> list[Pose]:
    """Draw poses until a number of them are apart; fewer where there is no room.

    Parameters
    ----------
    count
        Requested number of robots.
    draw
        Draws a pose.
    are_apart
        Whether two places in the camera frame, (3,) each, may both be taken.
    """
    poses: list[Pose] = []
    for _ in range(count * MAX_TRIES_PER_ROBOT):
        if len(poses) == count:
            break
        pose = draw()
        if all(are_apart(pose.xyz_camera, other.xyz_camera) for other in poses):
            poses.append(pose)
    return poses


def _draw_position(rng: Generator, camera: Camera) -> Array:
    u_px, v_px = rng.uniform((0, 0), (camera.width_px, camera.height_px))
    depth_m = np.exp(rng.uniform(*np.log(DEPTH_M)))
    return camera.point_at(u_px, v_px, depth_m)


def _draw_attitude(rng: Generator) -> Array:
    """Draw the rotation horizontal_from_body: Rz(yaw) Ry(pitch) Rx(roll)."""
    roll, pitch = rng.uniform(-TILT_MAX_RAD, TILT_MAX_RAD, 2).tolist()
    turn = yaw_matrix(rng.uniform(-np.pi, np.pi)).T
    return np.asarray(turn @ camera_from_horizontal(roll, pitch).T)


def _are_apart(first: Array, other: Array) -> bool:
    """Return whether two robots do not touch and neither hides the other's centre."""
    slope = np.hypot(*(first[1:] / first[0] - other[1:] / other[0]))
    return bool(slope > RADIUS_M / min(first[0], other[0]))


def random_look(rng: Generator, camera: Camera) -> Look:
    """Draw background, light and sensor.

    Parameters
    ----------
    rng
        Random generator.
    camera
        Camera with the size of the image.
    """
    towards = rng.normal((0.0, 0.0, 1.5), 1.0)
    noise = random_noise(rng, camera)
    return Look(
        background=_draw_background(rng, camera),
        light_camera=towards / np.linalg.norm(towards),
        ambient=rng.uniform(0.3, 0.7),
        shine=rng.uniform(0.6, 1.6) * rng.normal(1, 0.06, 3),
        rotor_opacity=rng.uniform(0.12, 0.5),
        blade_rad=rng.uniform(0, np.pi),
        blur=rng.uniform(0, 0.9),
        vignette=rng.uniform(0, 0.5),
        gain=np.exp(rng.normal(0.1, 0.2)) * rng.normal(1, 0.05, 3),
        gamma=float(np.exp(rng.normal(0, 0.2))),
        noise_deviation=rng.uniform(0.003, 0.04),
        noise=noise,
    )


def random_noise(rng: Generator, camera: Camera) -> FloatImage:
    """Return (H, W, 3) grey white noise for an image of a camera."""
    width, height = camera.width_px, camera.height_px
    top, left = int(rng.integers(height + 1)), int(rng.integers(width + 1))
    return _noise_table(width, height)[top : top + height, left : left + width]


def _draw_background(rng: Generator, camera: Camera) -> Levels:
    """Draw a part of one of few rooms, in tones of their own: drawing a room takes long."""
    crop = _open_rooms().random_crop(rng, camera, rng.uniform(1, MAX_ZOOM))
    return crop[..., rng.permutation(3)]


@cache
def _open_rooms() -> Photos:
    return Photos(draw_numbered_room, ROOM_COUNT)


@cache
def _noise_table(width_px: int, height_px: int) -> FloatImage:
    """Return (2 H, 2 W, 3) grey white noise. Every image uses a random window of it."""
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((2 * height_px, 2 * width_px, 1), np.float32)
    return noise.repeat(3, axis=2)
