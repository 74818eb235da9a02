"""Crop geometry and pixel operations of `augment`: homographies, sampling, blending, noise.

An image needs many windows with few robots each, so plain numbers are faster here than small
arrays.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from dmrl.learn.data.batches import BOX, DEPTH, SIGMA_DEPTH, SIGMA_U, SIGMA_V, Robots, U, V

FEATHER_PX = 3.0
"""Width of a pasted patch's soft border."""
SHARPENING = 0.1
"""Weight subtracted from a pixel for each of its two neighbours, in both axes, before sampling.

A bilinear window alone has half the sharpness of the whole images in inference. With sharpening,
squared differences of neighbouring pixels are 0.95 of those after Lanczos resampling (20 published
images, random windows). Bicubic sampling, three times as slow, has 0.92, and bilinear 0.64.
"""
_WARP_FLAGS = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
_BORDER_MODE = cv2.BORDER_REPLICATE
_SHARPENING_KERNEL = np.array([-SHARPENING, 1 + 2 * SHARPENING, -SHARPENING], np.float32)
_MARGIN_PX = 2  # neighbourhood of a pixel in sampling and sharpening
_EXACT_TOLERANCE_PX = 1e-3  # tolerance for windows that coincide with whole pixels
_NO_BOX = [math.nan] * 4
_PIXEL_CENTRE_SHIFT = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
cv2.setNumThreads(1)  # windows are small, and torch uses the cores

Rng = np.random.Generator
Pixels = NDArray[np.uint8]
Opacity = NDArray[np.float32]
"""(h, w, 1), 0 to 1."""
Point = tuple[float, float]
"""u and v, pixels."""
StepMatrix = tuple[tuple[float, float], tuple[float, float]]
"""(2, 2) matrix from steps on the canvas to steps in the source."""
RobotRow = list[float]
"""``ROBOT_FIELDS`` of one robot."""
Rect = tuple[int, int, int, int]
"""Left, top, right, bottom on the canvas, whole pixels."""
Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy, pixels."""


class CropWindow(NamedTuple):
    """Mapping from a rectangle of the canvas to a source image.

    ``matrix`` (3, 3) is the homography from pixels of the rectangle, counted from its corner, to
    pixels of the source. ``camera`` has the intrinsics of both if the window is the view of a
    rotated camera.
    """

    matrix: NDArray[np.float64]
    zoom: float
    camera: Intrinsics | None = None


def build_crop_homography(turn: StepMatrix, seen: Point, shown: Point) -> NDArray[np.float64]:
    """Build the (3, 3) homography of a crop: scale, rotation and mirroring only.

    Parameters
    ----------
    turn
        Matrix from steps on the canvas to steps in the source.
    seen, shown
        Point of the source, and its position in the rectangle, pixels.
    """
    (a, b), (c, d) = turn
    x, y = shown
    return np.array([[a, b, seen[0] - a * x - b * y], [c, d, seen[1] - c * x - d * y], [0, 0, 1]])


def build_rotation_homography(
    camera: Intrinsics, turn: StepMatrix, seen: Point, shown: Point, corner: Point
) -> NDArray[np.float64]:
    """Build the (3, 3) homography of a camera rotated until a source point is at another pixel.

    A pinhole camera stretches objects away from the image centre. A crop keeps this stretch at the
    wrong position. A rotation of the camera about its own centre, which is a homography, does not.

    Parameters
    ----------
    camera
        Intrinsics of source and canvas.
    turn, seen, shown
        See `build_crop_homography`.
    corner
        Corner of the rectangle, on the canvas.
    """
    fx, fy, cx, cy = camera
    (a, b), (c, d) = turn
    left, top = corner
    k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    rays_of = np.array([[1 / fx, 0, (left - cx) / fx], [0, 1 / fy, (top - cy) / fy], [0, 0, 1.0]])
    about = np.array([[a, b, 0], [c, d, 0], [0, 0, 1.0]])
    then = rotation_to_pixel(camera, (shown[0] + left, shown[1] + top))
    return np.asarray(k @ rotation_to_pixel(camera, seen) @ about @ then.T @ rays_of)


def rotation_to_pixel(camera: Intrinsics, uv: Point) -> NDArray[np.float64]:
    """Return the (3, 3) rotation of the optical axis onto a pixel's ray: tilt, then pan."""
    fx, fy, cx, cy = camera
    x, y = (uv[0] - cx) / fx, (uv[1] - cy) / fy
    across, whole = math.hypot(1, x), math.sqrt(1 + x * x + y * y)
    both = across * whole
    return np.array(
        [
            [1 / across, -x * y / both, x / whole],
            [0, across / whole, y / whole],
            [-x / across, -y / both, 1 / whole],
        ]
    )


def ray_length(camera: Intrinsics, u: float, v: float) -> float:
    """Return distance over depth of a point that projects to this pixel."""
    fx, fy, cx, cy = camera
    return math.sqrt(1 + ((u - cx) / fx) ** 2 + ((v - cy) / fy) ** 2)


def apply_homography(matrix: Sequence[Sequence[float]], u: float, v: float) -> Point:
    """Map a point by a homography (3, 3); NaN behind the camera."""
    (a, b, c), (d, e, f), (g, h, i) = matrix
    ahead = g * u + h * v + i
    if ahead <= 0:
        return math.nan, math.nan
    return (a * u + b * v + c) / ahead, (d * u + e * v + f) / ahead


def sample_window(
    raw: Pixels, window: CropWindow, shape: tuple[int, int], *, sharp: bool = True
) -> Pixels:
    """Sample the (h, w, C) pixels of a window from an image (H, W[, C]).

    Beyond the image, its border is repeated. If the pixels of both coincide, they are copied.

    Parameters
    ----------
    raw
        Source image.
    window
        Window, all of it in front of the camera.
    shape
        Height and width of the rectangle, pixels.
    sharp
        Sharpen before sampling, since bilinear interpolation blurs.
    """
    rows = window.matrix.tolist()
    left, top, right, bottom = _source_bounds(rows, shape, raw.shape)
    if (copied := _crop_exact(raw, rows, shape)) is not None:
        return copied.reshape(*shape, -1)
    # OpenCV counts pixels from their centres. It is fastest with four channels.
    to_part = np.array([[1, 0, -left - 0.5], [0, 1, -top - 0.5], [0, 0, 1]])
    matrix = to_part @ window.matrix @ _PIXEL_CENTRE_SHIFT
    part: Any = raw[top:bottom, left:right]
    if sharp:
        kernel = _SHARPENING_KERNEL
        part = cv2.sepFilter2D(part, -1, kernel, kernel, borderType=_BORDER_MODE)
    colours = part.shape[2:] == (3,)
    part = cv2.cvtColor(part, cv2.COLOR_RGB2RGBA) if colours else part
    seen: Any = cv2.warpPerspective(
        part, matrix, shape[::-1], flags=_WARP_FLAGS, borderMode=_BORDER_MODE
    )
    seen = cv2.cvtColor(seen, cv2.COLOR_RGBA2RGB) if colours else seen
    return np.asarray(seen, np.uint8).reshape(*shape, -1)


def _source_bounds(
    matrix: list[list[float]], shape: tuple[int, int], source: tuple[int, ...]
) -> Rect:
    """Return the bounds of a rectangle in the source, plus a margin; at least one pixel."""
    at = [apply_homography(matrix, u, v) for u in (0, shape[1]) for v in (0, shape[0])]
    (left, top), (right, bottom) = map(min, *at), map(max, *at)
    height, width = source[:2]
    left, top = (
        min(max(math.floor(low) - _MARGIN_PX, 0), most - 1)
        for low, most in ((left, width), (top, height))
    )
    right = max(min(math.ceil(right) + _MARGIN_PX, width), left + 1)
    return left, top, right, max(min(math.ceil(bottom) + _MARGIN_PX, height), top + 1)


def _crop_exact(
    raw: Pixels, matrix: list[list[float]], shape: tuple[int, int]
) -> NDArray[np.uint8] | None:
    """Return a part of an image, unchanged or mirrored; None if the window is not such a part."""
    (a, b, c), (d, e, f), (g, h, i) = matrix
    bent = max(abs(abs(a) - 1), abs(b), abs(d), abs(e - 1), abs(g), abs(h), abs(i - 1))
    left, top = round(c if a > 0 else c - shape[1]), round(f)
    off_px = max(abs((c if a > 0 else c - shape[1]) - left), abs(f - top))
    if bent * max(shape) + off_px > _EXACT_TOLERANCE_PX or left < 0 or top < 0:
        return None
    part = raw[top : top + shape[0], left : left + shape[1]]
    if part.shape[:2] != shape:
        return None
    return part if a > 0 else part[:, ::-1]


def scale_channels(pixels: Pixels, gain: Sequence[float], lift: Sequence[float]) -> Pixels:
    """Return (h, w, 3) channels times ``gain`` (3,) plus ``lift`` (3,), rounded, 0 to 255."""
    # OpenCV, since NumPy and torch are slow on arrays whose last axis is 3.
    (a, b, c), (d, e, f) = gain, lift
    matrix = np.array([[a, 0, 0, d], [0, b, 0, e], [0, 0, c, f]])
    return np.asarray(cv2.transform(pixels, matrix), np.uint8)


def alpha_blend(below: Pixels, above: Pixels, opacity: Opacity) -> Pixels:
    """Blend one (h, w, 3) image over another, rounded."""
    under = below.astype(np.float32)
    return np.asarray(under + opacity * (above - under) + np.float32(0.5)).astype(np.uint8)


def blur_pixels(pixels: Pixels, share: float) -> Pixels:
    """Blur (h, w, 3): each pixel takes ``share`` of each of its two neighbours, in both axes."""
    line = np.array([share, 1 - 2 * share, share])
    return np.asarray(cv2.sepFilter2D(pixels, -1, line, line, borderType=_BORDER_MODE), np.uint8)


def add_noise(pixels: Pixels, grain: NDArray[np.float32], sigma: float) -> Pixels:
    """Add noise to (h, w, 3): ``sigma`` times as many numbers of ``grain``."""
    levels = grain * np.float32(sigma)
    levels += pixels.ravel()
    levels += np.float32(0.5)
    return np.clip(levels, 0, 255, out=levels).astype(np.uint8).reshape(pixels.shape)


def to_luma(pixels: Pixels) -> Pixels:
    """Return the (h, w, 1) luma."""
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8)[..., None]


def tile_mosaic(whole: Rect, rng: Rng) -> list[Rect]:
    """Split a rectangle in two or four, at a third to two thirds of its sides."""
    left, top, right, bottom = whole
    x = round(left + (right - left) * rng.uniform(1 / 3, 2 / 3))
    y = round(top + (bottom - top) * rng.uniform(1 / 3, 2 / 3))
    kind = rng.integers(3)
    if kind == 0:
        return [(left, top, x, bottom), (x, top, right, bottom)]
    if kind == 1:
        return [(left, top, right, y), (left, y, right, bottom)]
    return [(left, top, x, y), (x, top, right, y), (left, y, x, bottom), (x, y, right, bottom)]


def list_robots(robots: Robots) -> list[RobotRow]:
    """Return the rows of (K, 11) that are robots."""
    return [robot for robot in robots.tolist() if not math.isnan(robot[U])]


def is_inside(robot: RobotRow, rect: Rect) -> bool:
    """Return whether a robot's centre is inside a rectangle."""
    return rect[0] <= robot[U] < rect[2] and rect[1] <= robot[V] < rect[3]


def is_covered(robot: RobotRow, rect: Rect, opacity: Opacity | None) -> bool:
    """Return whether a robot's centre is covered by a layer (h, w, 1); None: opaque."""
    if not is_inside(robot, rect) or opacity is None:
        return is_inside(robot, rect)
    return bool(opacity[int(robot[V] - rect[1]), int(robot[U] - rect[0]), 0] > 0.5)


def move_labels(robots: Sequence[RobotRow], window: CropWindow, rect: Rect) -> list[RobotRow]:
    """Transform the labels of a source's robots to their positions on the canvas."""
    back = np.linalg.inv(window.matrix).tolist() if robots else []
    out = []
    for robot in robots:
        u, v = apply_homography(back, robot[U], robot[V])
        u, v, nearer = u + rect[0], v + rect[1], window.zoom
        if window.camera:  # a rotation keeps the distance, not the depth
            camera = window.camera
            nearer *= ray_length(camera, u, v) / ray_length(camera, robot[U], robot[V])
        there = [*robot]
        there[U], there[V] = u, v
        there[DEPTH], there[SIGMA_DEPTH] = robot[DEPTH] / nearer, robot[SIGMA_DEPTH] / nearer
        there[SIGMA_U], there[SIGMA_V] = robot[SIGMA_U] * nearer, robot[SIGMA_V] * nearer
        there[BOX] = _NO_BOX  # not transformed: nothing uses it
        out.append(there)
    return out


def build_feather_mask(height: int, width: int) -> Opacity:
    """Return (h, w, 1) opacity: 1 inside, falling to 0 over the border."""
    return (_feather_profile(height)[:, None] * _feather_profile(width))[..., None]


@lru_cache(maxsize=1024)
def _feather_profile(size: int) -> NDArray[np.float32]:
    """Return (n,) opacity along a line: from either end it rises to 1."""
    at = np.arange(size, dtype=np.float32)
    rises = (np.minimum(at, size - 1 - at) + 1) / np.float32(FEATHER_PX + 1)
    return np.asarray(np.minimum(rises, 1), np.float32)
