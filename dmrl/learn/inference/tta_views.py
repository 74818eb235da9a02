"""Views of an image for test-time augmentation. Imports nothing heavy: help shows how many."""

from typing import NamedTuple


class View(NamedTuple):
    """A view of an image: mirrored or not, then shifted right and down by these parts of a cell."""

    mirrored: bool
    right: float
    down: float


SHIFTS = ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5), (-0.25, 0.25), (0.25, -0.25))
VIEWS = tuple(View(mirrored, *shift) for shift in SHIFTS for mirrored in (False, True))
"""All views; the first is the unchanged image."""
