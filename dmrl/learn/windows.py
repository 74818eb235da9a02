"""Windows of images and the rectangles that show them: the geometry of ``augment``."""

import math
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from dmrl.learn.batches import BOX, DEPTH, SIGMA_DEPTH, SIGMA_U, SIGMA_V, Robots, U, V

FEATHER_PX = 3.0
"""Width of a pasted patch's soft border."""
CORNERS = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
# Bicubic: a bilinear window is half as sharp as the whole images that a network will see.
_HOW = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
_BEYOND = cv2.BORDER_REPLICATE
_MIDDLE = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
_CHANNELS = np.arange(3)
_TO_MIDDLE = np.linalg.inv(_MIDDLE)
cv2.setNumThreads(1)  # a window is small, and the cores are torch's

Rng = np.random.Generator
Pixels = NDArray[np.uint8]
Opacity = NDArray[np.float32]
"""(h, w, 1), 0 to 1."""
Point = NDArray[np.float64]
"""(2,) u and v, pixels."""
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


def flat(turn: NDArray[np.float64], seen: Point, shown: Point) -> NDArray[np.float64]:
    """(3, 3) window that shows a source's point somewhere in its rectangle, as scissors would.

    Parameters
    ----------
    turn
        (2, 2) from steps on the canvas to steps in the source.
    seen, shown
        Point of the source, and where in the rectangle it comes, pixels.
    """
    out = np.eye(3)
    out[:2, :2], out[:2, 2] = turn, seen - turn @ shown
    return out


def turned(
    camera: Intrinsics, turn: NDArray[np.float64], seen: Point, shown: Point, corner: Point
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
    k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    rays_of = np.array([[1 / fx, 0, -cx / fx], [0, 1 / fy, -cy / fy], [0, 0, 1.0]])
    about = np.eye(3)
    about[:2, :2] = turn
    rays = facing(camera, seen) @ about @ facing(camera, shown + corner).T
    return np.asarray(k @ rays @ rays_of @ flat(np.eye(2), corner, np.zeros(2)))


def facing(camera: Intrinsics, uv: Point) -> NDArray[np.float64]:
    """(3, 3) rotation of the optical axis onto a pixel's ray: tilted, then panned."""
    fx, fy, cx, cy = camera
    x, y = (uv[0] - cx) / fx, (uv[1] - cy) / fy
    across, whole = math.hypot(1, x), math.sqrt(1 + x * x + y * y)
    tilt = np.array([[1, 0, 0], [0, across / whole, y / whole], [0, -y / whole, across / whole]])
    pan = np.array([[1 / across, 0, x / across], [0, 1, 0], [-x / across, 0, 1 / across]])
    return np.asarray(pan @ tilt)


def slant(camera: Intrinsics, uv: NDArray[Any]) -> NDArray[Any]:
    """(n,) distance over depth of what is seen at pixels (n, 2)."""
    fx, fy, cx, cy = camera
    return np.asarray(np.sqrt(1 + ((uv[:, 0] - cx) / fx) ** 2 + ((uv[:, 1] - cy) / fy) ** 2))


def through(matrix: NDArray[Any], points: NDArray[Any]) -> NDArray[np.float64]:
    """(n, 2) where a homography takes points (n, 2); NaN behind the camera."""
    u, v, w = matrix[:, :2] @ points.T + matrix[:, 2:]
    ahead = np.where(w > 0, w, np.nan)
    return np.column_stack([u / ahead, v / ahead])


def sample(raw: Pixels, window: Window, shape: tuple[int, int]) -> Pixels:
    """(h, w, C) pixels that a rectangle of this shape shows of an image (H, W[, C]).

    What lies beyond the image is as its border.
    """
    if shape != raw.shape[:2] or (window.matrix != np.eye(3)).any():
        # OpenCV counts pixels from their middles.
        matrix = _TO_MIDDLE @ window.matrix @ _MIDDLE
        seen = cv2.warpPerspective(raw, matrix, shape[::-1], flags=_HOW, borderMode=_BEYOND)
        raw = np.asarray(seen, np.uint8)
    return raw.reshape(*shape, -1)


def levelled(pixels: Pixels, gain: NDArray[Any], lift: NDArray[Any]) -> Pixels:
    """(h, w, 3) every channel times ``gain`` (3,) plus ``lift`` (3,), rounded, within 0 and 255."""
    # OpenCV works by the pixel; NumPy and torch are slow at arrays that end in a side of 3.
    matrix = np.zeros((3, 4))
    matrix[_CHANNELS, _CHANNELS], matrix[:, 3] = gain, lift
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


def present(robots: Robots) -> Robots:
    """The rows that are robots."""
    return robots[np.isfinite(robots[:, U])]


def inside(robots: Robots, rect: Rect) -> NDArray[np.bool_]:
    """(n,) which robots have their centres in a rectangle."""
    u, v = robots[:, U], robots[:, V]
    within: NDArray[np.bool_] = (rect[0] <= u) & (u < rect[2]) & (rect[1] <= v) & (v < rect[3])
    return within


def under(robots: Robots, rect: Rect, opacity: Opacity | None) -> NDArray[np.bool_]:
    """(n,) which robots have their centres under a layer (h, w, 1), None: opaque."""
    within = inside(robots, rect)
    if opacity is not None:
        u, v = (robots[within][:, [U, V]] - rect[:2]).astype(int).T
        within[within] = opacity[v, u, 0] > 0.5
    return within


def moved(robots: Robots, window: Window, rect: Rect) -> Robots:
    """Robots of a source where a window puts them on the canvas."""
    out = robots.copy()
    if not len(out):
        return out
    out[:, BOX] = np.nan  # not carried along: nothing asks for it
    before = robots[:, [U, V]]
    out[:, [U, V]] = through(np.linalg.inv(window.matrix), before) + np.array(rect[:2])
    nearer = np.full(len(robots), window.zoom)
    if window.camera:  # a turn keeps the distance, not the depth
        nearer *= slant(window.camera, out[:, [U, V]]) / slant(window.camera, before)
    out[:, [DEPTH, SIGMA_DEPTH]] /= nearer[:, None]
    out[:, [SIGMA_U, SIGMA_V]] *= nearer[:, None]
    return out


def feather(height: int, width: int) -> Opacity:
    """(h, w, 1) opacity: 1 within, falling to 0 over the border."""
    down, across = (
        np.minimum((np.minimum(r, n - 1 - r) + 1) / np.float32(FEATHER_PX + 1), 1)
        for n, r in ((n, np.arange(n, dtype=np.float32)) for n in (height, width))
    )
    return np.asarray((down[:, None] * across)[..., None], np.float32)
