"""Patches of robots pasted into other images, and mosaics of images."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from dmrl.learn.data import augment
from dmrl.learn.data.augment import Augmentation, Augmenter
from dmrl.learn.data.batches import ROBOT_FIELDS, ExampleSet
from dmrl.learn.data.crops import Point, RobotRow, apply_homography, build_feather_mask

from .squares import GEOMETRY, augment_batches, build_augmenter, draw_squares


@pytest.mark.heavy
@pytest.mark.parametrize("intrinsics", [None, (70.0, 70.0, 80.0, 56.0)])
def test_pasted_robots_are_labelled_and_covered_ones_are_not(
    intrinsics: tuple[float, float, float, float] | None,
) -> None:
    for batch in augment_batches(
        replace(GEOMETRY, rotation_deg=0.0, paste=2.0, intrinsics=intrinsics)
    ):
        bright = batch.images[:, 0].numpy()
        for image, robots in zip(bright, batch.robots.numpy(), strict=True):
            for robot in robots[np.isfinite(robots[:, 0])]:
                u, v = np.clip(robot[:2].astype(int), 0, (159, 111))
                near = image[max(v - 2, 0) : v + 3, max(u - 2, 0) : u + 3]
                assert near.max() > 120


def test_robot_with_a_mask_is_pasted_without_background(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(augment, "DISTRACTOR_FRACTION", 0.0)
    plain = draw_squares()
    grey = np.maximum(plain.pixels[0], 60)
    masks = (grey[..., 0] == 255).astype(np.uint8)
    settings = replace(Augmentation(), paste=1.0)
    canvases = []
    for known in ([], [masks, np.zeros_like(masks)]):
        examples = ExampleSet([grey, np.zeros_like(grey)], add_empty_robots(plain), known)
        canvases.append(
            Augmenter(examples, settings, seed=0).augment_batch(range(24, 48), epoch=0, index=0)
        )
    around, cut = (batch.images[:, 0].numpy() for batch in canvases)
    assert ((around > 50) & (around < 70)).sum() > 500
    # Only the pixels at the edge of the mask mix robot and canvas.
    assert ((cut > 50) & (cut < 70)).sum() < 0.1 * (cut > 200).sum()
    for image, robots in zip(cut, canvases[1].robots.numpy(), strict=True):
        for robot in robots[np.isfinite(robots[:, 0])]:
            assert image[int(robot[1]), int(robot[0])] > 200


def add_empty_robots(plain: ExampleSet) -> NDArray[np.float32]:
    """Return the robots of a set, followed by as many images without robots."""
    return np.concatenate([plain.robots, np.full_like(plain.robots, np.nan)])


def test_labels_per_augmented_image_are_limited() -> None:
    crowd = draw_squares(1)
    robots = np.repeat(crowd.robots[:, :1], augment.MAX_ROBOTS_PER_IMAGE + 3, axis=1)
    maker = Augmenter(ExampleSet(crowd.pixels, robots), Augmentation(flip_share=0.5), seed=0)
    batch = maker.augment_batch([0], epoch=0, index=0)
    assert batch.robots.shape == (1, augment.MAX_ROBOTS_PER_IMAGE, len(ROBOT_FIELDS))
    assert torch.isfinite(batch.robots[..., 0]).all()


class Patches:
    """The patches that an augmenter pastes into 300 canvases, recorded instead of drawn.

    Of each patch: its rectangle, its source image, the source pixel at its middle, its zoom and
    the robots it may show.
    """

    def __init__(self, maker: Augmenter, monkeypatch: pytest.MonkeyPatch) -> None:
        self.rects: list[tuple[int, int, int, int]] = []
        self.sources: list[int] = []
        self.middles: list[Point] = []
        self.zooms: list[float] = []
        self.mine: list[list[RobotRow]] = []

        def show(*given: object) -> object:
            _, rect, source, window, mine, robots, _, opacity = given
            left, top, right, bottom = rect  # type: ignore[misc]
            self.rects.append((left, top, right, bottom))
            self.sources.append(source)  # type: ignore[arg-type]
            matrix = window.matrix.tolist()  # type: ignore[attr-defined]
            self.middles.append(apply_homography(matrix, (right - left) / 2, (bottom - top) / 2))
            self.zooms.append(window.zoom)  # type: ignore[attr-defined]
            self.mine.append(mine)  # type: ignore[arg-type]
            if len(self.rects) < 20:
                np.testing.assert_array_equal(
                    opacity, build_feather_mask(bottom - top, right - left)
                )
            return robots

        monkeypatch.setattr(maker, "_render_window", show)
        rng = np.random.default_rng(9)
        canvas = np.empty((112, 160, 3), np.uint8)
        for _ in range(300):
            maker._paste_patch(canvas, [], rng)


def build_boxed_examples() -> ExampleSet:
    """Return two images of 112 x 160 px with a robot each.

    Only the robot of the second image has a box: 24 x 10 px about (70, 33).
    """
    robots = np.full((2, 2, len(ROBOT_FIELDS)), np.nan, np.float32)
    robots[0, 0, :6] = 30, 30, 2, 0, 0, 0
    robots[1, 1, :10] = 71, 30, 2, 0, 0, 0, 58, 28, 82, 38
    return ExampleSet([np.zeros((2, 112, 160, 3), np.uint8)], robots)


def test_patch_is_a_quarter_larger_than_its_robot_and_pasted_anywhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(augment, "DISTRACTOR_FRACTION", 0.0)
    found = Patches(
        Augmenter(build_boxed_examples(), Augmentation(zoom=(0.5, 2.0)), seed=0), monkeypatch
    )
    assert len(found.rects) == 300 and set(found.sources) == {1}
    assert (min(found.zooms), max(found.zooms)) == pytest.approx((1 / 1.1, 1.1), abs=0.004)
    rects, zooms = np.array(found.rects), np.array(found.zooms)[:, None]
    size = rects[:, 2:] - rects[:, :2]
    assert (size == np.ceil(zooms * 1.25 * np.array([24, 10])) + 8).all()
    room = np.array([160, 112]) - size
    assert (rects[:, :2] >= 0).all() and (rects[:, :2] <= room).all()
    place = rects[:, :2] / room
    assert (place.min(axis=0).max(), place.max(axis=0).min()) == pytest.approx((0, 1), abs=0.02)
    assert place.mean(axis=0) == pytest.approx([0.5, 0.5], abs=0.05)
    away = np.array(found.middles) - [70, 33]
    assert away.min(axis=0) == pytest.approx([-2, -2], abs=0.1)
    assert away.max(axis=0) == pytest.approx([2, 2], abs=0.1)
    assert all(len(mine) == 1 and mine[0][0] == 71 for mine in found.mine)


def test_distractor_patches_come_from_anywhere_in_any_image(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(augment, "DISTRACTOR_FRACTION", 1.0)
    found = Patches(Augmenter(build_boxed_examples(), Augmentation(), seed=0), monkeypatch)
    assert np.mean(found.sources) == pytest.approx(0.5, abs=0.06)
    assert {
        (source, mine[0][0]) for source, mine in zip(found.sources, found.mine, strict=True)
    } == {
        (0, 30.0),
        (1, 71.0),
    }
    middles = np.array(found.middles)
    assert middles.min(axis=0) == pytest.approx([0, 0], abs=2)
    assert middles.max(axis=0) == pytest.approx([160, 112], abs=2)
    monkeypatch.setattr(augment, "DISTRACTOR_FRACTION", 0.25)
    shares = Patches(Augmenter(build_boxed_examples(), Augmentation(), seed=0), monkeypatch)
    assert np.mean(shares.sources) == pytest.approx(1 - 0.25 / 2, abs=0.06)


def test_a_robot_too_large_for_the_canvas_is_not_pasted(monkeypatch: pytest.MonkeyPatch) -> None:
    # A patch is 1.25 times the box and 8 px wider: 160 px, the canvas, at 121.6 px.
    for width, count in ((121.6, 300), (121.7, 0)):
        examples = build_boxed_examples()
        examples.robots[1, 1, 6:10] = 0, 20, width, 40
        assert len(Patches(Augmenter(examples, Augmentation(), seed=0), monkeypatch).rects) == count


def test_a_mosaic_shows_other_images_in_its_other_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    maker = Augmenter(draw_squares(5), Augmentation(mosaic_share=0.5), seed=0)
    rng, shown = np.random.default_rng(3), []
    monkeypatch.setattr(
        maker, "_draw_layer", lambda _, rect, source, *rest: shown.append((rect, source))
    )
    monkeypatch.setattr(maker, "_degrade_image", lambda *_: None)
    counts = []
    for _ in range(300):
        shown.clear()
        maker._draw_canvas(np.empty((112, 160, 3), np.uint8), 4, rng)
        counts.append(len(shown))
        assert shown[0][1] == 4
        area = sum((r - left) * (b - top) for (left, top, r, b), _ in shown)
        assert area == 160 * 112
        assert all(0 <= source < 5 for _, source in shown)
    assert set(counts) == {1, 2, 4}
    assert np.mean([count == 1 for count in counts]) == pytest.approx(0.5, abs=0.08)


def test_patch_probability_is_met(monkeypatch: pytest.MonkeyPatch) -> None:
    maker, rng, asked = build_augmenter(paste=1.5), np.random.default_rng(3), []
    monkeypatch.setattr(maker, "_paste_patch", lambda canvas, robots, _: asked.append(1) or robots)
    for _ in range(400):
        maker._draw_canvas(np.zeros((112, 160, 3), np.uint8), 0, rng)
    assert len(asked) / 400 == pytest.approx(1.5, abs=0.15)


def test_patches_are_pasted_at_every_position(monkeypatch: pytest.MonkeyPatch) -> None:
    examples = build_boxed_examples()
    # With its margin the patch takes 152 x 108 of 160 x 112 px.
    examples.robots[1, 1, 6:10] = 20, 20, 135, 100
    found = Patches(Augmenter(examples, Augmentation(), seed=0), monkeypatch)
    assert {rect[0] for rect in found.rects} == set(range(9))
    assert {rect[1] for rect in found.rects} == set(range(5))
    assert {(rect[2] - rect[0], rect[3] - rect[1]) for rect in found.rects} == {(152, 108)}
