"""Images of bright squares, and augmentations of them."""

import numpy as np
from numpy.typing import NDArray

from dmrl.learn.data.augment import Augmentation, Augmenter
from dmrl.learn.data.batches import ROBOT_FIELDS, Batch, ExampleSet

GEOMETRY = Augmentation(
    flip_share=0.5, zoom=(0.6, 1.6), rotation_deg=15.0, mosaic_share=0.5, paste=1.0
)
SIDE_M = 12.0
"""A square with sides of s pixels stands for a robot at a depth of SIDE_M / s."""


def draw_squares(count: int = 24, seed: int = 0) -> ExampleSet:
    """Return dark images, 112 x 160 px, of one bright square each, whose side gives its depth.

    Each label has a second, empty robot. Its sigmas are 1 px and 0.1 m.
    """
    rng = np.random.default_rng(seed)
    pixels = np.zeros((count, 112, 160, 3), np.uint8)
    robots = np.full((count, 2, len(ROBOT_FIELDS)), np.nan, np.float32)
    for k in range(count):
        side = int(rng.integers(8, 25))
        left, top = int(rng.integers(2, 158 - side)), int(rng.integers(2, 110 - side))
        pixels[k, top : top + side, left : left + side] = 255
        centre = (left + side / 2, top + side / 2, SIDE_M / side, 1.0, 1.0, 0.1)
        robots[k, 0] = (*centre, left, top, left + side, top + side, 0)
    return ExampleSet([pixels], robots)


def augment_batches(settings: Augmentation, count: int = 10) -> list[Batch]:
    """Return augmented batches of all 24 squares."""
    maker = Augmenter(draw_squares(), settings, seed=0)
    return [maker.augment_batch(range(24), epoch=0, index=k) for k in range(count)]


def build_augmenter(**settings: object) -> Augmenter:
    """Return an augmenter of two squares, labelled 1 and 4 m away, by fields of Augmentation."""
    examples = draw_squares(2)
    examples.robots[:, 0, 2] = 1.0, 4.0
    return Augmenter(examples, Augmentation(**settings), seed=0)  # type: ignore[arg-type]


def select_single_robots(batch: Batch) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return (first channel (112, 160), robot) of images with one whole robot.

    The robot must be at least one and a half times its half side from the edge.
    """
    out = []
    for image, robots in zip(batch.images.numpy(), batch.robots.numpy(), strict=True):
        found = robots[np.isfinite(robots[:, 0])].astype(np.float64)
        if len(found) != 1:
            continue
        half = SIDE_M / found[0, 2]
        margin = np.array([[found[0, 0], 160 - found[0, 0]], [found[0, 1], 112 - found[0, 1]]])
        if (margin > 1.5 * half).all():
            out.append((image[0].astype(np.float64), found[0]))
    return out
