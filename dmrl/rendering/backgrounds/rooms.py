"""Generated rooms with depth: floors in perspective, walls, furniture, clutter and light.

Networks confuse feet of chairs, stains, corners of markers, handles and leaves with small drones.
Photos from the web contain few of these.
"""

import numpy as np
from numpy.random import Generator

from dmrl.geometry.frames import Array
from dmrl.images.canvas import LEVELS, Colour, FloatImage
from dmrl.images.codec import Rgb
from dmrl.rendering.backgrounds.photos import Photos
from dmrl.rendering.backgrounds.room_items import draw_item, greyish_colour
from dmrl.rendering.backgrounds.room_view import RoomView, Surface, build_turn

ROOMS = "rooms"
"""Value of the setting ``backgrounds`` that selects generated rooms."""
ROOM_COUNT = 1_000_000
"""Number of distinct rooms. More than any run needs."""
SIZE_PX = (360, 252)
INSIDE_M = np.array([0.2, 0.2, 0.0])
"""Distance of what stands on the floor from the walls."""
OUTDOOR_SHARE = 0.15
"""Share of streets: walls with rows of windows, a bright sky."""


def open_rooms() -> Photos:
    """Return generated rooms as photos. Room k is the same on every machine."""
    return Photos(draw_numbered_room, ROOM_COUNT)


def draw_numbered_room(number: int) -> Rgb:
    """Draw room number ``number``, (H, W, 3)."""
    return draw_room(np.random.default_rng((number, 8)), *SIZE_PX)


def draw_room(rng: Generator, width_px: int, height_px: int) -> Rgb:
    """Draw a random room, (height_px, width_px, 3), with the values of a photo.

    Parameters
    ----------
    rng
        Random generator.
    width_px, height_px
        Size of the image.
    """
    outdoors = bool(rng.random() < OUTDOOR_SHARE)
    low, high = _draw_box(rng, outdoors=outdoors)
    view = _draw_view(rng, (width_px, height_px), low, high)
    for _ in range(int(rng.integers(1, 9))):
        draw_item(view, "wall", *_draw_wall_place(rng, low, high))
    for where in ("flat", "standing", "small"):
        for _ in range(int(rng.integers(0, 6))):
            at = _draw_floor_place(rng, low, high)
            draw_item(view, where, at, float(rng.uniform(0, 2 * np.pi)))
    canvas = view.paint(low, high, _draw_surfaces(rng, outdoors=outdoors))
    lit = _add_bloom(view, canvas.to_rgb())
    return np.asarray(np.clip(lit, 0, 1) * LEVELS + 0.5, np.uint8)


def _draw_box(rng: Generator, *, outdoors: bool) -> tuple[Array, Array]:
    """Draw two opposite corners of the room around the camera."""
    near, far, top = (4.0, 25.0, 12.0) if outdoors else (0.5, 6.0, rng.uniform(2.3, 3.5))
    reach = np.exp(rng.uniform(np.log(near), np.log(far), 4))
    ahead = max(float(reach[0]), 1.0)
    return np.array([-reach[1], -reach[2], 0.0]), np.array([ahead, reach[3], top])


def _draw_view(rng: Generator, size_px: tuple[int, int], low: Array, high: Array) -> RoomView:
    height_m = float(min(np.exp(rng.uniform(np.log(0.15), np.log(1.9))), high[2] - 0.3))
    pitch = float(rng.normal(0.02 + 0.18 * height_m, 0.2))
    turn = build_turn(float(rng.uniform(-0.8, 0.8)), pitch, float(rng.normal(0, 0.12)))
    lamps = rng.uniform(low, high, (int(rng.integers(1, 4)), 3))
    lamps[:, 2] = high[2] * rng.uniform(0.6, 1, len(lamps))
    focal_px = size_px[0] * float(rng.uniform(0.5, 0.8))
    bend, ambient = float(rng.uniform(0.001, 0.12)), float(rng.uniform(0.35, 0.9))
    return RoomView(rng, size_px, focal_px, bend, height_m, turn, lamps, ambient)


def _draw_surfaces(rng: Generator, *, outdoors: bool) -> list[Surface]:
    """Draw walls, floor and ceiling, in the order of `RoomView.paint`."""
    wall = greyish_colour(rng, 0.3, 0.95)
    walls = [_draw_wall(rng, wall, outdoors=outdoors) for _ in range(4)]
    colour = greyish_colour(rng, 0.08, 0.75)
    pattern = ("plain", "tiles", "tiles", "boards")[rng.integers(4)]
    size = float(np.exp(rng.uniform(np.log(0.12), np.log(0.9))))
    cell_m = (1.2, 0.15 * size + 0.06) if pattern == "boards" else (size, size)
    floor = Surface(
        colour,
        np.clip(colour * rng.choice([0.2, 0.5, 1.5]), 0, 1),
        pattern,
        cell_m,
        joint=float(rng.uniform(0.01, 0.05)),
        grain=float(rng.uniform(0.01, 0.18)),
        stain=float(rng.choice([0, rng.uniform(0.2, 0.9)])),
        gloss=float(rng.choice([0, rng.uniform(0.1, 0.7)])),
    )
    sky = greyish_colour(rng, 0.8, 1.0) * (2.0 if outdoors else 1.0)
    ceiling = Surface(sky, sky * 0.8, "plain" if outdoors else "tiles", (0.6, 0.6), grain=0.01)
    return [*walls, floor, ceiling]


def _draw_wall(rng: Generator, paint: Colour, *, outdoors: bool) -> Surface:
    """Draw paint, bricks, a curtain, or the windows of a street."""
    if outdoors:
        limits = (0.02, 0.3) if rng.random() < 0.7 else (0.6, 1)
        glass = greyish_colour(rng, *limits)
        cell_m = (float(rng.uniform(1.2, 3)), float(rng.uniform(2, 3.5)))
        return Surface(greyish_colour(rng, 0.2, 0.8), glass, "windows", cell_m, stain=0.3)
    kind = rng.random()
    if kind < 0.1:
        return Surface(
            greyish_colour(rng, 0.02, 0.3), paint, "curtain", (float(rng.uniform(0.08, 0.3)), 1.0)
        )
    if kind < 0.2:
        size = float(rng.uniform(0.06, 0.3))
        return Surface(greyish_colour(rng, 0.2, 0.9), paint, "boards", (2 * size, size), joint=0.08)
    return Surface(paint * rng.uniform(0.8, 1), paint, grain=0.02)


def _draw_wall_place(rng: Generator, low: Array, high: Array) -> tuple[Array, float]:
    """Draw a place at the bottom of the wall ahead or to a side, and the direction along it."""
    side = int(rng.integers(3))
    if side == 0:
        return np.array([high[0], rng.uniform(low[1], high[1]), 0.0]), -np.pi / 2
    y, yaw = (high[1], 0.0) if side == 1 else (low[1], np.pi)
    return np.array([rng.uniform(0.3, high[0]), y, 0.0]), yaw


def _draw_floor_place(rng: Generator, low: Array, high: Array) -> Array:
    """Draw a place on the floor, mostly in view."""
    far = float(np.exp(rng.uniform(np.log(0.8), np.log(7.0))))
    bearing = float(rng.uniform(-1.1, 1.1))
    at = np.array([far * np.cos(bearing), far * np.sin(bearing), 0.0])
    return np.asarray(np.clip(at, low + INSIDE_M, high - INSIDE_M))


def _add_bloom(view: RoomView, picture: FloatImage) -> FloatImage:
    """Add lamps in view with their bloom, and light that falls off to one side."""
    rng, (width, height) = view.rng, view.size_px
    u = np.arange(width, dtype=np.float32) / np.float32(width)
    v = np.arange(height, dtype=np.float32)[:, None] / np.float32(width)
    angle, strength = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.5)
    slope = np.cos(angle) * (u - 0.5) + np.sin(angle) * (v - 0.35)
    uv, depth = view.project(view.lamps_m)
    lamps = [(uv[k] / width).tolist() for k in np.flatnonzero(depth > 0.3)]
    lamps += rng.uniform((0, 0), (1, 0.5), (int(rng.integers(0, 2)), 2)).tolist()
    bloom = np.zeros((height, width), np.float32)
    for right, down in lamps:
        core, halo = rng.uniform(0.005, 0.03), rng.uniform(0.05, 0.25)
        for spread, power in ((core, rng.uniform(0.2, 1)), (halo, rng.uniform(0.05, 0.3))):
            across, along = (
                np.exp(-((part.astype(float) - middle) ** 2) / (2 * spread**2))
                for part, middle in ((u, right), (v, down))
            )
            bloom += np.float32(power) * along * across
    gain = 1 + np.float32(strength) * slope.astype(np.float32)
    return np.asarray(picture * gain[..., None] + bloom[..., None], np.float32)
