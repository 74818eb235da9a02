"""Rendered shots: scene description, requests to a worker, and the image with exact labels.

The only randomness here is the sensor's noise, which depends on the look's seed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.frames import Array, Camera, project
from dmrl.rendering.camera.distortion import FloatImage, PinholeCanvas, pinhole_canvas
from dmrl.rendering.camera.sensor import Sensor
from dmrl.rendering.sketch_renderer import Pose

Region = tuple[slice, slice]
"""Rows and columns of an image."""
CROP_MARGIN_PX = 1
MIN_DEPTH_M = 0.01


@dataclass(frozen=True, slots=True)
class Light:
    """Light on the robots.

    Parameters
    ----------
    name
        Panorama: a file that the renderer was started with.
    turn_rad
        Roll and pitch of the camera, and the panorama's rotation about the vertical.
    strength
        Strength of the panorama, 1 for its photographed light.
    sun_camera
        (3,) unit vector towards the sun or lamp, camera frame.
    sun_strength
        Watts per square metre.
    sun_colour
        Red, green, blue.
    sun_angle_rad
        Apparent size. A large sun casts soft shadows.
    sun_shadow
        Whether parts of a robot cast shadows from the sun.
    """

    name: str
    turn_rad: tuple[float, float, float]
    strength: float
    sun_camera: Array
    sun_strength: float
    sun_colour: tuple[float, float, float]
    sun_angle_rad: float
    sun_shadow: bool = True


@dataclass(frozen=True, slots=True)
class Robot:
    """Robot in front of the camera.

    Parameters
    ----------
    pose
        Pose at the middle of the exposure.
    paint
        Properties of its materials, as read by the worker's shaders.
    move_camera_m
        (3,) displacement in the camera frame during the exposure, metres.
    make
        Prefix of its name, before the number.
    """

    pose: Pose
    paint: Mapping[str, Any] = field(default_factory=dict)
    move_camera_m: Array = field(default_factory=lambda: np.zeros(3))
    make: str = "cf"


@dataclass(frozen=True, slots=True)
class Look:
    """Appearance of a scene: everything that changes pixels but no label.

    Parameters
    ----------
    backdrop
        (H, W, 3) linear light behind the robots.
    light
        Light on the robots.
    sensor
        Response of the camera.
    robot_gain
        Light of the robots relative to the backdrop.
    robot_blur_px
        Blur of the robots alone, a standard deviation, pixels.
    seed
        Seed of the renderer's and the sensor's noise.
    """

    backdrop: FloatImage
    light: Light
    sensor: Sensor
    robot_gain: float = 1.0
    robot_blur_px: float = 0.0
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Shot:
    """Image with exact labels. Arrays follow the order of the robots.

    Parameters
    ----------
    rgb
        (H, W, 3) uint8.
    uv_px
        (N, 2) pixels of the robots' centres, distorted. NaN where the lens cannot project them.
    depth_m
        (N,) distance of the centres along camera x.
    box_px
        (N, 4) left, top, right, bottom of the visible part. NaN where nothing is visible.
    visible_share
        (N,) share of a robot's opacity in the image that no nearer robot hides.
    opacity
        (N, H, W) uint8, visible opacity of each robot, without blur.
    surface_m
        (H, W) distance of the nearest surface along camera x, 0 where there is no robot.
    """

    rgb: NDArray[np.uint8]
    uv_px: Array
    depth_m: Array
    box_px: Array
    visible_share: Array
    opacity: NDArray[np.uint8]
    surface_m: FloatImage


@dataclass(frozen=True, slots=True)
class Layer:
    """One robot rendered alone: premultiplied light, opacity and depth of a crop of the canvas."""

    left_px: int
    top_px: int
    light: FloatImage
    depth_m: FloatImage

    @property
    def part(self) -> Region:
        """Rows and columns of the canvas that the layer covers."""
        height, width = self.depth_m.shape
        return np.s_[self.top_px : self.top_px + height, self.left_px : self.left_px + width]


def find_crop(canvas: PinholeCanvas, pose: Pose, points: Array) -> tuple[int, int, int, int] | None:
    """Return left, top, right, bottom of the canvas region that can show a robot, or None.

    Parameters
    ----------
    canvas
        Canvas of the camera.
    pose
        Pose of the robot.
    points
        (N, 3) points whose convex hull contains the robot, body frame.
    """
    limit = np.array([canvas.pinhole.width_px, canvas.pinhole.height_px])
    xyz = points @ pose.camera_from_body.T + pose.xyz_camera
    if (xyz[:, 0] < MIN_DEPTH_M).all():
        return None
    if (xyz[:, 0] < MIN_DEPTH_M).any():
        return 0, 0, int(limit[0]), int(limit[1])
    uv, _ = project(xyz, canvas.pinhole.image_from_optical)
    low = np.clip(np.floor(uv.min(axis=0)) - CROP_MARGIN_PX, 0, limit).astype(int)
    high = np.clip(np.ceil(uv.max(axis=0)) + CROP_MARGIN_PX, 0, limit).astype(int)
    if (low >= high).any():
        return None
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def build_request(
    canvas: PinholeCanvas, crop: tuple[int, int, int, int], robot: Robot, look: Look, number: int
) -> dict[str, Any]:
    """Build a worker's request for one robot."""
    camera = canvas.pinhole
    light = look.light
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = robot.pose.camera_from_body, robot.pose.xyz_camera
    return {
        "size_px": (camera.width_px, camera.height_px),
        "intrinsics_px": (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px),
        "crop_px": crop,
        "camera_from_body": matrix.tolist(),
        "paint": dict(robot.paint),
        "seed": (look.seed + number) % 2**31,
        "light": light.name,
        "light_turn_rad": light.turn_rad,
        "light_strength": light.strength,
        "sun_strength": light.sun_strength,
        "sun_colour": light.sun_colour,
        "sun_angle_rad": light.sun_angle_rad,
        "sun_shadow": light.sun_shadow,
        "sun_matrix": _rotation_towards(light.sun_camera).tolist(),
    }


def _rotation_towards(towards: Array) -> Array:
    """Return a (4, 4) rotation whose z axis points towards ``towards``."""
    aside = np.cross(towards, (0.0, 0.0, 1.0) if abs(towards[2]) < 0.9 else (1.0, 0.0, 0.0))
    aside /= np.linalg.norm(aside)
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack([aside, np.cross(towards, aside), towards])
    return matrix


def build_requests(
    camera: Camera, robots: Sequence[Robot], look: Look, points: Array
) -> list[tuple[int, dict[str, Any]]]:
    """Build the requests for all robots that can be visible, with their indices.

    Parameters
    ----------
    camera, robots, look
        The scene.
    points
        (N, 3) points whose convex hull contains a robot, body frame.
    """
    canvas = pinhole_canvas(camera)
    crops = [find_crop(canvas, robot.pose, points) for robot in robots]
    return [
        (k, build_request(canvas, crop, robots[k], look, k))
        for k, crop in enumerate(crops)
        if crop is not None
    ]
