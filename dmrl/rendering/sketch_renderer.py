"""Fast sketches of small quadrotors, without Blender: poses in, images out, in milliseconds.

Used for demonstrations and tests, which need exact labels and no downloads. The same camera,
poses and look give the same image. ``sketch_scene`` draws them at random.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.frames import Array, Camera, project
from dmrl.images.canvas import Canvas, FloatImage, Levels, iter_bands
from dmrl.rendering.robots import quadrotor

MIN_COVERED_OPACITY = 1 / 255
"""Opacity from which a pixel counts as covered by a robot."""
MAX_BRIGHTNESS = 2.0
"""Maximum brightness of a robot in strong light."""
CURVE_STEPS = 255 * 16 + 1
"""Input levels of the gamma curve. Fine enough for 255 output levels at any gamma."""
MIN_FACE_PX2 = 0.1
"""Minimum area of a drawn face, square pixels. Distant robots have many smaller ones."""


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of a robot in the camera frame.

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
    """Appearance of a sketch: everything that changes pixels but no label.

    Parameters
    ----------
    background
        (H, W, 3) uint8, background of the robots.
    light_camera
        (3,) unit vector to the light, camera frame.
    ambient
        Share of ambient light, 0 to 1. The rest comes from the light.
    shine
        (3,) colour of the light on the robots.
    rotor_opacity
        Opacity of the discs that the rotors sweep.
    blade_rad
        Angle of the rotors.
    blur
        0: sharp. 1: every pixel is the mean of a 3x3 neighbourhood.
    vignette
        Light lost in the corners, 0 to 1.
    gain
        (3,) exposure and white balance.
    gamma
        Above 1, middle tones become darker.
    noise_deviation
        Standard deviation of the noise, relative to the brightest level.
    noise
        (H, W, 3) noise of standard deviation 1, added last.
    """

    background: Levels
    light_camera: Array
    ambient: float
    shine: Array
    rotor_opacity: float
    blade_rad: float
    blur: float
    vignette: float
    gain: Array
    gamma: float
    noise_deviation: float
    noise: FloatImage


@dataclass(frozen=True, slots=True)
class Sketch:
    """Image with exact labels.

    Parameters
    ----------
    rgb
        (H, W, 3) uint8.
    uv_px
        (N, 2) pixels of the robots' centres, pixel-edge coordinates.
    depth_m
        (N,) distance of the centres along camera x.
    box_px
        (N, 4) left, top, right, bottom of the visible part. NaN where nothing is visible.
    visible_share
        (N,) share of a robot's pixels in the image that no nearer robot hides.
    """

    rgb: NDArray[np.uint8]
    uv_px: Array
    depth_m: Array
    box_px: Array
    visible_share: Array


def render_sketch(camera: Camera, poses: Sequence[Pose], look: Look) -> Sketch:
    """Draw robots in front of a camera, and return the image with its labels.

    Parameters
    ----------
    camera
        Camera without distortion.
    poses
        One per robot, in any order.
    look
        Background, light and sensor.

    Raises
    ------
    ValueError
        If the camera has distortion, or a robot is not entirely in front of it.
    """
    if any(camera.distortion):
        raise ValueError("sketches have no distortion. Pass a camera without distortion")
    xyz = np.array([pose.xyz_camera for pose in poses]).reshape(-1, 3)
    uv_px, depth_m = project(xyz, camera.image_from_optical)
    levels = look.background.copy()
    clear = np.ones((camera.height_px, camera.width_px), np.float32)
    box_px, share = np.full((len(poses), 4), np.nan), np.zeros(len(poses))
    drawn = []
    for k in np.argsort(depth_m, kind="stable"):  # near first, each hides what follows
        if (canvas := _draw_robot(camera, poses[k], look)) is not None:
            opacity = canvas.to_opacity()
            box_px[k], share[k] = _visible_box(canvas, opacity[..., 0], clear[canvas.part])
            clear[canvas.part] *= 1 - opacity[..., 0]
            drawn.append((canvas, opacity))
    for canvas, opacity in reversed(drawn):
        light = levels[canvas.part] * (1 - opacity) + 255 * canvas.to_rgb()
        levels[canvas.part] = np.minimum(light + np.float32(0.5), 255)
    return Sketch(_apply_sensor(levels, look), uv_px, depth_m, box_px, share)


def _visible_box(canvas: Canvas, opacity: FloatImage, clear: FloatImage) -> tuple[Array, float]:
    """Return the bounding box and the share of a robot's visible part."""
    rows, cols = np.nonzero(opacity * clear >= MIN_COVERED_OPACITY)
    if not rows.size:
        return np.full(4, np.nan), 0.0
    corner = np.array([canvas.left_px, canvas.top_px] * 2, float)
    box = np.array([cols.min(), rows.min(), cols.max() + 1, rows.max() + 1], float)
    return corner + box, float((opacity * clear).sum() / opacity.sum())


@dataclass(frozen=True, slots=True)
class _Polygons:
    """Projected polygons of one kind: pixels (F, K, 2), distance (F,), colours (F, 3), opacity."""

    uv_px: Array
    distance_m: Array
    colours: Array
    opacity: float


def _project_polygons(
    camera: Camera, pose: Pose, corners_body: Array, colours: Array, opacity: float
) -> _Polygons:
    corners = corners_body @ pose.camera_from_body.T + pose.xyz_camera
    uv, _ = project(corners.reshape(-1, 3), camera.image_from_optical)
    distance = np.linalg.norm(corners.mean(axis=1), axis=1)
    # The last bits depend on the processor, and would decide between faces at one distance.
    uv, distance = uv.round(6), distance.round(9)
    return _Polygons(uv.reshape(*corners.shape[:2], 2), distance, colours, opacity)


def _draw_robot(camera: Camera, pose: Pose, look: Look) -> Canvas | None:
    """Draw one robot on a canvas of minimal size, or return None if it is outside the image."""
    dark = np.tile(0.08 * look.shine, (4, 1))
    blades = quadrotor.blade_outlines(look.blade_rad)
    groups = (
        _project_body(camera, pose, look),
        _project_polygons(camera, pose, quadrotor.ROTOR_DISCS, dark, look.rotor_opacity),
        _project_polygons(camera, pose, blades, dark, 0.8),
    )
    uv = np.concatenate([group.uv_px.reshape(-1, 2) for group in groups])
    limit = (camera.width_px, camera.height_px)
    left, top = np.clip(np.floor(uv.min(axis=0)), 0, limit).astype(int).tolist()
    right, bottom = np.clip(np.ceil(uv.max(axis=0)), 0, limit).astype(int).tolist()
    if left >= right or top >= bottom:
        return None
    canvas = Canvas(left, top, right - left, bottom - top, brightest=MAX_BRIGHTNESS)
    drawn = (canvas.make_outlines(p.uv_px, p.colours, p.opacity) for p in groups)
    outlines = [outline for part in drawn for outline in part]
    distance_m = np.concatenate([part.distance_m for part in groups])
    for k in np.argsort(-distance_m, kind="stable").tolist():
        canvas.draw_outline(outlines[k])
    return canvas


def _project_body(camera: Camera, pose: Pose, look: Look) -> _Polygons:
    """Project and light the body's faces that point to the camera and are large enough."""
    mesh = quadrotor.MESH
    lit = np.maximum(mesh.normals @ pose.camera_from_body.T @ look.light_camera, 0)
    lit = look.shine * (look.ambient + (1 - look.ambient) * lit)[:, None]
    colours = mesh.colours * np.where(mesh.glows[:, None], 1.0, lit)
    faces = _project_polygons(camera, pose, mesh.corners, colours, 1.0)
    across = faces.uv_px[:, 2:] - faces.uv_px[:, :2]  # the two diagonals of each face
    # The corners' order in the image is reversed for faces that point away from the camera.
    area_px2 = (across[:, 0, 1] * across[:, 1, 0] - across[:, 0, 0] * across[:, 1, 1]) / 2
    seen = area_px2 >= MIN_FACE_PX2
    return _Polygons(faces.uv_px[seen], faces.distance_m[seen], colours[seen], 1.0)


def _apply_sensor(levels: Levels, look: Look) -> Levels:
    """Apply the sensor's blur, vignetting, gain, gamma and noise. Return (H, W, 3) uint8."""
    height, width, _ = levels.shape
    # Gain and vignetting precede gamma: applied after it, each is raised to that power.
    v = np.linspace(-1, 1, height)[:, None] ** 2
    u = np.linspace(-1, 1, width)[:, None] ** 2
    dim_v = ((1 - look.vignette / 2 * v) ** look.gamma).astype(np.float32)
    dim_u = (look.gain * (1 - look.vignette / 2 * u)) ** look.gamma
    gain = (255 * dim_u).astype(np.float32).ravel()
    curve = _build_curve(look.gamma)
    noise = look.noise.reshape(height, -1)
    deviation = np.float32(255 * look.noise_deviation)
    flat = levels.reshape(height, -1)
    flat = np.concatenate([flat[:1], flat, flat[-1:]])  # repeat the border rows
    out = np.empty((height, 3 * width), np.uint8)
    for rows in iter_bands(height):
        near = flat[rows.start : rows.stop + 2]
        band = curve.take(_blur_rows(near, look.blur), mode="clip")  # "clip" skips index checks
        band *= gain
        band *= dim_v[rows]
        grains = noise[rows] * deviation
        grains += np.float32(0.5)
        band += grains
        out[rows] = np.clip(band, 0, 255, out=band)
    return out.reshape(levels.shape)


@lru_cache(maxsize=1)  # the images of a flight have one
def _build_curve(gamma: float) -> FloatImage:
    """Return the brightness, 0 to 1, of every step of light."""
    # Powers of float32 depend on the processor; those of float64, rounded to float32, do not.
    return (np.linspace(0, 1, CURVE_STEPS) ** gamma).astype(np.float32)


def _blur_rows(near: Levels, blur: float) -> NDArray[np.intp]:
    """Combine rows with their 3 x 3 mean, and return indices of the curve, 16 per level.

    ``near`` also has the rows above and below. The border columns are repeated.
    """
    around = round(blur * 256 / 9)
    middle = near[1:-1].astype(np.uint16)
    column = np.add(near[:-2], near[2:], dtype=np.uint16)
    column += middle
    box = column.copy()
    box[:, 3:] += column[:, :-3]
    box[:, :-3] += column[:, 3:]
    box[:, :3] += column[:, :3]
    box[:, -3:] += column[:, -3:]
    box *= np.uint16(around)
    middle *= np.uint16(256 - 9 * around)
    middle += box
    middle >>= 4
    return middle.astype(np.intp)
