"""Compositing of separately rendered robots over a backdrop, with exact labels."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.frames import Array, Camera, project
from dmrl.rendering.camera.distortion import Canvas, Picture, canvas_of, image_from_pinhole, sample
from dmrl.rendering.camera.sensor import blur, expose
from dmrl.rendering.shot import Layer, Look, Part, Robot, Shot

COVERED = 1 / 255
"""Opacity above which a pixel counts as covered by a robot."""
TAPS_MAX = 24
"""Samples along the motion of a robot, at most."""
FARTHEST_M = 65.0  # Blender writes 1e10 where the depth ray missed but other rays hit


def compose(
    camera: Camera, robots: Sequence[Robot], look: Look, layers: Mapping[int, Layer]
) -> Shot:
    """Return the image of a scene and its labels.

    Parameters
    ----------
    camera
        Camera that takes the image.
    robots
        All robots.
    look
        Backdrop, light and sensor.
    layers
        Rendered layers of the visible robots, by the robot's index.
    """
    canvas = canvas_of(camera)
    xyz = np.array([robot.pose.xyz_camera for robot in robots]).reshape(-1, 3)
    order = sorted(layers, key=lambda k: float(np.linalg.norm(xyz[k])))  # near hides far
    visible, share = _visible(canvas, layers, order)
    boxes = np.full((len(robots), 4), np.nan)
    opacity = np.zeros((len(robots), camera.height_px, camera.width_px), np.uint8)
    surface = np.zeros(opacity.shape[1:], np.float32)
    for k in order:
        boxes[k] = _box(canvas, camera, layers[k], visible[k] > COVERED)
        _mark(canvas, camera, layers[k], visible[k], opacity[k], surface)
    picture = look.backdrop.astype(np.float32)
    for k in reversed(order):
        _paint(canvas, camera, robots[k], layers[k], look, picture)
    rgb = expose(picture, look.sensor, np.random.default_rng((look.seed, 1)))
    uv, depth_m = project(xyz, canvas.pinhole.image_from_optical)
    uv = image_from_pinhole(uv - canvas.shift_px, camera)
    all_share = np.array([share.get(k, 0.0) for k in range(len(robots))])
    return Shot(rgb, uv, depth_m, boxes, all_share, opacity, surface)


def _visible(
    canvas: Canvas, layers: Mapping[int, Layer], order: Sequence[int]
) -> tuple[dict[int, Picture], dict[int, float]]:
    """Return the opacity that no nearer robot hides, and the visible share inside the image."""
    clear = canvas.inside.astype(np.float32)
    visible, share = {}, {}
    for k in order:
        alpha = layers[k].light[..., 3]
        visible[k] = alpha * clear[layers[k].part]
        shown = float((alpha * canvas.inside[layers[k].part]).sum())
        share[k] = min(float(visible[k].sum()) / shown, 1.0) if shown else 0.0
        clear[layers[k].part] *= 1 - alpha
    return visible, share


def _box(canvas: Canvas, camera: Camera, layer: Layer, seen: NDArray[np.bool_]) -> Array:
    """Return the bounding box of the visible pixels after distortion, clipped to the image."""
    if not seen.any():
        return np.full(4, np.nan)
    rows, cols = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    width, height = seen.shape[1], seen.shape[0]
    # The outermost pixels of each row and column suffice: distortion moves no other beyond them.
    left, right = seen[rows].argmax(axis=1), width - seen[rows, ::-1].argmax(axis=1)
    top, bottom = seen[:, cols].argmax(axis=0), height - seen[::-1, cols].argmax(axis=0)
    u = np.concatenate([left, left, right, right, cols, cols + 1, cols, cols + 1])
    v = np.concatenate([rows, rows + 1, rows, rows + 1, top, top, bottom, bottom])
    outline = np.column_stack([u + layer.left_px, v + layer.top_px]) - canvas.shift_px
    bent = image_from_pinhole(outline, camera)
    box = np.concatenate([bent.min(axis=0), bent.max(axis=0)])
    return np.asarray(np.clip(box, 0, (camera.width_px, camera.height_px) * 2))


def _place(
    canvas: Canvas, camera: Camera, layer: Layer, spread_px: Array
) -> tuple[Part, Picture] | None:
    """Return the image region that shows a blurred layer, and its pixels' places in the layer."""
    height, width = layer.depth_m.shape
    u, v = np.linspace(0, width, 9), np.linspace(0, height, 9)
    rim = np.concatenate([np.column_stack([u, v * 0 + y]) for y in (0, height)])
    rim = np.concatenate([rim, *(np.column_stack([u * 0 + x, v]) for x in (0, width))])
    corner = np.array([layer.left_px, layer.top_px])
    bent = image_from_pinhole(rim + corner - canvas.shift_px, camera)
    reach = np.ceil(spread_px) + 1
    limit = (camera.width_px, camera.height_px)
    left, top = np.clip(np.floor(bent.min(axis=0) - reach), 0, limit).astype(int).tolist()
    right, bottom = np.clip(np.ceil(bent.max(axis=0) + reach), 0, limit).astype(int).tolist()
    if left >= right or top >= bottom:
        return None
    part = np.s_[top:bottom, left:right]
    if canvas.places_px is None:
        grid = np.mgrid[top:bottom, left:right][::-1] + 0.5
        return part, np.moveaxis(grid, 0, 2).astype(np.float32) - corner.astype(np.float32)
    return part, canvas.places_px[part] - corner.astype(np.float32)


def _mark(
    canvas: Canvas,
    camera: Camera,
    layer: Layer,
    visible: Picture,
    opacity: NDArray[np.uint8],
    surface_m: Picture,
) -> None:
    """Write a robot's visible opacity, and the depth of its surface, into the image."""
    found = _place(canvas, camera, layer, np.zeros(2))
    if found is None:
        return
    part, places = found
    height, width = layer.depth_m.shape
    u, v = np.floor(places).astype(int).reshape(-1, 2).T  # nearest: depths do not mix
    within = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    u, v = u * within, v * within
    shape = places.shape[:2]
    alpha = (visible[v, u] * within).reshape(shape)
    depth = layer.depth_m[v, u].reshape(shape)
    opacity[part] = np.round(alpha * 255)
    seen = (alpha > COVERED) & (depth < FARTHEST_M)
    near = seen & ((surface_m[part] == 0) | (depth < surface_m[part]))
    surface_m[part] = np.where(near, depth, surface_m[part])


def _paint(
    canvas: Canvas, camera: Camera, robot: Robot, layer: Layer, look: Look, picture: Picture
) -> None:
    """Draw a robot over the image, with motion blur."""
    move_px = _move_px(camera, robot)
    found = _place(canvas, camera, layer, np.abs(move_px) / 2 + 3 * look.robot_blur_px)
    if found is None:
        return
    part, places = found
    light = blur(_smeared(layer.light, places, move_px), look.robot_blur_px)
    gain = np.float32(look.robot_gain)
    picture[part] = picture[part] * (1 - light[..., 3:]) + gain * light[..., :3]


def _smeared(light: Picture, places: Picture, move_px: Array) -> Picture:
    length = float(np.hypot(*move_px))
    taps = min(int(np.ceil(length)) + 1, TAPS_MAX) if length > 0.5 else 1
    total = np.zeros((*places.shape[:2], 4), np.float32)
    for share in (np.arange(taps) + 0.5) / taps - 0.5:
        total += sample(light, places - (share * move_px).astype(np.float32))
    return np.asarray(total / np.float32(taps), np.float32)


def _move_px(camera: Camera, robot: Robot) -> Array:
    half = robot.move_camera_m / 2
    ends = np.array([robot.pose.xyz_camera - half, robot.pose.xyz_camera + half])
    ends[:, 0] = np.maximum(ends[:, 0], 0.02)
    uv, _ = project(ends, camera.image_from_optical)
    return np.asarray(uv[1] - uv[0])
