"""Items of generated rooms, drawn by the table ``room_items.toml`` beside this file."""

import tomllib
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.random import Generator

from dmrl.geometry.frames import Array
from dmrl.images.canvas import Colour
from dmrl.rendering.backgrounds.room_view import RoomView, place

GREY_RANGES = {"dark": (0.02, 0.3), "any": (0.03, 0.95), "pale": (0.75, 1.0), "glow": (1.2, 2.0)}
"""Brightness of the colours that an item names. Those that it does not name are like `any`."""
MAX_THINGS = 5
"""Number of things on a table, at most."""
Item = dict[str, Any]


@cache
def list_items(where: str) -> tuple[Item, ...]:
    """Return the items of a place: wall, flat, standing or small; frequent ones repeatedly."""
    table = tomllib.loads(files(__package__).joinpath("room_items.toml").read_text("utf-8"))
    items = (item for item in table["item"] if item["place"] == where)
    return tuple(item for item in items for _ in range(item.get("weight", 1)))


def greyish_colour(rng: Generator, low: float, high: float) -> Colour:
    """Draw a colour close to grey, as of paint and furniture, sometimes a strong one."""
    spread = 0.15 if rng.random() < 0.1 else 0.02
    return np.clip(rng.uniform(low, high) + rng.normal(0, spread, 3), 0.01, 2)


def draw_item(view: RoomView, where: str, at: Array, yaw: float) -> None:
    """Draw a random item at a point of the floor, of a top, or below its place on a wall.

    Parameters
    ----------
    view
        Room to draw in.
    where
        wall, flat, standing or small.
    at
        (3,) place, metres.
    yaw
        Direction of the item's x axis.
    """
    items = list_items(where)
    item = items[view.rng.integers(len(items))]
    if where in ("standing", "small"):
        view.start_item(float(np.hypot(at[0], at[1])))
    size = _draw_numbers(view.rng, item["size"])
    for share in (1.2, 0.9, 0.6) if "shadow" in item else ():
        ring = _regular_polygon(12)[None] * item["shadow"] * share * size[:2]
        view.draw_flat(ring, at, yaw, np.full(3, 0.02), 0.15)
    colours: dict[str, Colour] = {}
    for part in item["parts"]:
        if view.rng.random() < part.get("share", 1):
            _draw_part(view, part, size, at, yaw, colours)
    for _ in range(int(view.rng.integers(0, MAX_THINGS)) if item.get("holds") else 0):
        top = view.rng.uniform(-0.4, 0.4, 3) * size
        top[2] = size[2] + 0.04
        draw_item(view, "small", place(top, at, yaw), float(view.rng.uniform(0, 6.3)))


def _draw_numbers(rng: Generator, numbers: Any) -> Array:
    """Draw (K,) numbers, each given by its value or its range."""
    return np.array([rng.uniform(*one) if isinstance(one, list) else one for one in numbers])


def _draw_number(rng: Generator, number: Any) -> float:
    return float(_draw_numbers(rng, [number])[0])


def _draw_colour(rng: Generator, name: Any, known: dict[str, Colour], count: int) -> Array:
    """Draw the (3,) colour of a part, or the (count, 3) of its elements."""
    if isinstance(name, list):
        return np.array(name) * rng.uniform(0.5, 1.5, (count, 1))
    if name == "each":
        return np.stack([greyish_colour(rng, *GREY_RANGES["any"]) for _ in range(count)])
    if name in known:
        return known[name]
    found = greyish_colour(rng, *GREY_RANGES.get(name, GREY_RANGES["any"]))
    if name not in GREY_RANGES:
        known[name] = found
    return found


def _regular_polygon(corners: int) -> Array:
    """Return (corners, 2) points at a distance of 1; of four, the sides are along the axes."""
    angle = 2 * np.pi * (np.arange(corners) + 0.5) / corners
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _draw_part(
    view: RoomView, part: Item, size: Array, at: Array, yaw: float, known: dict[str, Colour]
) -> None:
    """Draw all elements of a part."""
    rng = view.rng
    count = part.get("count", 1)
    count = int(rng.integers(count[0], count[1] + 1)) if isinstance(count, list) else count
    if not count:
        return
    colour = _draw_colour(rng, part["colour"], known, count)
    moved = np.arange(count)[:, None] * np.array(part.get("step", [0, 0, 0]))
    moved = moved + rng.standard_normal((count, 3)) * part.get("spread", [0, 0, 0])
    angle = 2 * np.pi / count * np.arange(count)
    ring = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) * part.get("ring", 0)
    base = _draw_numbers(rng, part["at"]) + moved
    start = place((base if part["shape"] == "bar" else base + ring) * size, at, yaw)
    radius = _draw_number(rng, part.get("radius", 1))
    lit = part["colour"] != "glow"
    match part["shape"]:
        case "bar":
            end = place((_draw_numbers(rng, part["to"]) + moved + ring) * size, at, yaw)
            view.draw_bars(np.stack([start, end], 1), _draw_number(rng, part["thick_m"]), colour)
        case "box":
            view.draw_box(start[0], _draw_numbers(rng, part["size"]) * size, yaw, colour)
        case "disc":
            half_m = part.get("radius_m")
            half_m = radius * size[0] if half_m is None else _draw_number(rng, half_m)
            view.draw_discs(start, half_m, colour, lit=lit)
        case "leaf":
            leaves = rng.standard_normal((count, 4, 3)) * radius * size
            view.draw_faces(start[:, None] + leaves, colour)
        case "walk":
            path = _draw_walk(rng, start, yaw)
            thick_m = _draw_number(rng, part["thick_m"])
            view.draw_bars(np.stack([path[:-1], path[1:]], 1), thick_m, colour)
        case _:
            outline = _draw_outline(rng, part, size, radius, yaw)
            opacity = _draw_number(rng, part.get("opacity", 1))
            view.draw_faces(outline + start[:, None], colour, opacity, lit=lit)


def _draw_outline(rng: Generator, part: Item, size: Array, radius: float, yaw: float) -> Array:
    """Return the (N, K, 3) corners of an upright panel, a flat polygon or a pattern of cells."""
    match part["shape"]:
        case "panel":
            width, _, height = _draw_numbers(rng, part["size"]) * size
            unit = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]]) * (width, 0, height)
            return place(unit, np.zeros(3), yaw)
        case "flat":
            return _lay(_regular_polygon(part["corners"]) * radius * size[:2], yaw)
        case _:
            cells = int(rng.integers(4, 8))
            middles = (np.indices((cells, cells)).reshape(2, -1).T + 0.5) / cells - 0.5
            white = (np.abs(middles).max(axis=1) < 0.5 - 1 / cells) & (rng.random(cells**2) < 0.5)
            squares = middles[white, None] + _regular_polygon(4) / np.sqrt(2) / cells
            return _lay(0.8 * squares * size[:2], yaw)


def _draw_walk(rng: Generator, start: Array, yaw: float) -> Array:
    """Return the (14, 3) points of a line that wanders over the floor."""
    heading = yaw + np.cumsum(rng.normal(0, 0.5, 14))
    steps = 0.15 * np.column_stack([np.cos(heading), np.sin(heading), 0 * heading])
    return np.asarray(start + np.cumsum(steps, axis=0))


def _lay(outline: Array, yaw: float) -> Array:
    """Return (..., K, 3) corners of an outline (..., K, 2) that lies flat, turned by a yaw."""
    flat = np.concatenate([outline, np.zeros((*outline.shape[:-1], 1))], axis=-1)
    return place(flat, np.zeros(3), yaw)
