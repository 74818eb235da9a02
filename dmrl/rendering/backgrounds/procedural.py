"""Generated backgrounds: rooms, gradients, textures and clutter of all sizes.

Images are arrays of rows of (W * 3) numbers here: NumPy is slow on a last axis of length 3.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.random import Generator

from dmrl.geometry.frames import Array
from dmrl.images.canvas import LEVELS, Canvas, Colour, FloatImage, Levels, Outline, iter_bands

KNOTS = (3, 6, 12, 24, 48, 96)
"""Knots of the noise from top to bottom of an image, one entry per scale."""
SMOOTH, MIDDLE, ROUGH = 0.4, 0.6, 0.8
"""Amplitude of each scale of noise relative to the next coarser one."""
NOISE_DEVIATION = 0.4
COLOUR_SPREADS = np.array([0.02, 0.05, 0.16])
"""Distance of a colour from grey, one entry per kind of colour."""

BOX, BALL, CABLE, CROSS, WINDOW, SHARD = range(6)
THICKNESS_RANGES = np.array(
    [[0.2, 1.5], [0.3, 1.0], [0.01, 0.05], [0.02, 0.1], [0.75, 0.92], [0, 0]]
)
"""Thickness relative to size, minimum and maximum: box, ball, cable, cross, inside of a window."""
MIN_THICKNESS_PX = 0.7
BAR = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
CIRCLE_ANGLES_RAD = np.linspace(0, 2 * np.pi, 20, endpoint=False)
DISC = np.column_stack([np.cos(CIRCLE_ANGLES_RAD), np.sin(CIRCLE_ANGLES_RAD)]) / 2


def make_background(rng: Generator, width_px: int, height_px: int) -> Levels:
    """Draw a random background, (height_px, width_px, 3), uint8.

    Parameters
    ----------
    rng
        Random generator.
    width_px, height_px
        Size of the image.
    """
    ground = (_draw_gradient, _draw_clouds, _draw_room)[rng.integers(3)]
    canvas = ground(rng, width_px, height_px)
    for outline in _clutter_outlines(rng, canvas):
        canvas.draw_outline(outline)
    levels = canvas.to_levels().reshape(height_px, -1)
    grain = _noise_window(rng, width_px, height_px, ROUGH)
    strength = np.float32(rng.uniform(0.02, 0.35))
    out = np.empty_like(levels)
    for rows in iter_bands(height_px):
        band = grain[rows] * strength
        band += 1
        band *= levels[rows]
        out[rows] = np.clip(band, 0, 255, out=band)
    return out.reshape(height_px, width_px, 3)


def random_window(rng: Generator, table: FloatImage, width_px: int, height_px: int) -> FloatImage:
    """Return a random (height_px, width_px * 3) window of a larger array, as a view."""
    top = int(rng.integers(len(table) - height_px + 1))
    left = 3 * int(rng.integers(table.shape[1] // 3 - width_px + 1))
    return table[top : top + height_px, left : left + 3 * width_px]


def _draw_colours(rng: Generator, count: int) -> Array:
    """Draw (count, 3) colours, mostly greyish as in rooms, sometimes vivid."""
    grey = rng.uniform(0.03, 0.9, (count, 1))
    spread = COLOUR_SPREADS[rng.integers(len(COLOUR_SPREADS), size=(count, 1))]
    return np.clip(grey + spread * rng.standard_normal((count, 3)), 0, 1)


def _fill_canvas(ground: Callable[[slice], FloatImage], width_px: int, height_px: int) -> Canvas:
    """Return a canvas whose background is computed by ``ground``, 0 to 1, row by row."""
    levels = np.empty((height_px, 3 * width_px), np.uint8)
    for rows in iter_bands(height_px):
        band = ground(rows)
        band *= np.float32(LEVELS)
        band += np.float32(0.5)
        levels[rows] = np.clip(band, 0, LEVELS, out=band)
    ground_levels = levels.reshape(height_px, width_px, 3)
    return Canvas(0, 0, width_px, height_px, fineness=2, ground=ground_levels)


def _colour_row(colour: Colour, width_px: int) -> FloatImage:
    return np.tile(colour.astype(np.float32), width_px)


def _draw_gradient(rng: Generator, width_px: int, height_px: int) -> Canvas:
    """Draw a gradient between two colours in a random direction."""
    angle = rng.uniform(0, 2 * np.pi)
    one, other = _draw_colours(rng, 2)
    across = np.linspace(-0.5, 0.5, width_px)[:, None] * np.cos(angle) / 1.42
    down = np.linspace(-0.5, 0.5, height_px) * np.sin(angle) / 1.42
    row = (other + (0.5 + across) * (one - other)).astype(np.float32).ravel()
    sides = np.column_stack([down, np.ones(height_px)]).astype(np.float32)
    mixed = np.stack([_colour_row(one - other, width_px), row])
    return _fill_canvas(lambda rows: sides[rows] @ mixed, width_px, height_px)


def _draw_clouds(rng: Generator, width_px: int, height_px: int) -> Canvas:
    """Draw clouds of two colours, with weak tints of others."""
    one, other = _draw_colours(rng, 2)
    share = _noise_window(rng, width_px, height_px, (SMOOTH, MIDDLE, ROUGH)[rng.integers(3)])
    tints = random_window(rng, _tint_table(width_px, height_px), width_px, height_px)
    half, middle = (
        _colour_row((one - other) / 2, width_px),
        _colour_row((one + other) / 2, width_px),
    )

    def ground(rows: slice) -> FloatImage:
        band = share[rows] * half
        band += middle
        band += tints[rows]
        return band

    return _fill_canvas(ground, width_px, height_px)


def _draw_room(rng: Generator, width_px: int, height_px: int) -> Canvas:
    """Draw a wall and a floor with boards that meet at a vanishing point."""
    horizon = height_px * rng.uniform(0.2, 0.8)
    floor, wall, *boards = _draw_colours(rng, 11)
    light, row = _noise_window(rng, width_px, height_px, SMOOTH), _colour_row(wall, width_px)
    canvas = _fill_canvas(lambda rows: np.float32(0.12) * light[rows] + row, width_px, height_px)
    lean = rng.uniform(-0.15, 0.15) * width_px
    edge = np.array([[0, horizon - lean], [width_px, horizon + lean]])
    below = np.array([[width_px, 3 * height_px], [0, 3 * height_px]])
    canvas.fill_polygon(np.concatenate([edge, below]), floor)
    far = np.array([rng.uniform(0, width_px), horizon])
    near = np.arange(-4, 5) * rng.uniform(0.25, 0.6) * width_px + far[0]
    for u, colour in zip(near.tolist(), boards, strict=True):
        board = np.array([far, [u, 2 * height_px], [u + 0.04 * width_px, 2 * height_px]])
        canvas.fill_polygon(board, colour, 0.4)
    return canvas


def _clutter_outlines(rng: Generator, canvas: Canvas) -> list[Outline]:
    """Return outlines of clutter without quadrotors, from back to front."""
    count = int(rng.integers(4, 30))
    kind = rng.integers(len(THICKNESS_RANGES), size=count)
    size = np.exp(rng.uniform(np.log(4), np.log(110), count))
    thick = size * rng.uniform(*THICKNESS_RANGES[kind].T)
    cable, cross, pane = kind == CABLE, kind == CROSS, kind == WINDOW
    thick[cable] = np.maximum(thick[cable], MIN_THICKNESS_PX)
    along = np.where(cable, 4 * size, size)
    first = np.column_stack([along, np.where(pane, size, thick)])[:, None]
    second = np.column_stack([thick, np.where(cross, size, thick)])[:, None]
    shards = rng.normal(0, 0.5, (count, 3, 2)) * size[:, None, None]
    place = _draw_placements(rng, canvas, count)
    colours = _draw_colours(rng, 2 * count)
    opacity = np.where(rng.random(count) < 1 / 3, rng.uniform(0.3, 1.0, count), 1.0)
    drawn: list[tuple[int, Outline]] = []
    for which, corners, inks in (
        ((kind != BALL) & (kind != SHARD), first * BAR, colours[:count]),
        (kind == BALL, first * DISC, colours[:count]),
        (kind == SHARD, shards, colours[:count]),
        (cross | pane, second * BAR, colours[count:]),
    ):
        at_px = corners[which] @ place[which, :2] + place[which, 2:]
        outlines = canvas.make_outlines(at_px, inks[which], opacity[which])
        drawn += zip(np.flatnonzero(which).tolist(), outlines, strict=True)
    return [outline for _, outline in sorted(drawn, key=lambda one: one[0])]


def _draw_placements(rng: Generator, canvas: Canvas, count: int) -> Array:
    """Draw (count, 3, 2): a rotation of corners, as rows, followed by a position in the image."""
    upright = rng.random(count) < 0.5
    turn = np.where(upright, rng.normal(0, 0.06, count), rng.uniform(0, np.pi, count))
    c, s = np.cos(turn), np.sin(turn)
    at = rng.random((2, count)) * [[canvas.width_px], [canvas.height_px]]
    return np.array([[c, s], [-s, c], at]).transpose(2, 0, 1)


def _noise_window(rng: Generator, width_px: int, height_px: int, rough: float) -> FloatImage:
    """Return an (H, W * 3) window of grey noise with detail of all sizes."""
    table = _noise_table(width_px, height_px, rough)
    return random_window(rng, table, width_px, height_px)


@cache
def _noise_table(width_px: int, height_px: int, rough: float) -> FloatImage:
    """Return noise of twice the width and height, identical in every process."""
    rng = np.random.default_rng(round(100 * rough))
    return _multiscale_noise(rng, width_px, height_px, rough, KNOTS).repeat(3, axis=1)


@cache
def _tint_table(width_px: int, height_px: int) -> FloatImage:
    """Return weak noise as `_noise_table`, independent per channel and without fine detail."""
    rng = np.random.default_rng(1)
    parts = [0.06 * _multiscale_noise(rng, width_px, height_px, 0.5, KNOTS[:4]) for _ in range(3)]
    return np.stack(parts, axis=2, dtype=np.float32).reshape(len(parts[0]), -1)


def _multiscale_noise(
    rng: Generator, width_px: int, height_px: int, rough: float, knots: tuple[int, ...]
) -> FloatImage:
    """Return (2 H, 2 W) noise. Each scale is linear between its knots."""
    weights = rough ** np.arange(len(knots))
    weights *= 1.5 * NOISE_DEVIATION / np.sqrt((weights**2).sum())
    total = np.zeros((2 * height_px, 2 * width_px), np.float32)
    for weight, rows in zip(weights, knots, strict=True):
        columns = max(rows * width_px // height_px, 2)
        grid = np.float32(weight) * rng.standard_normal((2 * rows, 2 * columns), np.float32)
        total += (
            _interpolation_matrix(2 * height_px, 2 * rows)
            @ grid
            @ _interpolation_matrix(2 * width_px, 2 * columns).T
        )
    return total


def _interpolation_matrix(size: int, knots: int) -> FloatImage:
    """Return a (size, knots) matrix that interpolates knots linearly to pixels."""
    place = np.linspace(0, knots - 1, size)
    return np.asarray(np.maximum(0, 1 - abs(place[:, None] - np.arange(knots))), np.float32)
