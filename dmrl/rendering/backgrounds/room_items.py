"""Items of generated rooms: furniture, markers, plants, people and clutter, without drones.

A wall item gets a place at the bottom of a wall and the direction along it; the others get a place
on the floor and a yaw.
"""

from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from dmrl.geometry.frames import Array
from dmrl.images.canvas import Colour
from dmrl.rendering.backgrounds.room_view import RoomView, place

UP = np.array([0.0, 0.0, 1.0])
SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
WallItem = Callable[[RoomView, Array, Array], None]
FloorItem = Callable[[RoomView, Array, float], None]


def greyish_colour(rng: Generator, low: float, high: float) -> Colour:
    """Draw a colour close to grey, as of paint and furniture, sometimes a strong one."""
    spread = 0.15 if rng.random() < 0.1 else 0.02
    return np.clip(rng.uniform(low, high) + rng.normal(0, spread, 3), 0.01, 1)


def dark_colour(rng: Generator) -> Colour:
    """Draw the colour of black plastic, rubber or wood."""
    return greyish_colour(rng, 0.02, 0.3)


def _start(view: RoomView, at: Array) -> None:
    view.start_item(float(np.hypot(at[0], at[1])))


def _draw_panel(
    view: RoomView, corner: Array, along: Array, size: tuple[float, float], colour: Colour
) -> None:
    """Draw a rectangle on a wall, from its lower corner, width and height in metres."""
    right, up = along * size[0], UP * size[1]
    faces = np.array([[corner, corner + right, corner + right + up, corner + up]])
    view.draw_faces(faces, colour)


def _draw_door(view: RoomView, at: Array, along: Array) -> None:
    """Draw a leaf with its frame, a lever with a lock, and perhaps a pane or a spy hole."""
    rng, (wide, high) = view.rng, (view.rng.uniform(0.7, 1.0), view.rng.uniform(1.9, 2.15))
    colour = greyish_colour(rng, 0.15, 0.95)
    _draw_panel(view, at - 0.05 * along, along, (wide + 0.1, high + 0.05), colour * 0.6)
    _draw_panel(view, at, along, (wide, high), colour)
    inwards = rng.choice([-1, 1])
    lever = at + along * (0.5 - 0.42 * inwards) * wide + UP * 1.03
    metal = greyish_colour(rng, 0.05, 0.75)
    view.draw_discs(np.array([lever, lever - 0.08 * UP]), 0.026, metal)
    view.draw_discs(np.array([lever - 0.08 * UP]), 0.01, dark_colour(rng))
    view.draw_bars(np.array([[lever, lever + 0.13 * inwards * along]]), 0.024, metal * 0.8)
    if rng.random() < 0.4:
        view.draw_discs((at + 0.5 * wide * along + 1.5 * UP)[None], 0.02, dark_colour(rng))
    if rng.random() < 0.3:
        corner = at + 0.2 * wide * along + UP * 1.0
        _draw_panel(view, corner, along, (0.6 * wide, 0.8), greyish_colour(rng, 0.05, 1))


def _draw_window(view: RoomView, at: Array, along: Array) -> None:
    """Draw panes brighter than anything else, with bars between them."""
    rng, corner = view.rng, at + UP * view.rng.uniform(0.6, 1.1)
    count, high, wide = int(rng.integers(1, 5)), rng.uniform(0.6, 1.4), rng.uniform(0.4, 0.9)
    _draw_panel(view, corner, along, (count * wide, high), greyish_colour(rng, 0.1, 0.9))
    for k in range(count):
        start = corner + along * (k * wide + 0.05) + 0.05 * UP
        _draw_panel(view, start, along, (wide - 0.1, high - 0.1), np.full(3, 1.6))


def _draw_cupboard(view: RoomView, at: Array, along: Array) -> None:
    """Draw rows of fronts with knobs, or a shelf with books."""
    rng, shelf = view.rng, view.rng.random() < 0.5
    wide, high = rng.uniform(0.3, 0.6), rng.uniform(0.25, 0.6)
    colour = dark_colour(rng) if shelf else greyish_colour(rng, 0.1, 0.95)
    columns, rows = int(rng.integers(1, 5)), int(rng.integers(1, 5))
    _draw_panel(view, at, along, (columns * wide, rows * high), colour * 0.5)
    for k in range(columns * rows):
        corner = at + along * (k % columns * wide + 0.01) + UP * (k // columns * high + 0.01)
        if not shelf:
            _draw_panel(view, corner, along, (wide - 0.02, high - 0.02), colour)
            knob = corner + along * wide * 0.85 + UP * high * 0.8
            view.draw_discs(knob[None], 0.015, dark_colour(rng))
            continue
        for book in np.arange(0, wide - 0.08, rng.uniform(0.03, 0.09)):
            size = (rng.uniform(0.02, 0.05), high * rng.uniform(0.5, 0.9))
            _draw_panel(view, corner + along * book, along, size, greyish_colour(rng, 0.05, 0.9))


def _draw_board(view: RoomView, at: Array, along: Array) -> None:
    """Draw a screen, a picture or a notice board with papers and markers."""
    rng, corner = view.rng, at + UP * view.rng.uniform(0.6, 1.6)
    wide, high = rng.uniform(0.3, 1.8), rng.uniform(0.3, 1.0)
    _draw_panel(view, corner, along, (wide, high), dark_colour(rng))
    inside, shown = corner + 0.02 * (along + UP), greyish_colour(rng, 0.02, 0.95)
    _draw_panel(view, inside, along, (wide - 0.04, high - 0.04), shown)
    for _ in range(int(rng.integers(0, 8))):
        paper = inside + along * rng.uniform(0, 0.8) * wide + UP * rng.uniform(0, 0.7) * high
        size = tuple(rng.uniform(0.04, 0.25, 2).tolist())
        _draw_panel(view, paper, along, size, greyish_colour(rng, 0.02, 0.95))


def _draw_fitting(view: RoomView, at: Array, along: Array) -> None:
    """Draw sockets, switches, hooks, brackets, a radiator or screws."""
    rng, spot = view.rng, at + UP * view.rng.choice([0.3, 1.1, view.rng.uniform(0.1, 2)])
    kind = rng.integers(4)
    colour = greyish_colour(rng, 0.1, 0.9)
    if kind == 0:
        for k in range(int(rng.integers(1, 5))):
            corner = spot + 0.085 * k * along
            _draw_panel(view, corner, along, (0.08, 0.08), colour)
            view.draw_discs((corner + 0.04 * (along + UP))[None], 0.028, colour * 0.7)
    elif kind == 1:
        for k in range(int(rng.integers(5, 25))):
            _draw_panel(view, at + 0.05 * k * along + 0.1 * UP, along, (0.035, 0.6), colour)
    elif kind == 2:
        inwards = np.cross(along, UP) * rng.choice([-1, 1])
        ends = spot + rng.uniform(-0.15, 0.15, (4, 1)) * along + rng.uniform(-0.1, 0.1, (4, 1)) * UP
        view.draw_bars(np.stack([np.tile(spot, (4, 1)), ends], 1), 0.02, dark_colour(rng))
        view.draw_discs(ends[:1] + 0.02 * inwards, rng.uniform(0.02, 0.08), colour)
    else:
        spots = spot + rng.uniform(-1, 1, (6, 1)) * along + rng.uniform(-0.3, 0.5, (6, 1)) * UP
        view.draw_discs(spots, rng.uniform(0.004, 0.03, 6), dark_colour(rng))


def _draw_marker(view: RoomView, at: Array, yaw: float) -> None:
    """Draw a sheet of paper with a marker of black and white squares, or with dots."""
    rng, side = view.rng, view.rng.uniform(0.1, 0.4)
    view.draw_flat(SQUARE[None] * side * (1.0, 1.3), at, yaw, greyish_colour(rng, 0.8, 1))
    cells = int(rng.integers(4, 8))
    middles = (np.indices((cells, cells)).reshape(2, -1).T + 0.5) / cells - 0.5
    if rng.random() < 0.3:
        circle = 0.35 * np.array([[1, 0], [0.5, 0.87], [-0.5, 0.87], [-1, 0], [-0.5, -0.87]])
        shown = middles[rng.random(len(middles)) < 0.7]
        view.draw_flat((shown[:, None] * side + circle * side / cells), at, yaw, np.full(3, 0.05))
        return
    view.draw_flat(SQUARE[None] * 0.8 * side, at, yaw, np.full(3, 0.04))
    inner = np.abs(middles).max(axis=1) < 0.5 - 1 / cells
    shown = middles[inner & (rng.random(len(middles)) < 0.5)]
    squares = 0.8 * side * (shown[:, None] + SQUARE / cells)
    view.draw_flat(squares, at, yaw, greyish_colour(rng, 0.8, 1))


def _draw_sheets(view: RoomView, at: Array, yaw: float) -> None:
    """Draw several markers in a row."""
    for k in range(int(view.rng.integers(2, 6))):
        _draw_marker(view, place(np.array([0.45 * k, 0, 0]), at, yaw), yaw)


def _draw_stains(view: RoomView, at: Array, yaw: float) -> None:
    """Draw dark spots, dirt and small things that lie about."""
    rng, count = view.rng, int(view.rng.integers(2, 12))
    round_ = np.column_stack([np.cos(k := np.linspace(0, 6, 9)), np.sin(k)])
    shapes = round_ * rng.uniform(0.3, 1, (count, 9, 1)) * rng.uniform(0.004, 0.06, (count, 1, 2))
    shapes = shapes + rng.normal(0, 0.5, (count, 1, 2))
    view.draw_flat(shapes, at, yaw, dark_colour(rng), float(rng.uniform(0.3, 1)))


def _draw_lines(view: RoomView, at: Array, yaw: float) -> None:
    """Draw tape, road markings, or a cable."""
    rng = view.rng
    if rng.random() < 0.5:
        bar = SQUARE[None] * (rng.uniform(0.5, 4), rng.uniform(0.02, 0.12))
        colour = greyish_colour(rng, 0.7, 1) if rng.random() < 0.7 else dark_colour(rng)
        return view.draw_flat(bar, at, yaw, colour)
    heading = yaw + np.cumsum(rng.normal(0, 0.5, 14))
    steps = 0.15 * np.column_stack([np.cos(heading), np.sin(heading), 0 * heading])
    path = at + np.cumsum(steps, axis=0)
    colour = dark_colour(rng)
    return view.draw_bars(np.stack([path[:-1], path[1:]], 1), rng.uniform(0.006, 0.02), colour)


def _draw_shadow(view: RoomView, at: Array, half_m: float) -> None:
    """Draw the soft shadow of an item on the floor."""
    ring = np.column_stack([np.cos(k := np.linspace(0, 6, 12)), np.sin(k)])
    for share in (1.2, 0.9, 0.6):
        view.draw_flat(ring[None] * half_m * share, at, 0.0, np.full(3, 0.02), 0.15)


def _draw_table(view: RoomView, at: Array, yaw: float) -> None:
    """Draw a table or bench on thin legs, with things on it."""
    rng = view.rng
    size = np.array([rng.uniform(0.4, 1.8), rng.uniform(0.4, 0.9), rng.uniform(0.4, 0.9)])
    _start(view, at)
    _draw_shadow(view, at, 0.4 * size[0])
    feet = place(0.46 * np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]]) * size, at, yaw)
    legs = np.stack([feet, feet + UP * size[2]], 1)
    view.draw_bars(legs, rng.uniform(0.02, 0.07), dark_colour(rng))
    top = at + UP * size[2]
    view.draw_box(top, (size[0], size[1], 0.03), yaw, greyish_colour(rng, 0.05, 0.8))
    for _ in range(int(rng.integers(0, 5))):
        here = place(rng.uniform(-0.4, 0.4, 3) * (size[0], size[1], 0), top + 0.031 * UP, yaw)
        view.start_item(float(np.hypot(here[0], here[1])) - 1e-3)
        SMALL_ITEMS[rng.integers(len(SMALL_ITEMS))](view, here, float(rng.uniform(0, 6.3)))


def _draw_office_chair(view: RoomView, at: Array, yaw: float) -> None:
    """Draw a star of five feet on castors, a column, a seat and a back."""
    rng, colour = view.rng, dark_colour(view.rng)
    _start(view, at)
    _draw_shadow(view, at, 0.3)
    angle = yaw + 2 * np.pi / 5 * np.arange(5)
    feet = at + 0.3 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) + 0.06 * UP
    hub = np.tile(at + UP * 0.1, (5, 1))
    metal = greyish_colour(rng, 0.02, 0.7)
    view.draw_discs(feet - 0.03 * UP, 0.03, dark_colour(rng))
    view.draw_bars(np.stack([hub, feet], 1), 0.045, metal)
    view.draw_bars(np.array([[at + UP * 0.1, at + UP * 0.45]]), 0.05, metal)
    view.draw_box(at + UP * 0.45, (0.48, 0.48, 0.07), yaw, colour)
    back = place(np.array([-0.23, 0, 0.58]), at, yaw)
    view.draw_box(back, (0.06, 0.44, rng.uniform(0.3, 0.6)), yaw, colour)


def _draw_chair(view: RoomView, at: Array, yaw: float) -> None:
    """Draw a chair or stool with four legs."""
    rng, thick = view.rng, view.rng.uniform(0.015, 0.04)
    _start(view, at)
    colour = greyish_colour(rng, 0.03, 0.6)
    square = np.concatenate([SQUARE * 0.4, np.zeros((4, 1))], axis=1)
    feet = place(1.1 * square, at, yaw)
    tops = place(square, at + UP * 0.45, yaw)
    view.draw_bars(np.stack([feet, tops], 1), thick, dark_colour(rng))
    view.draw_box(at + UP * 0.45, (0.42, 0.42, 0.03), yaw, colour)
    if rng.random() < 0.7:
        view.draw_box(place(np.array([-0.2, 0, 0.5]), at, yaw), (0.03, 0.4, 0.4), yaw, colour)


def _draw_plant(view: RoomView, at: Array, yaw: float) -> None:
    """Draw a plant or tree: leaves in front of each other, on a stem, some in a pot."""
    rng, high = view.rng, float(np.exp(view.rng.uniform(np.log(0.3), np.log(3))))
    _start(view, at)
    view.draw_bars(np.array([[at, at + UP * high * 0.6]]), 0.03 * high, dark_colour(rng))
    if high < 1:
        view.draw_box(at, (0.3 * high, 0.3 * high, 0.25 * high), yaw, greyish_colour(rng, 0.1, 0.9))
    count = int(rng.integers(20, 100))
    middles = at + UP * high * 0.75 + rng.normal(0, 0.17 * high, (count, 3))
    leaves = middles[:, None] + rng.normal(0, 0.035 * high, (count, 4, 3))
    tint = np.array([0.7, 1, 0.5]) * rng.uniform(0.05, 0.5)
    view.draw_faces(leaves, tint * rng.uniform(0.3, 1.6, (count, 1)))


def _draw_person(view: RoomView, at: Array, yaw: float) -> None:
    """Draw the shape of a person, standing: shoes, legs, trunk, arms, head."""
    rng, tall = view.rng, view.rng.uniform(1.5, 1.95)
    _start(view, at)
    side = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    hips = at + np.array([[0.1], [-0.1]]) * side + UP * 0.5 * tall
    feet = at + rng.uniform(0.1, 0.2) * np.array([[1], [-1]]) * side
    view.draw_discs(feet + 0.04 * UP, 0.06, dark_colour(rng))
    view.draw_bars(np.stack([feet, hips], 1), 0.15, greyish_colour(rng, 0.03, 0.5))
    shirt = greyish_colour(rng, 0.05, 0.9)
    view.draw_bars(np.array([[at + UP * 0.48 * tall, at + UP * 0.83 * tall]]), 0.38, shirt)
    shoulders = at + np.array([[0.2], [-0.2]]) * side + UP * 0.8 * tall
    hands = shoulders + rng.normal(0, 0.2, (2, 3)) - UP * 0.45
    view.draw_bars(np.stack([shoulders, hands], 1), 0.09, shirt)
    view.draw_discs((at + UP * 0.93 * tall)[None], 0.11, np.array([0.6, 0.45, 0.35]))


def _draw_luggage(view: RoomView, at: Array, yaw: float) -> None:
    """Draw a box, suitcase or bag on small wheels."""
    rng, size = view.rng, view.rng.uniform((0.2, 0.15, 0.2), (0.5, 0.4, 0.8))
    _start(view, at)
    _draw_shadow(view, at, 0.6 * size[0])
    wheels = place(np.array([[0.4, 0.4, 0.02], [0.4, -0.4, 0.02]]) * (*size[:2], 1), at, yaw)
    view.draw_discs(wheels, 0.03, dark_colour(rng))
    colour = dark_colour(rng) if rng.random() < 0.6 else rng.uniform(0, 0.7, 3)
    view.draw_box(at + 0.04 * UP, size, yaw, colour)
    grip = at + UP * size[2]
    view.draw_bars(np.array([[grip, grip + UP * 0.2]]), 0.015, dark_colour(rng))


def _draw_tripod(view: RoomView, at: Array, yaw: float) -> None:
    """Draw a tripod, a lamp or a stand: a post on three legs, with something on top."""
    rng, high = view.rng, view.rng.uniform(0.3, 1.8)
    _start(view, at)
    angle = yaw + 2 * np.pi / 3 * np.arange(3)
    feet = at + 0.35 * high * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    knot = at + UP * 0.6 * high
    colour = dark_colour(rng)
    view.draw_bars(np.stack([np.tile(knot, (3, 1)), feet], 1), 0.02, colour)
    view.draw_bars(np.array([[knot, at + UP * high]]), 0.02, colour)
    glowing = rng.random() < 0.3
    head = np.full(3, 2.0) if glowing else dark_colour(rng)
    view.draw_discs((at + UP * high)[None], rng.uniform(0.03, 0.15), head, lit=not glowing)


def _draw_ball(view: RoomView, at: Array, yaw: float) -> None:
    """Draw a ball with patches, or a cone."""
    rng, radius = view.rng, view.rng.uniform(0.03, 0.14)
    _start(view, at)
    _draw_shadow(view, at, 1.2 * radius)
    colour = greyish_colour(rng, 0.05, 0.95)
    if rng.random() < 0.5:
        ring = place(np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]) * radius, at, yaw)
        tip = at + UP * radius * 3.5
        faces = np.stack([ring, np.roll(ring, 1, axis=0), np.tile(tip, (4, 1))], 1)
        return view.draw_faces(faces, colour * rng.uniform(0.6, 1, (4, 1)))
    view.draw_discs((at + UP * radius)[None], radius, colour)
    spots = at + UP * radius + rng.normal(0, 0.45 * radius, (5, 3))
    return view.draw_discs(spots, 0.28 * radius, dark_colour(rng))


def _draw_thing(view: RoomView, at: Array, yaw: float) -> None:
    """Draw a box, book, bottle or cup."""
    size = view.rng.uniform(0.03, 0.25, 3)
    view.draw_box(at, size, yaw, greyish_colour(view.rng, 0.02, 0.95))


def _draw_screen(view: RoomView, at: Array, yaw: float) -> None:
    """Draw a monitor or laptop, on or off."""
    rng, wide = view.rng, view.rng.uniform(0.25, 0.6)
    view.draw_box(at, (0.15, 0.2, 0.12), yaw, dark_colour(rng))
    view.draw_box(at + 0.12 * UP, (0.04, wide, 0.6 * wide), yaw, dark_colour(rng))
    shown = np.array([[x, y, z] for x in (0.025,) for y, z in SQUARE * (0.94, 0.54) * wide])
    face = place(shown, at + UP * (0.12 + 0.3 * wide), yaw)[None]
    view.draw_faces(face, greyish_colour(rng, 0.05, 1.1), lit=False)


SMALL_ITEMS: tuple[FloorItem, ...] = (_draw_thing, _draw_thing, _draw_screen, _draw_ball)
WALL_ITEMS: tuple[WallItem, ...] = (
    _draw_door,
    _draw_door,
    _draw_window,
    _draw_cupboard,
    _draw_board,
    _draw_fitting,
    _draw_fitting,
)
FLAT_ITEMS: tuple[FloorItem, ...] = (_draw_sheets, _draw_marker, _draw_stains, _draw_lines)
STANDING_ITEMS: tuple[FloorItem, ...] = (
    _draw_table,
    _draw_table,
    _draw_office_chair,
    _draw_office_chair,
    _draw_chair,
    _draw_plant,
    _draw_person,
    _draw_luggage,
    _draw_tripod,
    _draw_ball,
)
