"""Compositing of separately rendered robots over a backdrop, with exact labels."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.frames import Array, Camera, project
from dmrl.rendering.camera.distortion import (
    FloatImage,
    PinholeCanvas,
    image_from_pinhole,
    pinhole_canvas,
    sample_bilinear,
)
from dmrl.rendering.camera.sensor import expose, gaussian_blur
from dmrl.rendering.shot import Layer, Look, Region, Robot, Shot

MIN_COVERED_OPACITY = 1 / 255
"""Opacity above which a pixel counts as covered by a robot."""
MAX_MOTION_SAMPLES = 24
"""Samples along the motion of a robot, at most."""
MAX_DEPTH_M = 65.0  # Blender writes 1e10 where the depth ray missed but other rays hit


def compose_shot(
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
    canvas = pinhole_canvas(camera)
    xyz = np.array([robot.pose.xyz_camera for robot in robots]).reshape(-1, 3)
    order = sorted(layers, key=lambda k: float(np.linalg.norm(xyz[k])))  # near hides far
    visible, share = _compute_visibility(canvas, layers, order)
    boxes = np.full((len(robots), 4), np.nan)
    opacity = np.zeros((len(robots), camera.height_px, camera.width_px), np.uint8)
    surface = np.zeros(opacity.shape[1:], np.float32)
    for k in order:
        boxes[k] = _bounding_box(canvas, camera, layers[k], visible[k] > MIN_COVERED_OPACITY)
        _draw_masks(canvas, camera, layers[k], visible[k], opacity[k], surface)
    picture = look.backdrop.astype(np.float32)
    for k in reversed(order):
        _draw_robot(canvas, camera, robots[k], layers[k], look, picture)
    rgb = expose(picture, look.sensor, np.random.default_rng((look.seed, 1)))
    uv, depth_m = project(xyz, canvas.pinhole.image_from_optical)
    uv = image_from_pinhole(uv - canvas.shift_px, camera)
    all_share = np.array([share.get(k, 0.0) for k in range(len(robots))])
    return Shot(rgb, uv, depth_m, boxes, all_share, opacity, surface)


def _compute_visibility(
    canvas: PinholeCanvas, layers: Mapping[int, Layer], order: Sequence[int]
) -> tuple[dict[int, FloatImage], dict[int, float]]:
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


def _bounding_box(
    canvas: PinholeCanvas, camera: Camera, layer: Layer, visible: NDArray[np.bool_]
) -> Array:
    """Return the bounding box of the visible pixels after distortion, clipped to the image."""
    if not visible.any():
        return np.full(4, np.nan)
    rows, cols = np.flatnonzero(visible.any(axis=1)), np.flatnonzero(visible.any(axis=0))
    width, height = visible.shape[1], visible.shape[0]
    # The outermost pixels of each row and column suffice: distortion moves no other beyond them.
    left, right = visible[rows].argmax(axis=1), width - visible[rows, ::-1].argmax(axis=1)
    top, bottom = visible[:, cols].argmax(axis=0), height - visible[::-1, cols].argmax(axis=0)
    u = np.concatenate([left, left, right, right, cols, cols + 1, cols, cols + 1])
    v = np.concatenate([rows, rows + 1, rows, rows + 1, top, top, bottom, bottom])
    outline = np.column_stack([u + layer.left_px, v + layer.top_px]) - canvas.shift_px
    bent = image_from_pinhole(outline, camera)
    box = np.concatenate([bent.min(axis=0), bent.max(axis=0)])
    return np.asarray(np.clip(box, 0, (camera.width_px, camera.height_px) * 2))


def _find_image_region(
    canvas: PinholeCanvas, camera: Camera, layer: Layer, margin_px: Array
) -> Region | None:
    """Return the image region that shows a blurred layer."""
    bent = image_from_pinhole(_outline(canvas, layer) - canvas.shift_px, camera)
    reach = np.ceil(margin_px) + 1
    limit = (camera.width_px, camera.height_px)
    left, top = np.clip(np.floor(bent.min(axis=0) - reach), 0, limit).astype(int).tolist()
    right, bottom = np.clip(np.ceil(bent.max(axis=0) + reach), 0, limit).astype(int).tolist()
    if left >= right or top >= bottom:
        return None
    return np.s_[top:bottom, left:right]


def _outline(canvas: PinholeCanvas, layer: Layer) -> Array:
    """Return (N, 2) points of a layer's border on the canvas. Without distortion, two corners."""
    height, width = layer.depth_m.shape
    corner = np.array([layer.left_px, layer.top_px], float)
    if canvas.places_px is None:
        return np.array([corner, corner + np.array([width, height])])
    u, v = np.linspace(0, width, 9), np.linspace(0, height, 9)
    rim = np.concatenate([np.column_stack([u, v * 0 + y]) for y in (0, height)])
    rim = np.concatenate([rim, *(np.column_stack([u * 0 + x, v]) for x in (0, width))])
    return np.asarray(rim + corner)


def _find_places(canvas: PinholeCanvas, layer: Layer, part: Region) -> FloatImage:
    """Return (H, W, 2) places in a layer of the pixels of an image region."""
    corner = np.array([layer.left_px, layer.top_px], np.float32)
    if canvas.places_px is not None:
        return canvas.places_px[part] - corner
    grid = np.mgrid[part][::-1] + 0.5
    return np.moveaxis(grid, 0, 2).astype(np.float32) - corner


def _place_in_region(values: FloatImage, layer: Layer, part: Region) -> FloatImage:
    """Return values of a layer's pixels in an image region around it, 0 outside the layer."""
    rows, columns = part
    shape = (rows.stop - rows.start, columns.stop - columns.start, *values.shape[2:])
    found = np.zeros(shape, np.float32)
    top, left = layer.top_px - rows.start, layer.left_px - columns.start
    found[top : top + values.shape[0], left : left + values.shape[1]] = values
    return found


def _draw_masks(
    canvas: PinholeCanvas,
    camera: Camera,
    layer: Layer,
    visible: FloatImage,
    opacity: NDArray[np.uint8],
    surface_m: FloatImage,
) -> None:
    """Write a robot's visible opacity, and the depth of its surface, into the image."""
    part = _find_image_region(canvas, camera, layer, np.zeros(2))
    if part is None:
        return
    if canvas.places_px is None:
        alpha = _place_in_region(visible, layer, part)
        depth = _place_in_region(layer.depth_m, layer, part)
    else:
        alpha, depth = _sample_nearest(layer, visible, _find_places(canvas, layer, part))
    opacity[part] = np.round(alpha * 255)
    seen = (alpha > MIN_COVERED_OPACITY) & (depth < MAX_DEPTH_M)
    near = seen & ((surface_m[part] == 0) | (depth < surface_m[part]))
    surface_m[part] = np.where(near, depth, surface_m[part])


def _sample_nearest(
    layer: Layer, visible: FloatImage, places: FloatImage
) -> tuple[FloatImage, FloatImage]:
    """Return the visible opacity and the depth at places. Depths do not mix."""
    height, width = layer.depth_m.shape
    u, v = np.floor(places).astype(int).reshape(-1, 2).T
    within = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    u, v = u * within, v * within
    shape = places.shape[:2]
    return (visible[v, u] * within).reshape(shape), layer.depth_m[v, u].reshape(shape)


def _draw_robot(
    canvas: PinholeCanvas,
    camera: Camera,
    robot: Robot,
    layer: Layer,
    look: Look,
    picture: FloatImage,
) -> None:
    """Draw a robot over the image, with motion blur."""
    move_px = _image_motion_px(camera, robot)
    margin_px = np.abs(move_px) / 2 + 3 * look.robot_blur_px
    part = _find_image_region(canvas, camera, layer, margin_px)
    if part is None:
        return
    if canvas.places_px is None and not move_px.any():
        light = _place_in_region(layer.light, layer, part)
    else:
        light = _apply_motion_blur(layer.light, _find_places(canvas, layer, part), move_px)
    light = gaussian_blur(light, look.robot_blur_px)
    gain = np.float32(look.robot_gain)
    picture[part] = picture[part] * (1 - light[..., 3:]) + gain * light[..., :3]


def _apply_motion_blur(light: FloatImage, places: FloatImage, move_px: Array) -> FloatImage:
    length = float(np.hypot(*move_px))
    taps = min(int(np.ceil(length)) + 1, MAX_MOTION_SAMPLES) if length > 0.5 else 1
    total = np.zeros((*places.shape[:2], 4), np.float32)
    for share in (np.arange(taps) + 0.5) / taps - 0.5:
        total += sample_bilinear(light, places - (share * move_px).astype(np.float32))
    return np.asarray(total / np.float32(taps), np.float32)


def _image_motion_px(camera: Camera, robot: Robot) -> Array:
    half = robot.move_camera_m / 2
    ends = np.array([robot.pose.xyz_camera - half, robot.pose.xyz_camera + half])
    ends[:, 0] = np.maximum(ends[:, 0], 0.02)
    uv, _ = project(ends, camera.image_from_optical)
    return np.asarray(uv[1] - uv[0])
