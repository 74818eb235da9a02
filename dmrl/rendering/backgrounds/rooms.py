"""Generated rooms: bright walls, doors with handles and spy holes, sockets, lamps, luggage.

They contain small dark objects on bright walls, which networks confuse with drones. Photos from
the web contain few of these.
"""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from dmrl.geometry.frames import Array
from dmrl.images.canvas import LEVELS, Canvas, Colour, FloatImage
from dmrl.images.codec import Rgb
from dmrl.rendering.backgrounds.photos import Photos

ROOMS = "rooms"
"""Value of the setting ``backgrounds`` that selects generated rooms."""
ROOM_COUNT = 1_000_000
"""Number of distinct rooms. More than any run needs."""
SIZE_PX = (480, 336)
OVERDRAW = 1.5
"""Overdraw relative to the image, so that a rotated room has no missing corners."""


@dataclass(frozen=True, slots=True)
class _Room:
    """Canvas of a room, with the rotation of the image. ``unit_px`` is the height of a door."""

    canvas: Canvas
    rng: Generator
    width_px: int
    height_px: int
    turn: Array
    unit_px: float
    wall: Colour

    def draw_polygon(self, corners: Array, colour: Colour, opacity: float = 1.0) -> None:
        """Draw a polygon. Its corners are in the image before rotation."""
        middle = np.array([self.width_px, self.height_px]) / 2
        self.canvas.fill_polygon((corners - middle) @ self.turn.T + middle, colour, opacity)

    def draw_box(
        self, left: float, top: float, width: float, height: float, colour: Colour
    ) -> None:
        """Draw a rectangle."""
        right, bottom = left + width, top + height
        self.draw_polygon(
            np.array([[left, top], [right, top], [right, bottom], [left, bottom]]), colour
        )

    def draw_disc(self, at: Array, half: float, colour: Colour, opacity: float = 1.0) -> None:
        """Draw a disc."""
        angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
        self.draw_polygon(
            at + half * np.column_stack([np.cos(angle), np.sin(angle)]), colour, opacity
        )

    def draw_bar(self, start: Array, end: Array, thick: float, colour: Colour) -> None:
        """Draw a straight bar between two points."""
        along = end - start
        side = np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-6) * thick / 2
        self.draw_polygon(np.array([start - side, start + side, end + side, end - side]), colour)


def open_rooms() -> Photos:
    """Return generated rooms as photos. Room k is the same on every machine."""
    return Photos(_draw_numbered_room, ROOM_COUNT)


def _draw_numbered_room(number: int) -> Rgb:
    picture = draw_room(np.random.default_rng((number, 8)), *SIZE_PX)
    return np.asarray(picture * 255 + 0.5, np.uint8)


def draw_room(rng: Generator, width_px: int, height_px: int) -> FloatImage:
    """Draw a random room, (height_px, width_px, 3), with the values of a photo, 0 to 1.

    Parameters
    ----------
    rng
        Random generator.
    width_px, height_px
        Size of the image.
    """
    wall = _greyish_colour(rng, 0.45, 0.95)
    angle = rng.normal(0, 0.12)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    paint = wall.astype(np.float32) * LEVELS + np.float32(0.5)
    ground = np.tile(paint.astype(np.uint8), (height_px, width_px, 1))
    canvas = Canvas(0, 0, width_px, height_px, fineness=2, ground=ground)
    unit_px = height_px * float(np.exp(rng.uniform(np.log(0.5), np.log(2.2))))
    room = _Room(canvas, rng, width_px, height_px, turn, unit_px, wall)
    floor_px = height_px * rng.uniform(0.6, 1.25)
    for part in rng.permutation(len(BACKGROUND_ITEMS))[: int(rng.integers(1, 4))]:
        BACKGROUND_ITEMS[part](room, floor_px)
    _draw_floor(room, floor_px)
    for _ in range(int(rng.integers(1, 7))):
        _draw_wall_item(room, floor_px)
    for _ in range(int(rng.integers(0, 4))):
        FOREGROUND_ITEMS[rng.integers(len(FOREGROUND_ITEMS))](room, floor_px)
    return np.clip(_add_lighting(rng, canvas.to_rgb()), 0, 1)


def _greyish_colour(rng: Generator, low: float, high: float) -> Colour:
    """Draw a colour close to grey, as of paint and furniture, sometimes a strong one."""
    spread = 0.15 if rng.random() < 0.15 else 0.03
    return np.clip(rng.uniform(low, high) + rng.normal(0, spread, 3), 0.01, 1)


def _dark_colour(rng: Generator) -> Colour:
    return _greyish_colour(rng, 0.02, 0.3)


def _draw_floor(room: _Room, floor_px: float) -> None:
    """Draw a floor, often dark, with a skirting board and joints that meet at a vanishing point."""
    rng, wide = room.rng, OVERDRAW * room.width_px
    colour = _greyish_colour(rng, 0.04, 0.5)
    room.draw_box(-wide, floor_px, 3 * wide, 2 * wide, colour)
    if rng.random() < 0.6:
        room.draw_box(
            -wide, floor_px - 0.03 * room.unit_px, 3 * wide, 0.03 * room.unit_px, _dark_colour(rng)
        )
    far = np.array([rng.uniform(0, room.width_px), floor_px - rng.uniform(0.2, 1) * room.unit_px])
    for u in np.linspace(-wide, 2 * wide, int(rng.integers(2, 16))):
        end = np.array([u, floor_px + wide])
        share = (floor_px - far[1]) / (end[1] - far[1])
        room.draw_bar(far + share * (end - far), end, 1.5, colour * rng.uniform(0.5, 1.5))


def _draw_door(room: _Room, floor_px: float) -> None:
    """Draw one or two leaves with a frame, hinges, a handle, a lock and perhaps a spy hole."""
    rng, tall = room.rng, room.unit_px
    left = rng.uniform(-0.2, 0.9) * room.width_px
    colour = np.clip(room.wall * rng.uniform(0.7, 1.15), 0, 1)
    for _ in range(int(rng.integers(1, 3))):
        wide = tall * rng.uniform(0.38, 0.48)
        edge = colour * rng.uniform(0.3, 0.9)
        room.draw_box(left - 2, floor_px - tall - 2, wide + 4, tall + 2, edge)
        room.draw_box(left, floor_px - tall, wide, tall, colour)
        side = 0.08 if rng.random() < 0.5 else 0.92
        at = np.array([left + side * wide, floor_px - 0.5 * tall])
        _draw_handle(room, at, 1.0 if side < 0.5 else -1.0)
        if rng.random() < 0.5:
            hole = np.array([left + wide / 2, floor_px - 0.75 * tall])
            room.draw_disc(hole, 0.012 * tall, _greyish_colour(rng, 0.3, 0.8))
            room.draw_disc(hole, 0.007 * tall, _dark_colour(rng))
        if rng.random() < 0.3:
            pane = _greyish_colour(rng, 0.05, 1.0)
            room.draw_box(left + 0.2 * wide, floor_px - 0.9 * tall, 0.6 * wide, 0.4 * tall, pane)
        left += wide + rng.uniform(2, 8)


def _draw_handle(room: _Room, at: Array, inwards: float) -> None:
    """Draw a lever on a plate or a rose, a keyhole below, and its shadow."""
    rng, tall = room.rng, room.unit_px
    metal = _greyish_colour(rng, 0.1, 0.75)
    thick = tall * rng.uniform(0.008, 0.018)
    lever = np.array([inwards * tall * rng.uniform(0.045, 0.075), tall * rng.normal(0, 0.003)])
    shade = room.wall * rng.uniform(0.4, 0.8)
    room.draw_bar(at + thick, at + lever + thick, thick, shade)
    if rng.random() < 0.5:
        high = np.array([0, tall * rng.uniform(0.05, 0.09)])
        room.draw_bar(at - high, at + high, 2 * thick, metal * 0.8)
    room.draw_disc(at, 1.4 * thick, metal)
    room.draw_bar(at, at + lever, thick, metal * rng.uniform(0.5, 1))
    lock = at + np.array([0, tall * rng.uniform(0.03, 0.06)])
    room.draw_disc(lock, thick, metal * rng.uniform(0.5, 1))
    room.draw_disc(lock, 0.4 * thick, _dark_colour(rng))


def _draw_cupboard(room: _Room, floor_px: float) -> None:
    """Draw rows of fronts, each with a knob or a bar."""
    rng, tall = room.rng, room.unit_px
    left, wide = rng.uniform(-0.4, 0.8) * room.width_px, tall * rng.uniform(0.2, 0.5)
    rows, columns = int(rng.integers(1, 5)), int(rng.integers(1, 4))
    high = tall * rng.uniform(0.3, 1) / rows
    colour, metal = _greyish_colour(rng, 0.1, 0.95), _dark_colour(rng)
    for row in range(rows):
        for column in range(columns):
            u, v = left + column * wide, floor_px - (row + 1) * high
            room.draw_box(u, v, wide, high, colour * 0.5)
            room.draw_box(u + 1, v + 1, wide - 2, high - 2, colour * rng.uniform(0.9, 1.1))
            at = np.array([u + wide / 2, v + 0.15 * high])
            if rng.random() < 0.5:
                room.draw_disc(at, 0.012 * tall, metal)
            else:
                reach = np.array([0.05 * tall, 0])
                room.draw_bar(at - reach, at + reach, 0.012 * tall, metal)


def _draw_window(room: _Room, floor_px: float) -> None:
    """Draw panes brighter than anything else, with bars between them."""
    rng, tall = room.rng, room.unit_px
    left, top = rng.uniform(-0.2, 0.9) * room.width_px, floor_px - tall * rng.uniform(0.9, 1.1)
    wide, high = tall * rng.uniform(0.3, 0.8), tall * rng.uniform(0.4, 0.7)
    frame, glass = _greyish_colour(rng, 0.1, 0.9), _greyish_colour(rng, 0.85, 1.0)
    room.draw_box(left, top, wide, high, frame)
    count, thick = int(rng.integers(1, 4)), 0.03 * tall
    pane = (wide - thick) / count
    for k in range(count):
        room.draw_box(left + thick + k * pane, top + thick, pane - thick, high - 2 * thick, glass)


def _draw_board(room: _Room, floor_px: float) -> None:
    """Draw a picture, notice board or screen."""
    rng, tall = room.rng, room.unit_px
    left, top = rng.uniform(-0.1, 0.9) * room.width_px, floor_px - tall * rng.uniform(0.6, 1)
    wide, high = tall * rng.uniform(0.1, 0.5, 2)
    room.draw_box(left, top, wide, high, _dark_colour(rng))
    rim = 0.01 * tall
    room.draw_box(
        left + rim, top + rim, wide - 2 * rim, high - 2 * rim, _greyish_colour(rng, 0.02, 0.9)
    )
    for _ in range(int(rng.integers(0, 12))):
        u, v = rng.uniform(0.1, 0.8, 2)
        across, down = rng.uniform(0.02, 0.2, 2)
        paper = _greyish_colour(rng, 0.02, 0.9)
        room.draw_box(left + u * wide, top + v * high, across * wide, down * high, paper)


def _draw_wall_item(room: _Room, floor_px: float) -> None:
    """Draw a small item on the wall: a socket, switch, hook, lamp bracket, screw or crack."""
    rng, tall = room.rng, room.unit_px
    at = np.array([rng.uniform(0, room.width_px), floor_px - tall * rng.uniform(0.05, 1.2)])
    size = tall * rng.uniform(0.012, 0.05)
    colour = np.clip(room.wall * rng.uniform(0.2, 1.2), 0, 1)
    kind = rng.integers(4)
    if kind == 0:  # a socket
        room.draw_box(at[0] - size, at[1] - size, 2 * size, 2 * size, colour)
        room.draw_disc(at, 0.75 * size, colour * 0.8)
        for side in (-0.3, 0.3):
            room.draw_disc(np.add(at, (side * size, 0)), 0.15 * size, _dark_colour(rng))
    elif kind == 1:  # a bracket: an arm with a lamp
        end = at + size * rng.uniform(-3, 3, 2)
        room.draw_bar(at, end, 0.3 * size, _dark_colour(rng))
        room.draw_disc(end, size * rng.uniform(0.3, 1), _greyish_colour(rng, 0.02, 0.9))
    elif kind == 2:  # hooks in a row
        for k in range(int(rng.integers(1, 6))):
            hook = np.add(at, (3 * k * size, 0))
            room.draw_bar(hook, np.add(hook, (0.2 * size, size)), 0.3 * size, _dark_colour(rng))
    else:
        room.draw_disc(at, 0.5 * size, _dark_colour(rng), rng.uniform(0.4, 1))


def _draw_luggage(room: _Room, floor_px: float) -> None:
    """Draw a suitcase or bag on the floor, with ribs, wheels and a handle."""
    rng, tall = room.rng, room.unit_px
    wide, high = tall * rng.uniform(0.12, 0.3), tall * rng.uniform(0.15, 0.4)
    left = rng.uniform(-0.1, 1) * room.width_px
    top = floor_px - high + tall * rng.uniform(0, 0.2)
    colour = _dark_colour(rng) if rng.random() < 0.6 else rng.uniform(0, 0.7, 3)
    room.draw_box(left, top, wide, high, colour)
    for u in np.linspace(0.1, 0.9, int(rng.integers(2, 7))):
        room.draw_box(left + u * wide, top + 0.05 * high, 1.5, 0.9 * high, colour * 0.6)
    for u in (0.15, 0.85):
        room.draw_disc(np.array([left + u * wide, top + high]), 0.02 * tall, _dark_colour(rng))
        post = np.array([left + (0.5 + 0.6 * (u - 0.5)) * wide, top])
        room.draw_bar(
            post, np.subtract(post, (0, 0.12 * tall)), 1.5, _greyish_colour(rng, 0.1, 0.7)
        )


def _draw_furniture(room: _Room, floor_px: float) -> None:
    """Draw a table, chair or stand: a top on thin legs."""
    rng, tall = room.rng, room.unit_px
    wide, high = tall * rng.uniform(0.1, 0.7), tall * rng.uniform(0.15, 0.4)
    left = rng.uniform(-0.2, 1) * room.width_px
    foot = floor_px + tall * rng.uniform(0, 0.3)
    colour, thick = _dark_colour(rng), tall * rng.uniform(0.008, 0.03)
    for u in np.linspace(0.02, 0.98, int(rng.integers(1, 5))):
        start = np.array([left + u * wide, foot - high])
        room.draw_bar(start, np.add(start, (tall * rng.normal(0, 0.02), high)), thick, colour)
    room.draw_box(left, foot - high, wide, tall * rng.uniform(0.01, 0.05), colour)
    for _ in range(int(rng.integers(0, 4))):  # things on it
        across, up = tall * rng.uniform(0.02, 0.12, 2)
        u = left + rng.uniform(0, 0.9) * wide
        room.draw_box(u, foot - high - up, across, up, _greyish_colour(rng, 0.02, 0.95))


def _draw_cable(room: _Room, floor_px: float) -> None:
    """Draw a cable that hangs from above."""
    rng = room.rng
    at, colour = np.array([rng.uniform(0, room.width_px), -20.0]), _dark_colour(rng)
    step = np.array([rng.normal(0, 6), room.unit_px * 0.08])
    for _ in range(int(rng.integers(4, 16))):
        room.draw_bar(at, at + step, rng.uniform(0.8, 2.5), colour)
        at, step = at + step, np.add(step, (rng.normal(0, 4), rng.normal(0, 3)))


BACKGROUND_ITEMS = (_draw_door, _draw_door, _draw_cupboard, _draw_window, _draw_board)
FOREGROUND_ITEMS = (_draw_luggage, _draw_furniture, _draw_cable)


def _add_lighting(rng: Generator, picture: FloatImage) -> FloatImage:
    """Add light that falls off to one side, and lamps or their reflections with bloom."""
    height, width, _ = picture.shape
    v, u = np.mgrid[:height, :width].astype(np.float32) / np.float32(width)
    angle, strength = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.6)
    slope = np.cos(angle) * (u - 0.5) + np.sin(angle) * (v - 0.35)
    lit = picture * (1 + np.float32(strength) * slope.astype(np.float32))[..., None]
    for _ in range(int(rng.integers(0, 4))):
        far2 = (u - np.float32(rng.random())) ** 2 + (v - np.float32(rng.uniform(0, 0.5))) ** 2
        core, halo = rng.uniform(0.005, 0.03), rng.uniform(0.05, 0.25)
        bloom = rng.uniform(0.2, 1) * np.exp(-far2 / (2 * core**2))
        bloom += rng.uniform(0.05, 0.3) * np.exp(-far2 / (2 * halo**2))
        lit += bloom[..., None].astype(np.float32)
    return np.asarray(lit, np.float32)
