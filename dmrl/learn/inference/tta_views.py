"""Views of an image for test-time augmentation. Imports nothing heavy: help shows how many."""

from typing import NamedTuple


class TtaView(NamedTuple):
    """A view of an image: mirrored or not, then shifted right and down by these parts of a cell."""

    mirrored: bool
    right: float
    down: float


VIEW_SHIFTS = ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5), (-0.25, 0.25), (0.25, -0.25))
TTA_VIEWS = tuple(TtaView(mirrored, *shift) for shift in VIEW_SHIFTS for mirrored in (False, True))
"""All views; the first is the unchanged image."""
