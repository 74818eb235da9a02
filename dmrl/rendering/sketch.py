"""Pictures of small quadrotors, drawn by code in milliseconds: poses in, pixels out.

For demonstrations and tests, where labels must be exact and nothing can be downloaded. The
same camera, poses and look give the same picture; ``scene`` draws them at random.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.frames import Array, Camera, project
from dmrl.images.canvas import Canvas, Picture, bands
from dmrl.rendering import quadrotor

SEEN = 1 / 255
"""Opacity from which a pixel counts as covered by a robot."""
BRIGHTEST = 2.0
"""Of a robot in strong light."""
GAMMA_STEPS = 4095
"""Of the light that a sensor tells apart: fine enough for 255 levels at any gamma."""
SMALLEST_FACE_PX2 = 0.1
"""Faces that cover less of a pixel are not drawn: far robots have many."""


@dataclass(frozen=True, slots=True)
class Pose:
    """Where a robot is in front of the camera.

    Parameters
    ----------
    xyz_camera
        (3,) centre, camera frame, metres.
    camera_from_body
        (3, 3) rotation.
    """

    xyz_camera: Array
    camera_from_body: Array


@dataclass(frozen=True, slots=True)
class Look:
    """Everything that changes pixels and no label.

    Parameters
    ----------
    background
        (H, W, 3) what is behind the robots, 0 to 1.
    light_camera
        (3,) unit vector to the light, camera frame.
    ambient
        Light from everywhere, 0 to 1; the rest comes from the light.
    shine
        (3,) colour of the light on the robots.
    rotor_opacity
        Of what the rotors sweep.
    blade_rad
        How far the rotors have turned.
    blur
        0: sharp; 1: every pixel the mean of a 3x3 neighbourhood.
    vignette
        Light lost in the corners, 0 to 1.
    gain
        (3,) exposure and white balance.
    gamma
        Over 1 darkens the middle tones.
    noise
        (H, W, 1) or (H, W, 3), added last.
    """

    background: Picture
    light_camera: Array
    ambient: float
    shine: Array
    rotor_opacity: float
    blade_rad: float
    blur: float
    vignette: float
    gain: Array
    gamma: float
    noise: Picture


@dataclass(frozen=True, slots=True)
class Sketch:
    """A picture and its exact labels.

    Parameters
    ----------
    rgb
        (H, W, 3) uint8.
    uv_px
        (N, 2) pixels of the robots' centres, pixel-edge coordinates.
    depth_m
        (N,) distance of the centres along camera x.
    box_px
        (N, 4) left, top, right, bottom of the visible part; NaN where nothing is visible.
    visible_share
        (N,) share of a robot's pixels in the image that no nearer robot hides.
    """

    rgb: NDArray[np.uint8]
    uv_px: Array
    depth_m: Array
    box_px: Array
    visible_share: Array


def draw(camera: Camera, poses: Sequence[Pose], look: Look) -> Sketch:
    """The picture of robots in front of a camera, with its labels.

    Parameters
    ----------
    camera
        Without distortion.
    poses
        One per robot, in any order.
    look
        Background, light and sensor.

    Raises
    ------
    ValueError
        If the camera has distortion, or a robot is not wholly in front of it.
    """
    if any(camera.distortion):
        raise ValueError("sketches are drawn without distortion; give a camera without")
    xyz = np.array([pose.xyz_camera for pose in poses]).reshape(-1, 3)
    uv_px, depth_m = project(xyz, camera.image_from_optical)
    picture = look.background.copy()
    clear = np.ones((camera.height_px, camera.width_px), np.float32)
    box_px, share = np.full((len(poses), 4), np.nan), np.zeros(len(poses))
    drawn = []
    for k in np.argsort(depth_m, kind="stable"):  # near first, each hides what follows
        if (canvas := _robot(camera, poses[k], look)) is not None:
            opacity = canvas.opacity()
            box_px[k], share[k] = _visible(canvas, opacity[..., 0], clear[canvas.part])
            clear[canvas.part] *= 1 - opacity[..., 0]
            drawn.append((canvas, opacity))
    for canvas, opacity in reversed(drawn):
        picture[canvas.part] *= 1 - opacity
        picture[canvas.part] += canvas.rgb()
    return Sketch(_sensor(picture, look), uv_px, depth_m, box_px, share)


def _visible(canvas: Canvas, opacity: Picture, clear: Picture) -> tuple[Array, float]:
    """Box and share of what is seen of a robot behind others."""
    rows, cols = np.nonzero(opacity * clear >= SEEN)
    if not rows.size:
        return np.full(4, np.nan), 0.0
    corner = np.array([canvas.left_px, canvas.top_px] * 2, float)
    box = np.array([cols.min(), rows.min(), cols.max() + 1, rows.max() + 1], float)
    return corner + box, float((opacity * clear).sum() / opacity.sum())


@dataclass(frozen=True, slots=True)
class _Outlines:
    """Flat parts of one kind: pixels (F, K, 2), distance (F,), colours (F, 3), opacity."""

    uv_px: Array
    distance_m: Array
    colours: Array
    opacity: float


def _outlines(
    camera: Camera, pose: Pose, corners_body: Array, colours: Array, opacity: float
) -> _Outlines:
    corners = corners_body @ pose.camera_from_body.T + pose.xyz_camera
    uv, _ = project(corners.reshape(-1, 3), camera.image_from_optical)
    distance = np.linalg.norm(corners.mean(axis=1), axis=1)
    return _Outlines(uv.reshape(*corners.shape[:2], 2), distance, colours, opacity)


def _robot(camera: Camera, pose: Pose, look: Look) -> Canvas | None:
    """One robot alone, on a canvas just large enough; None if it is not in the image."""
    dark = np.tile(0.08 * look.shine, (4, 1))
    blades = quadrotor.blades(look.blade_rad)
    groups = (
        _body(camera, pose, look),
        _outlines(camera, pose, quadrotor.DISCS, dark, look.rotor_opacity),
        _outlines(camera, pose, blades, dark, 0.8),
    )
    uv = np.concatenate([group.uv_px.reshape(-1, 2) for group in groups])
    limit = (camera.width_px, camera.height_px)
    left, top = np.clip(np.floor(uv.min(axis=0)), 0, limit).astype(int).tolist()
    right, bottom = np.clip(np.ceil(uv.max(axis=0)), 0, limit).astype(int).tolist()
    if left >= right or top >= bottom:
        return None
    canvas = Canvas(left, top, right - left, bottom - top, brightest=BRIGHTEST)
    outlines = [
        one for part in groups for one in canvas.outlines(part.uv_px, part.colours, part.opacity)
    ]
    distance_m = np.concatenate([part.distance_m for part in groups])
    for k in np.argsort(-distance_m, kind="stable").tolist():
        canvas.draw(outlines[k])
    return canvas


def _body(camera: Camera, pose: Pose, look: Look) -> _Outlines:
    """Faces of the body that are turned to the camera and large enough to see, lit."""
    mesh = quadrotor.MESH
    lit = np.maximum(mesh.normals @ pose.camera_from_body.T @ look.light_camera, 0)
    lit = look.shine * (look.ambient + (1 - look.ambient) * lit)[:, None]
    colours = mesh.colours * np.where(mesh.glows[:, None], 1.0, lit)
    faces = _outlines(camera, pose, mesh.corners, colours, 1.0)
    across = faces.uv_px[:, 2:] - faces.uv_px[:, :2]  # the two diagonals of each face
    # Corners run the other way round in the image when a face is seen from inside.
    area_px2 = (across[:, 0, 1] * across[:, 1, 0] - across[:, 0, 0] * across[:, 1, 1]) / 2
    seen = area_px2 >= SMALLEST_FACE_PX2
    return _Outlines(faces.uv_px[seen], faces.distance_m[seen], colours[seen], 1.0)


def _sensor(picture: Picture, look: Look) -> NDArray[np.uint8]:
    """What a small camera makes of the light that reaches it, (H, W, 3) uint8."""
    height, width, _ = picture.shape
    # Rows of numbers, not of pixels: NumPy is slow at arrays that end in a side of 3.
    v = np.linspace(-1, 1, height, dtype=np.float32)[:, None] ** 2
    u = np.linspace(-1, 1, width, dtype=np.float32).repeat(3) ** 2
    dim = np.float32(look.vignette / 2)
    gain = np.tile(GAMMA_STEPS * look.gain, width).astype(np.float32)
    noise = look.noise.reshape(height, -1)
    curve = np.linspace(0, 1, GAMMA_STEPS + 1, dtype=np.float32) ** np.float32(look.gamma)
    curve = 255 * curve + np.float32(0.5)
    out = np.empty((height, 3 * width), np.uint8)
    for rows in bands(height):
        band = picture[rows].reshape(-1, 3 * width)
        if look.blur > 0:
            mean = _mean_of_9(picture, rows).reshape(band.shape)
            band = band + np.float32(look.blur) * (mean - band)
        band = band * gain * (1 - dim * (u + v[rows]))
        np.clip(band, 0, GAMMA_STEPS, out=band)
        band = curve[band.astype(np.uint16)]
        band += np.float32(255) * noise[rows].repeat(3 * width // noise.shape[1], axis=1)
        out[rows] = np.clip(band, 0, 255, out=band)
    return out.reshape(picture.shape)


def _mean_of_9(picture: Picture, rows: slice) -> Picture:
    """Every pixel of some rows the mean of the 3 x 3 around it; the border is repeated beyond."""
    near = np.clip(np.arange(rows.start - 1, rows.stop + 1), 0, len(picture) - 1)
    band = picture.take(near, axis=0)
    band = band[:-2] + band[1:-1] + band[2:]
    band = np.concatenate([band[:, :1], band, band[:, -1:]], axis=1)
    return np.asarray((band[:, :-2] + band[:, 1:-1] + band[:, 2:]) * np.float32(1 / 9))
