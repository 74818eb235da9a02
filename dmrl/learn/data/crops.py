"""Windows of images and the rectangles that show them: the geometry of ``augment``.

There are many windows and few robots in each: plain numbers are quicker here than small arrays.
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
SHARPENED = 0.1
"""What each of the two pixels beside loses to a pixel, down and across, before it is sampled.

A bilinear window alone is half as sharp as the whole images that a network will see. With it the
squares of steps between pixels are 0.95 of what Lanczos' sampling leaves (20 published images in
random windows), those of a bicubic window, three times as dear, 0.92, of a bilinear one 0.64.
"""
_HOW = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
_BEYOND = cv2.BORDER_REPLICATE
_SHARP = np.array([-SHARPENED, 1 + 2 * SHARPENED, -SHARPENED], np.float32)
_MARGIN_PX = 2  # what sampling and sharpening see beside a pixel
_EXACT_PX = 1e-3  # what lies no further from whole pixels lies on them
_NO_BOX = [math.nan] * 4
_MIDDLE = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
cv2.setNumThreads(1)  # a window is small, and the cores are torch's

Rng = np.random.Generator
Pixels = NDArray[np.uint8]
Opacity = NDArray[np.float32]
"""(h, w, 1), 0 to 1."""
Point = tuple[float, float]
"""u and v, pixels."""
Turn = tuple[tuple[float, float], tuple[float, float]]
"""(2, 2) from steps on the canvas to steps in the source."""
Robot = list[float]
"""``FIELDS`` of one robot."""
Rect = tuple[int, int, int, int]
"""Left, top, right, bottom on the canvas, whole pixels."""
Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy, pixels."""


class Window(NamedTuple):
    """Where a canvas rectangle looks.

    ``matrix`` (3, 3) is the homography from pixels of the rectangle, from its corner, to those of
    the source. ``camera``: of both, where it is known and the window is that of a turned camera.
    """

    matrix: NDArray[np.float64]
    zoom: float
    camera: Intrinsics | None = None


def flat(turn: Turn, seen: Point, shown: Point) -> NDArray[np.float64]:
    """(3, 3) window that shows a source's point somewhere in its rectangle, as scissors would.

    Parameters
    ----------
    turn
        From steps on the canvas to steps in the source.
    seen, shown
        Point of the source, and where in the rectangle it comes, pixels.
    """
    (a, b), (c, d) = turn
    x, y = shown
    return np.array([[a, b, seen[0] - a * x - b * y], [c, d, seen[1] - c * x - d * y], [0, 0, 1]])


def turned(
    camera: Intrinsics, turn: Turn, seen: Point, shown: Point, corner: Point
) -> NDArray[np.float64]:
    """(3, 3) window of a camera that was turned until a point of the source is elsewhere.

    What a pinhole camera sees is stretched away from its centre. Scissors carry that along; a
    turn of the camera about its own centre, which is a homography, does not.

    Parameters
    ----------
    camera
        Of source and canvas.
    turn, seen, shown
        See `flat`.
    corner
        Of the rectangle, on the canvas.
    """
    fx, fy, cx, cy = camera
    (a, b), (c, d) = turn
    left, top = corner
    k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    rays_of = np.array([[1 / fx, 0, (left - cx) / fx], [0, 1 / fy, (top - cy) / fy], [0, 0, 1.0]])
    about = np.array([[a, b, 0], [c, d, 0], [0, 0, 1.0]])
    then = facing(camera, (shown[0] + left, shown[1] + top))
    return np.asarray(k @ facing(camera, seen) @ about @ then.T @ rays_of)


def facing(camera: Intrinsics, uv: Point) -> NDArray[np.float64]:
    """(3, 3) rotation of the optical axis onto a pixel's ray: tilted, then panned."""
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


def slant(camera: Intrinsics, u: float, v: float) -> float:
    """Distance over depth of what is seen at a pixel."""
    fx, fy, cx, cy = camera
    return math.sqrt(1 + ((u - cx) / fx) ** 2 + ((v - cy) / fy) ** 2)


def through(matrix: Sequence[Sequence[float]], u: float, v: float) -> Point:
    """Where a homography (3, 3) takes a point; NaN behind the camera."""
    (a, b, c), (d, e, f), (g, h, i) = matrix
    ahead = g * u + h * v + i
    if ahead <= 0:
        return math.nan, math.nan
    return (a * u + b * v + c) / ahead, (d * u + e * v + f) / ahead


def sample(raw: Pixels, window: Window, shape: tuple[int, int], *, sharp: bool = True) -> Pixels:
    """(h, w, C) pixels that a rectangle of this shape shows of an image (H, W[, C]).

    What lies beyond the image is as its border. Where the pixels of both lie on each other they
    are copied.

    Parameters
    ----------
    raw
        The image.
    window
        Where the rectangle looks, all of it ahead of the camera.
    shape
        Its height and width, pixels.
    sharp
        Sharpen what is sampled, as a picture's bilinear samples are blurred.
    """
    rows = window.matrix.tolist()
    left, top, right, bottom = _reach(rows, shape, raw.shape)
    if (copied := _copied(raw, rows, shape)) is not None:
        return copied.reshape(*shape, -1)
    # OpenCV counts pixels from their middles. It is quickest with four channels.
    to_part = np.array([[1, 0, -left - 0.5], [0, 1, -top - 0.5], [0, 0, 1]])
    matrix = to_part @ window.matrix @ _MIDDLE
    part: Any = raw[top:bottom, left:right]
    if sharp:
        part = cv2.sepFilter2D(part, -1, _SHARP, _SHARP, borderType=_BEYOND)
    colours = part.shape[2:] == (3,)
    part = cv2.cvtColor(part, cv2.COLOR_RGB2RGBA) if colours else part
    seen: Any = cv2.warpPerspective(part, matrix, shape[::-1], flags=_HOW, borderMode=_BEYOND)
    seen = cv2.cvtColor(seen, cv2.COLOR_RGBA2RGB) if colours else seen
    return np.asarray(seen, np.uint8).reshape(*shape, -1)


def _reach(matrix: list[list[float]], shape: tuple[int, int], source: tuple[int, ...]) -> Rect:
    """What a rectangle sees of a source, and a margin; one pixel at least."""
    at = [through(matrix, u, v) for u in (0, shape[1]) for v in (0, shape[0])]
    (left, top), (right, bottom) = map(min, *at), map(max, *at)
    height, width = source[:2]
    left, top = (
        min(max(math.floor(low) - _MARGIN_PX, 0), most - 1)
        for low, most in ((left, width), (top, height))
    )
    right = max(min(math.ceil(right) + _MARGIN_PX, width), left + 1)
    return left, top, right, max(min(math.ceil(bottom) + _MARGIN_PX, height), top + 1)


def _copied(
    raw: Pixels, matrix: list[list[float]], shape: tuple[int, int]
) -> NDArray[np.uint8] | None:
    """A part of an image as it is, or mirrored; None where a window shows no such part."""
    (a, b, c), (d, e, f), (g, h, i) = matrix
    bent = max(abs(abs(a) - 1), abs(b), abs(d), abs(e - 1), abs(g), abs(h), abs(i - 1))
    left, top = round(c if a > 0 else c - shape[1]), round(f)
    off_px = max(abs((c if a > 0 else c - shape[1]) - left), abs(f - top))
    if bent * max(shape) + off_px > _EXACT_PX or left < 0 or top < 0:
        return None
    part = raw[top : top + shape[0], left : left + shape[1]]
    if part.shape[:2] != shape:
        return None
    return part if a > 0 else part[:, ::-1]


def levelled(pixels: Pixels, gain: Sequence[float], lift: Sequence[float]) -> Pixels:
    """(h, w, 3) every channel times ``gain`` (3,) plus ``lift`` (3,), rounded, within 0 and 255."""
    # OpenCV works by the pixel; NumPy and torch are slow at arrays that end in a side of 3.
    (a, b, c), (d, e, f) = gain, lift
    matrix = np.array([[a, 0, 0, d], [0, b, 0, e], [0, 0, c, f]])
    return np.asarray(cv2.transform(pixels, matrix), np.uint8)


def blended(below: Pixels, above: Pixels, opacity: Opacity) -> Pixels:
    """(h, w, 3) one over the other, rounded."""
    under = below.astype(np.float32)
    return np.asarray(under + opacity * (above - under) + np.float32(0.5)).astype(np.uint8)


def defocused(pixels: Pixels, share: float) -> Pixels:
    """(h, w, 3) as much of each of the two pixels beside in place of a pixel, down and across."""
    line = np.array([share, 1 - 2 * share, share])
    return np.asarray(cv2.sepFilter2D(pixels, -1, line, line, borderType=_BEYOND), np.uint8)


def grained(pixels: Pixels, grain: NDArray[np.float32], sigma: float) -> Pixels:
    """(h, w, 3) with noise: ``sigma`` times so many numbers of ``grain``."""
    levels = grain * np.float32(sigma)
    levels += pixels.ravel()
    levels += np.float32(0.5)
    return np.clip(levels, 0, 255, out=levels).astype(np.uint8).reshape(pixels.shape)


def greyed(pixels: Pixels) -> Pixels:
    """(h, w, 1) luma."""
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8)[..., None]


def parts(whole: Rect, rng: Rng) -> list[Rect]:
    """A rectangle cut in two or four, cut between a third and two thirds of its sides."""
    left, top, right, bottom = whole
    x = round(left + (right - left) * rng.uniform(1 / 3, 2 / 3))
    y = round(top + (bottom - top) * rng.uniform(1 / 3, 2 / 3))
    kind = rng.integers(3)
    if kind == 0:
        return [(left, top, x, bottom), (x, top, right, bottom)]
    if kind == 1:
        return [(left, top, right, y), (left, y, right, bottom)]
    return [(left, top, x, y), (x, top, right, y), (left, y, x, bottom), (x, y, right, bottom)]


def present(robots: Robots) -> list[Robot]:
    """The rows (K, 11) that are robots."""
    return [robot for robot in robots.tolist() if not math.isnan(robot[U])]


def inside(robot: Robot, rect: Rect) -> bool:
    """Whether a robot has its centre in a rectangle."""
    return rect[0] <= robot[U] < rect[2] and rect[1] <= robot[V] < rect[3]


def under(robot: Robot, rect: Rect, opacity: Opacity | None) -> bool:
    """Whether a robot has its centre under a layer (h, w, 1), None: opaque."""
    if not inside(robot, rect) or opacity is None:
        return inside(robot, rect)
    return bool(opacity[int(robot[V] - rect[1]), int(robot[U] - rect[0]), 0] > 0.5)


def moved(robots: Sequence[Robot], window: Window, rect: Rect) -> list[Robot]:
    """Robots of a source where a window puts them on the canvas."""
    back = np.linalg.inv(window.matrix).tolist() if robots else []
    out = []
    for robot in robots:
        u, v = through(back, robot[U], robot[V])
        u, v, nearer = u + rect[0], v + rect[1], window.zoom
        if window.camera:  # a turn keeps the distance, not the depth
            nearer *= slant(window.camera, u, v) / slant(window.camera, robot[U], robot[V])
        there = [*robot]
        there[U], there[V] = u, v
        there[DEPTH], there[SIGMA_DEPTH] = robot[DEPTH] / nearer, robot[SIGMA_DEPTH] / nearer
        there[SIGMA_U], there[SIGMA_V] = robot[SIGMA_U] * nearer, robot[SIGMA_V] * nearer
        there[BOX] = _NO_BOX  # not carried along: nothing asks for it
        out.append(there)
    return out


def feather(height: int, width: int) -> Opacity:
    """(h, w, 1) opacity: 1 within, falling to 0 over the border."""
    return (_risen(height)[:, None] * _risen(width))[..., None]


@lru_cache(maxsize=1024)
def _risen(size: int) -> NDArray[np.float32]:
    """(n,) opacity along a line: from either end it rises to 1."""
    at = np.arange(size, dtype=np.float32)
    rises = (np.minimum(at, size - 1 - at) + 1) / np.float32(FEATHER_PX + 1)
    return np.asarray(np.minimum(rises, 1), np.float32)
