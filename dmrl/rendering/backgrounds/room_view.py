"""View into a room: a camera, a box of walls with patterns and light, and polygons in it.

Room frame: origin on the floor below the camera, x forward, y left, z up, metres.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from dmrl.geometry.frames import Array, yaw_matrix
from dmrl.images.canvas import LEVELS, Canvas, Colour, FloatImage, Outline

Place = Array | Sequence[float]
"""Point or size along x, y and z, metres."""
NEAREST_M = 0.08
"""Distance below which a face is not drawn."""
NOISE_CELLS = 512
NOISE_CELLS_PER_M = 120.0
BOX_FACES = np.array(
    [[1, 3, 7, 5], [0, 4, 6, 2], [2, 6, 7, 3], [0, 1, 5, 4], [4, 5, 7, 6]], np.int64
)
"""Corners of the faces of a box without its bottom: front, back, left, right, top."""
FACE_SHADES = np.array([0.75, 0.75, 0.85, 0.6, 1.0])
CIRCLE = np.linspace(0, 2 * np.pi, 14, endpoint=False)


@dataclass(frozen=True, slots=True)
class Surface:
    """Floor, wall or ceiling.

    Parameters
    ----------
    colour, other
        (3,) colour, and colour of joints or windows.
    pattern
        plain, tiles, boards, curtain or windows.
    cell_m
        Size of the pattern's cells along the surface and across it.
    joint
        Width of a joint, share of a cell.
    grain, stain
        Strength of fine noise, and of dark stains.
    gloss
        Strength of the reflections of lamps.
    """

    colour: Colour
    other: Colour
    pattern: str = "plain"
    cell_m: tuple[float, float] = (0.5, 0.5)
    joint: float = 0.03
    grain: float = 0.05
    stain: float = 0.0
    gloss: float = 0.0


class _Polygons(NamedTuple):
    """Polygons (F, K, 3) of one item, (F, 3) colours, opacity, and the item's distance."""

    corners: Array
    colours: Array
    opacity: float
    lit: bool
    item_m: float


@dataclass(slots=True)
class RoomView:
    """Camera in a room, and the polygons that it sees.

    Parameters
    ----------
    rng
        Random generator of all draws.
    size_px
        Width and height of the image.
    focal_px
        Focal length.
    bend
        Coefficient of the lens' barrel distortion.
    height_m
        Height of the camera.
    turn
        (3, 3) room_from_camera.
    lamps_m
        (L, 3) lamps and windows, the sources of light.
    ambient
        Share of the light that does not come from lamps.
    """

    rng: Generator
    size_px: tuple[int, int]
    focal_px: float
    bend: float
    height_m: float
    turn: Array
    lamps_m: Array
    ambient: float
    _polygons: list[_Polygons] = field(default_factory=list)
    _item_m: float = np.inf

    def start_item(self, distance_m: float) -> None:
        """Start an item, which hides all items that are farther away."""
        self._item_m = distance_m

    def project(self, points: Array) -> tuple[Array, Array]:
        """Return (..., 2) pixels and (...) depths of (..., 3) points."""
        seen = (points - (0.0, 0.0, self.height_m)) @ self.turn
        depth = np.maximum(seen[..., 0], 1e-3)
        uv = -seen[..., 1:] / depth[..., None]
        radius2 = self.bend * np.maximum((uv**2).sum(axis=-1, keepdims=True), 1e-9)
        uv = uv * (np.sqrt(1 + 4 * radius2) - 1) / (2 * radius2)
        return uv * self.focal_px + np.divide(self.size_px, 2), seen[..., 0]

    def light_at(self, points: Array) -> FloatImage:
        """Return the (N,) light on (N, 3) points."""
        return self._light_on(list(points.T.astype(np.float32)))

    def draw_faces(
        self, corners: Array, colours: Array, opacity: float = 1.0, *, lit: bool = True
    ) -> None:
        """Draw (F, K, 3) polygons in (3,) or (F, 3) colours; unlit ones shine themselves."""
        colours = np.broadcast_to(colours, (len(corners), 3))
        self._polygons.append(_Polygons(corners, colours, opacity, lit, self._item_m))

    def draw_box(self, at: Place, size: Place, yaw: float, colour: Colour) -> None:
        """Draw a box that stands at the middle of its bottom, size along x, y and z."""
        unit = np.array([[x, y, z] for z in (0.0, 1.0) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
        corners = place(unit * size, at, yaw)
        faces = corners[BOX_FACES]
        normal = faces.mean(axis=1) - corners.mean(axis=0)
        towards = np.array([0, 0, self.height_m]) - faces.mean(axis=1)
        seen = np.einsum("fk,fk->f", normal, towards) > 0
        self.draw_faces(faces[seen], (FACE_SHADES[:, None] * colour)[seen])

    def draw_bars(self, ends: Array, thick_m: float, colour: Colour) -> None:
        """Draw (F, 2, 3) round bars."""
        middle = ends.mean(axis=1) - (0, 0, self.height_m)
        side = np.cross(ends[:, 1] - ends[:, 0], middle)
        side *= thick_m / 2 / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
        start, end = ends[:, 0], ends[:, 1]
        self.draw_faces(np.stack([start - side, start + side, end + side, end - side], 1), colour)

    def draw_discs(
        self, at: Array, radius_m: Array | float, colour: Array, *, lit: bool = True
    ) -> None:
        """Draw (F, 3) balls as discs that face the camera."""
        circle = np.column_stack([0 * CIRCLE, np.cos(CIRCLE), np.sin(CIRCLE)]) @ self.turn.T
        radius = np.broadcast_to(radius_m, len(at))[:, None, None]
        self.draw_faces(at[:, None] + radius * circle, colour, lit=lit)

    def draw_flat(
        self, outline: Array, at: Place, yaw: float, colour: Array, opacity: float = 1.0
    ) -> None:
        """Draw (F, K, 2) outlines that lie flat, metres about a point of the floor or of a top."""
        flat = np.concatenate([outline, np.zeros((*outline.shape[:2], 1))], axis=2)
        self.draw_faces(place(flat, at, yaw), colour, opacity)

    def paint(self, low: Array, high: Array, surfaces: Sequence[Surface]) -> Canvas:
        """Paint the room's box and everything in it.

        Parameters
        ----------
        low, high
            (3,) corners of the box.
        surfaces
            Those that face -x, x, -y, y, -z and z: behind, ahead, right, left, floor, ceiling.
        """
        width, height = self.size_px
        ground = self._paint_box(low, high, surfaces)
        levels = np.clip(ground * LEVELS + 0.5, 0, LEVELS).astype(np.uint8)
        canvas = Canvas(0, 0, width, height, fineness=2, ground=levels)
        for _, outline in sorted(self._iter_outlines(canvas), key=lambda face: face[0]):
            canvas.draw_outline(outline)
        return canvas

    def _iter_outlines(self, canvas: Canvas) -> Iterator[tuple[tuple[float, float], Outline]]:
        """Yield the visible polygons: item's and own distance, both negative, and outline.

        All polygons with equal numbers of corners are projected together. Things
        on the floor and on walls are in the order in which they were drawn.
        """
        for corner_count in {part.corners.shape[1] for part in self._polygons}:
            parts = [
                (number, part)
                for number, part in enumerate(self._polygons)
                if part.corners.shape[1] == corner_count
            ]
            sizes = [len(part.corners) for _, part in parts]
            corners = np.concatenate([part.corners for _, part in parts])
            lit = np.repeat([part.lit for _, part in parts], sizes)
            light = np.where(lit, self.light_at(corners.mean(axis=1)), 1.0)
            colours = np.concatenate([part.colours for _, part in parts]) * light[:, None]
            opacity = np.repeat([part.opacity for _, part in parts], sizes)
            uv, depth = self.project(corners)
            item_m = np.repeat([part.item_m for _, part in parts], sizes)
            order = np.repeat([float(number) for number, _ in parts], sizes)
            nearness = np.where(np.isinf(item_m), order, -depth.mean(axis=1)).tolist()
            outlines = canvas.make_outlines(uv, colours, opacity)
            keys = zip((-item_m).tolist(), nearness, strict=True)
            ahead = (depth.min(axis=1) > NEAREST_M).tolist()
            drawn = zip(keys, outlines, ahead, strict=True)
            yield from ((key, outline) for key, outline, shown in drawn if shown)

    def _paint_box(self, low: Array, high: Array, surfaces: Sequence[Surface]) -> FloatImage:
        """Return the (H, W, 3) light of the box that surrounds the camera."""
        width, height = self.size_px
        rays = self._pixel_rays()
        start = (0.0, 0.0, self.height_m)
        least = np.float32(1e-6)  # a ray along a wall still goes to one of its sides
        reach = np.stack(
            [
                np.where(ray > 0, high[k] - start[k], low[k] - start[k]).astype(np.float32)
                / np.where(ray > 0, np.maximum(ray, least), np.minimum(ray, -least))
                for k, ray in enumerate(rays)
            ]
        )
        far = reach.min(axis=0)
        light = np.empty((3, height * width), np.float32)
        for k, surface in enumerate(surfaces):
            axis = k // 2
            mine = np.flatnonzero((reach[axis] == far) & ((rays[axis] > 0) == k % 2))
            if not len(mine):
                continue
            mine_rays = [ray[mine] for ray in rays]
            mine_far = far[mine]
            moves = zip(start, mine_rays, strict=True)
            hit = [np.float32(begin) + mine_far * ray for begin, ray in moves]
            shine = self._light_on(hit)
            along = [hit[i] for i in range(3) if i != axis]
            for channel, paint in enumerate(_paint_surface(surface, along, mine_far)):
                light[channel, mine] = shine * paint
            if surface.gloss:
                light[:, mine] += np.float32(surface.gloss) * self._reflect(hit, mine_rays)
        return np.ascontiguousarray(light.T).reshape(height, width, 3)

    def _pixel_rays(self) -> list[FloatImage]:
        """Return x, y and z of the rays of all pixels, (H * W) each, room frame."""
        width, height = self.size_px
        right = (np.arange(width, dtype=np.float32) + 0.5 - width / 2) / np.float32(self.focal_px)
        down = (np.arange(height, dtype=np.float32) + 0.5 - height / 2) / np.float32(self.focal_px)
        radius2 = right**2 + down[:, None] ** 2
        grow = 1 / np.maximum(1 - np.float32(self.bend) * radius2, np.float32(0.3))
        right, down = grow * right, grow * down[:, None]
        turn = self.turn.astype(np.float32)
        return [(row[0] - row[1] * right - row[2] * down).ravel() for row in turn]

    def _light_on(self, hit: Sequence[FloatImage]) -> FloatImage:
        """Return (N,) `light_at` of points whose coordinates are separate arrays."""
        light = np.full(len(hit[0]), self.ambient, np.float32)
        for lamp in self.lamps_m.astype(np.float32):
            apart = [part - at for part, at in zip(hit, lamp, strict=True)]
            distance2 = apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2
            light += np.float32(3 * (1 - self.ambient)) / (1 + distance2)
        return light

    def _reflect(self, hit: Sequence[FloatImage], rays: Sequence[FloatImage]) -> FloatImage:
        """Return the (N,) light of lamps that a floor reflects."""
        x, y, z = rays
        length2 = x * x + y * y + z * z
        total = np.zeros(len(x), np.float32)
        for lamp in self.lamps_m.astype(np.float32):
            a, b, c = (at - part for part, at in zip(hit, lamp, strict=True))
            cosine = np.maximum(a * x + b * y - c * z, 0)
            cosine = cosine * cosine / (length2 * (a * a + b * b + c * c))
            for _ in range(4):  # the 16th power
                cosine = cosine * cosine
            total += cosine
        return total


def place(points: Array, at: Place, yaw: float) -> Array:
    """Return (..., 3) points turned by a yaw and moved to a place."""
    return np.asarray(points @ yaw_matrix(yaw) + at)


def build_turn(yaw: float, pitch: float, roll: float) -> Array:
    """Return room_from_camera, pitch positive downwards."""
    return np.asarray(Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix())


def _paint_surface(
    surface: Surface, along: Sequence[FloatImage], far_m: FloatImage
) -> list[FloatImage]:
    """Return red, green and blue of points of a surface, (N,) metres along it and across it."""
    noise = _noise_table()
    a, b = ((part * np.float32(NOISE_CELLS_PER_M)).astype(np.int32) for part in along)
    tone = 1 + np.float32(surface.grain) * noise[0, a % NOISE_CELLS, b % NOISE_CELLS]
    if surface.stain:
        spots = noise[1, a // 3 % NOISE_CELLS, b // 3 % NOISE_CELLS]
        tone *= 1 - np.float32(surface.stain) * np.clip(spots - 1, 0, 0.8)
    shares = _paint_pattern(surface, along, far_m, tone)
    colours = zip(surface.colour.tolist(), surface.other.tolist(), strict=True)
    return [tone * (one + shares * np.float32(other - one)) for one, other in colours]


def _paint_pattern(
    surface: Surface, along: Sequence[FloatImage], far_m: FloatImage, tone: FloatImage
) -> FloatImage | float:
    """Return the (N,) share of the other colour, and change the tone of cells in place."""
    if surface.pattern == "plain":
        return 0.0
    a, b = (part / np.float32(cell) for part, cell in zip(along, surface.cell_m, strict=True))
    if surface.pattern == "curtain":
        # Sines and powers of float32 depend on the processor; rounded float64 does not.
        tone *= (1 + 0.5 * np.sin(2 * np.pi * a.astype(float))).astype(np.float32)
        return 0.0
    whole_b = np.floor(b)
    if surface.pattern == "boards":
        a = a + np.float32(0.37) * whole_b
    whole_a = np.floor(a)
    edges = [np.abs(part - whole - 0.5) for part, whole in ((a, whole_a), (b, whole_b))]
    if surface.pattern == "windows":
        return np.asarray(np.maximum(*edges) < np.float32(0.3), np.float32)
    numbers = [whole.astype(np.int32) % NOISE_CELLS for whole in (whole_a, whole_b)]
    tone *= 1 + np.float32(0.04) * _noise_table()[0][numbers[0], numbers[1]]
    shares = np.zeros(len(a), np.float32)
    for edge, cell in zip(edges, surface.cell_m, strict=True):
        wide = np.float32(surface.joint * min(surface.cell_m) / cell)
        blur = far_m * np.float32(0.004 / cell)  # a pixel of the image, in cells
        inside = np.clip((edge - (0.5 - wide / 2)) / blur + np.float32(0.5), 0, 1)
        np.maximum(shares, inside * np.minimum(wide / blur, 1), out=shares)
    return shares


@cache
def _noise_table() -> FloatImage:
    """Return (2, N, N) standard noise that repeats at its edges: white, and smooth."""
    rng = np.random.default_rng(0)
    white = rng.standard_normal((2, NOISE_CELLS, NOISE_CELLS))
    for _ in range(3):
        white[1] += sum(np.roll(white[1], step, axis) for step in (1, -1, 3, -3) for axis in (0, 1))
    white[1] /= white[1].std()
    return white.astype(np.float32)
