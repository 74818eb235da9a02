"""Backgrounds made by code: rooms, gradients, textures and clutter of every size."""

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.random import Generator

from dmrl.geometry.frames import Array
from dmrl.images.canvas import Canvas, Colour, Picture, bands

KNOTS = (3, 6, 12, 24, 48, 96)
"""Of noise, from top to bottom, by the size of its detail."""
SPREADS = (0.02, 0.05, 0.16)
"""How far a colour is from grey."""


def background(rng: Generator, width_px: int, height_px: int) -> Picture:
    """A random background, (height_px, width_px, 3), 0 to 1.

    Parameters
    ----------
    rng
        Where the randomness comes from.
    width_px, height_px
        Size.
    """
    canvas = (_gradient, _clouds, _room)[rng.integers(3)](rng, width_px, height_px)
    for _ in range(int(rng.integers(4, 30))):
        _thing(rng, canvas)
    picture = canvas.rgb()
    grain = _noise(rng, width_px, height_px, rough=0.85)
    strength = np.float32(rng.uniform(0.02, 0.35))
    for rows in bands(height_px):
        picture[rows] *= (1 + strength * grain[rows].repeat(3, axis=1)).reshape(-1, width_px, 3)
        np.clip(picture[rows], 0, 1, out=picture[rows])
    return picture


def _colour(rng: Generator) -> Colour:
    """A colour, mostly greyish as rooms are; now and then vivid."""
    grey = rng.uniform(0.03, 0.9)
    return np.clip(grey + rng.normal(0, SPREADS[rng.integers(len(SPREADS))], 3), 0, 1)


def _on(ground: Picture) -> Canvas:
    height_px, width_px, _ = ground.shape
    return Canvas(0, 0, width_px, height_px, fineness=2, ground=ground)


def _gradient(rng: Generator, width_px: int, height_px: int) -> Canvas:
    angle = rng.uniform(0, 2 * np.pi)
    u = np.linspace(-0.5, 0.5, width_px, dtype=np.float32) * np.float32(np.cos(angle) / 1.42)
    v = np.linspace(-0.5, 0.5, height_px, dtype=np.float32) * np.float32(np.sin(angle) / 1.42)
    return _on(_between(rng, 0.5 + v[:, None] + u))


def _between(rng: Generator, share: Picture) -> Picture:
    """A mixture of two colours, (H, W, 3)."""
    one, other = _colour(rng), _colour(rng)
    return _tinted(share, one - other, other)


def _tinted(share: Picture, step: Colour, base: Colour) -> Picture:
    """``base + share * step``: (H, W, 3) of (H, W)."""
    # As rows of numbers: NumPy is slow at arrays that end in a side of 3.
    steps, bases = (np.tile(part, share.shape[1]).astype(np.float32) for part in (step, base))
    return np.asarray(share.repeat(3, axis=1) * steps + bases).reshape(*share.shape, 3)


def _clouds(rng: Generator, width_px: int, height_px: int) -> Canvas:
    share = 0.5 + 0.5 * _noise(rng, width_px, height_px, rough=rng.uniform(0.4, 0.8))
    picture = _between(rng, share)
    for channel in range(3):
        picture[..., channel] += _noise(
            rng, width_px, height_px, rough=0.5, deviation=0.024, knots=KNOTS[:4]
        )
    return _on(picture)


def _room(rng: Generator, width_px: int, height_px: int) -> Canvas:
    """A wall and a floor with boards that meet far away."""
    horizon = height_px * rng.uniform(0.2, 0.8)
    floor, wall = _colour(rng), _colour(rng)
    light = np.float32(0.12) * _noise(rng, width_px, height_px, rough=0.4)
    canvas = _on(_tinted(light, np.ones(3), wall))
    lean = rng.uniform(-0.15, 0.15) * width_px
    edge = np.array([[0, horizon - lean], [width_px, horizon + lean]])
    below = np.array([[width_px, 3 * height_px], [0, 3 * height_px]])
    canvas.fill(np.concatenate([edge, below]), floor)
    far = np.array([rng.uniform(0, width_px), horizon])
    for u in np.arange(-4, 5) * rng.uniform(0.25, 0.6) * width_px + far[0]:
        board = np.array([far, [u, 2 * height_px], [u + 0.04 * width_px, 2 * height_px]])
        canvas.fill(board, _colour(rng), 0.4)
    return canvas


def _thing(rng: Generator, canvas: Canvas) -> None:
    """Draw something that is not a quadrotor: box, ball, cable, cross, window or shard."""
    at = rng.uniform((0, 0), (canvas.width_px, canvas.height_px))
    size = np.exp(rng.uniform(np.log(4), np.log(110)))
    turn = rng.uniform(0, np.pi) if rng.random() < 0.5 else rng.normal(0, 0.06)
    opacity = rng.uniform(0.3, 1.0) if rng.integers(3) == 0 else 1.0
    shape = SHAPES[rng.integers(len(SHAPES))]
    for outline in shape(rng, size):
        canvas.fill(outline @ _turn(turn).T + at, _colour(rng), opacity)


def _turn(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


def _bar(width_px: float, height_px: float) -> Array:
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (width_px / 2, height_px / 2)


def _ellipse(half_width_px: float, half_height_px: float) -> Array:
    turn = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    return np.stack([np.cos(turn) * half_width_px, np.sin(turn) * half_height_px], axis=1)


def _box(rng: Generator, size_px: float) -> list[Array]:
    return [_bar(size_px, size_px * rng.uniform(0.2, 1.5))]


def _ball(rng: Generator, size_px: float) -> list[Array]:
    return [_ellipse(size_px / 2, size_px / 2 * rng.uniform(0.3, 1))]


def _cable(rng: Generator, size_px: float) -> list[Array]:
    return [_bar(size_px * 4, max(size_px * rng.uniform(0.01, 0.05), 0.7))]


def _cross(rng: Generator, size_px: float) -> list[Array]:
    thin_px = size_px * rng.uniform(0.02, 0.1)
    return [_bar(size_px, thin_px), _bar(thin_px, size_px)]


def _window(rng: Generator, size_px: float) -> list[Array]:
    inner_px = size_px * rng.uniform(0.75, 0.92)
    return [_bar(size_px, size_px), _bar(inner_px, inner_px)]


def _shard(rng: Generator, size_px: float) -> list[Array]:
    return [rng.normal(0, size_px / 2, (3, 2))]


SHAPES = (_box, _ball, _cable, _cross, _window, _shard)


@cache
def _stretch(size: int, knots: int) -> Picture:
    """(size, knots) matrix that interpolates knots linearly to pixels."""
    place = np.linspace(0, knots - 1, size)
    return np.asarray(np.maximum(0, 1 - abs(place[:, None] - np.arange(knots))), np.float32)


def _noise(
    rng: Generator,
    width_px: int,
    height_px: int,
    *,
    rough: float,
    deviation: float = 0.4,
    knots: Sequence[int] = KNOTS,
) -> Picture:
    """(H, W) noise with detail of every size, or of some."""
    across = [rows * width_px // height_px for rows in knots]
    weights = rough ** np.arange(len(knots))
    weights *= 1.5 * deviation / np.sqrt((weights**2).sum())
    detail = [
        np.float32(weight)
        * (_stretch(height_px, rows) @ rng.standard_normal((rows, columns), np.float32))
        for weight, rows, columns in zip(weights, knots, across, strict=True)
    ]
    # All sizes of detail in one product.
    return np.asarray(np.concatenate(detail, axis=1) @ _stretches(width_px, tuple(across)))


@cache
def _stretches(size: int, knots: tuple[int, ...]) -> Picture:
    return np.concatenate([_stretch(size, one) for one in knots], axis=1).T.copy()
