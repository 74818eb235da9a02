"""Backgrounds made by code: rooms, gradients, textures and clutter of every size."""

from functools import cache

import numpy as np
from numpy.random import Generator

from dmrl.geometry.frames import Array
from dmrl.rendering.canvas import Canvas, Colour, Picture


def background(rng: Generator, width_px: int, height_px: int) -> Picture:
    """A random background, (height_px, width_px, 3), 0 to 1.

    Parameters
    ----------
    rng
        Where the randomness comes from.
    width_px, height_px
        Size.
    """
    ground = (_gradient, _clouds, _room)[rng.integers(3)](rng, width_px, height_px)
    canvas = Canvas(0, 0, width_px, height_px, fineness=2)
    for _ in range(int(rng.integers(4, 30))):
        _thing(rng, canvas)
    rgb, opacity = canvas.result()
    picture = ground * (1 - opacity) + rgb
    grain = _noise(rng, width_px, height_px, 1, rough=0.85)
    return np.clip(picture * (1 + rng.uniform(0.02, 0.35) * grain), 0, 1).astype(np.float32)


def _colour(rng: Generator) -> Colour:
    """A colour, mostly greyish as rooms are; now and then vivid."""
    grey = rng.uniform(0.03, 0.9)
    return np.clip(grey + rng.normal(0, rng.choice([0.02, 0.05, 0.16]), 3), 0, 1)


def _gradient(rng: Generator, width_px: int, height_px: int) -> Picture:
    angle = rng.uniform(0, 2 * np.pi)
    u = np.linspace(-0.5, 0.5, width_px) * np.cos(angle)
    v = np.linspace(-0.5, 0.5, height_px) * np.sin(angle)
    share = (0.5 + (v[:, None] + u) / 1.42)[..., None]
    return np.asarray(_colour(rng) * share + _colour(rng) * (1 - share), np.float32)


def _clouds(rng: Generator, width_px: int, height_px: int) -> Picture:
    share = 0.5 + 0.5 * _noise(rng, width_px, height_px, 1, rough=rng.uniform(0.4, 0.8))
    tint = 0.06 * _noise(rng, width_px, height_px, 3, rough=0.5)
    return np.asarray(_colour(rng) * share + _colour(rng) * (1 - share) + tint, np.float32)


def _room(rng: Generator, width_px: int, height_px: int) -> Picture:
    """A wall and a floor with boards that meet far away."""
    horizon = height_px * rng.uniform(0.2, 0.8)
    canvas = Canvas(0, 0, width_px, height_px, fineness=2)
    lean = rng.uniform(-0.15, 0.15) * width_px
    edge = np.array([[0, horizon - lean], [width_px, horizon + lean]])
    floor, wall = _colour(rng), _colour(rng)
    below = np.array([[width_px, 3 * height_px], [0, 3 * height_px]])
    canvas.fill(np.concatenate([edge, below]), floor)
    far = np.array([rng.uniform(0, width_px), horizon])
    for u in np.arange(-4, 5) * rng.uniform(0.25, 0.6) * width_px + far[0]:
        board = np.array([far, [u, 2 * height_px], [u + 0.04 * width_px, 2 * height_px]])
        canvas.fill(board, _colour(rng), 0.4)
    rgb, opacity = canvas.result()
    light = 0.12 * _noise(rng, width_px, height_px, 1, rough=0.4)
    return np.asarray((wall + light) * (1 - opacity) + rgb, np.float32)


def _thing(rng: Generator, canvas: Canvas) -> None:
    """Draw something that is not a quadrotor: box, ball, cable, cross, window or shard."""
    at = rng.uniform((0, 0), (canvas.width_px, canvas.height_px))
    size = np.exp(rng.uniform(np.log(4), np.log(110)))
    turn = rng.uniform(0, np.pi) if rng.random() < 0.5 else rng.normal(0, 0.06)
    opacity = rng.choice([1.0, 1.0, rng.uniform(0.3, 1.0)])
    shape = SHAPES[rng.integers(len(SHAPES))]
    for outline in shape(rng, size):
        canvas.fill(outline @ _turn(turn).T + at, _colour(rng), float(opacity))


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
    rng: Generator, width_px: int, height_px: int, channels: int, *, rough: float
) -> Picture:
    """(H, W, channels) noise with detail of every size, standard deviation about 0.4."""
    total = np.zeros((channels, height_px, width_px), np.float32)
    weight = 1.0
    power = 0.0
    for knots in (3, 6, 12, 24, 48, 96):
        across = knots * width_px // height_px
        grid = rng.standard_normal((channels, knots, across), np.float32)
        total += weight * (_stretch(height_px, knots) @ grid @ _stretch(width_px, across).T)
        power += weight**2
        weight *= rough
    total *= np.float32(0.6 / np.sqrt(power))
    return np.moveaxis(total, 0, 2)
