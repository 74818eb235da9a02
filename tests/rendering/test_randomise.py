"""Looks drawn at random."""

import numpy as np

from dmrl.rendering.crazyflie import MATERIALS
from dmrl.rendering.randomise import PALETTE, strong_colours


def test_strong_colours_are_two_hues_over_every_part_that_does_not_glow() -> None:
    paint = strong_colours(np.random.default_rng(3))
    dull = {f"colour_{k}" for k, name in enumerate(MATERIALS) if not PALETTE[name][3]}
    assert paint.keys() == dull
    hues = {tuple(np.round(np.array(c) / max(c), 6)) for c in paint.values() if max(c) < 1}
    assert len(hues) == 2


def test_two_robots_are_not_painted_alike() -> None:
    rng = np.random.default_rng(3)
    assert strong_colours(rng) != strong_colours(rng)
