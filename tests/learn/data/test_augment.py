"""Augmented images and labels, measured on bright squares."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from dmrl.learn.data import augment
from dmrl.learn.data.augment import Augmentation, Augmenter
from dmrl.learn.data.batches import ROBOT_FIELDS, ExampleSet
from dmrl.learn.data.crops import RobotRow, apply_homography, rotation_to_pixel
from dmrl.learn.training.config import TrainConfig

from ..squares import (
    GEOMETRY,
    SIDE_M,
    augment_batches,
    build_augmenter,
    draw_squares,
    select_single_robots,
)


@pytest.mark.heavy
def test_labels_stay_at_the_robots_and_depth_follows_the_zoom() -> None:
    settings = replace(GEOMETRY, mosaic_share=0.0, paste=0.0)
    checked = 0
    for batch in augment_batches(settings, 30):
        for image, robot in select_single_robots(batch):
            mass = image.sum()
            v, u = np.indices(image.shape) + 0.5
            at = np.array([(u * image).sum(), (v * image).sum()]) / mass
            side = math.sqrt(mass / 255)
            np.testing.assert_allclose(at, robot[:2], atol=0.35)
            assert side * robot[2] == pytest.approx(SIDE_M, rel=0.05)
            checked += 1
    assert checked > 100


@pytest.mark.heavy
def test_depths_stay_in_the_range_of_the_labels() -> None:
    depths = [
        batch.robots[..., 2]
        for batch in augment_batches(replace(GEOMETRY, zoom=(0.2, 5.0), paste=0.0))
    ]
    found = torch.cat(depths).flatten()
    found = found[torch.isfinite(found)]
    assert found.max() <= SIDE_M / 8 * 1.1 * 1.001
    assert found.min() >= SIDE_M / 24 / 1.1 * 0.999
    assert found.min() < 0.6
    assert found.max() > 1.3


@pytest.mark.heavy
def test_sigmas_follow_the_zoom() -> None:
    for batch in augment_batches(replace(GEOMETRY, mosaic_share=0.0, paste=0.0), 3):
        robots = batch.robots[torch.isfinite(batch.robots[..., 0])]
        zoom = robots[:, 3]
        assert zoom.min() < 1.1 < 1.3 < zoom.max()
        torch.testing.assert_close(robots[:, 4], zoom)
        torch.testing.assert_close(robots[:, 5], 0.1 / zoom)


def test_a_batch_depends_only_on_seed_epoch_and_index() -> None:
    examples = draw_squares()
    everything = replace(GEOMETRY, colour=0.1, noise=0.05, blur_share=0.5)
    first, again = (Augmenter(examples, everything, seed=3) for _ in range(2))
    first.augment_batch([5], epoch=0, index=0)
    a, b = (x.augment_batch([1, 2], epoch=2, index=7) for x in (first, again))
    assert torch.equal(a.images, b.images)
    assert torch.equal(a.robots.nan_to_num(), b.robots.nan_to_num())
    other = again.augment_batch([1, 2], epoch=2, index=8)
    assert not torch.equal(a.images, other.images)


def test_images_without_robots_can_be_augmented() -> None:
    empty = ExampleSet(
        [np.zeros((2, 112, 160, 3), np.uint8)],
        np.full((2, 1, len(ROBOT_FIELDS)), np.nan, np.float32),
    )
    batch = Augmenter(empty, GEOMETRY, seed=0).augment_batch([0, 1], epoch=0, index=0)
    assert not torch.isfinite(batch.robots[..., 0]).any()
    assert batch.images.shape == (2, 3, 112, 160)


def test_default_augmentation_is_identity() -> None:
    assert Augmentation().is_identity
    assert not replace(Augmentation(), flip_share=0.1).is_identity


def test_noise_differs_between_epochs_and_stays_below_its_std() -> None:
    grey = ExampleSet(
        [np.full((1, 112, 160, 3), 128, np.uint8)],
        np.full((1, 1, len(ROBOT_FIELDS)), np.nan, np.float32),
    )
    maker = Augmenter(grey, Augmentation(noise=0.05), seed=0)
    first, second = (maker.augment_batch([0] * 8, epoch=epoch, index=0).images for epoch in (0, 1))
    assert not torch.equal(first, second)
    loud = first.float().sub(128).std(dim=(1, 2, 3)) / 255
    # Each image draws its standard deviation, up to the configured one.
    assert 0.5 * 0.05 < loud.max() < 1.02 * 0.05


def test_every_augmentation_key_changes_its_own_property() -> None:
    values = {
        "flip_share": 0.11,
        "zoom": (0.7, 1.3),
        "rotation_deg": 5.0,
        "mosaic_share": 0.22,
        "paste": 0.33,
        "colour": 0.044,
        "noise": 0.055,
        "blur_share": 0.66,
        "intrinsics": (1.0, 2.0, 3.0, 4.0),
        "grey_share": 0.77,
    }
    made = TrainConfig(**values).augmentation(0)  # type: ignore[arg-type]
    assert {field.name: getattr(made, field.name) for field in fields(made)} == values


@pytest.mark.heavy
def test_a_grey_share_of_images_has_no_colours() -> None:
    settings = Augmentation(colour=0.2, noise=0.02, grey_share=0.5)
    images = torch.cat([batch.images for batch in augment_batches(settings)]).float()
    grey = (images.amax(dim=1) == images.amin(dim=1)).flatten(1).all(dim=1)
    assert 0.4 < grey.float().mean() < 0.6
    whole = torch.cat(
        [batch.images for batch in augment_batches(replace(settings, grey_share=1.0), 1)]
    )
    assert (whole.amax(dim=1) == whole.amin(dim=1)).all()


def build_robot(depth_m: float) -> RobotRow:
    """Return a label row that knows only its depth."""
    return [0.0, 0.0, depth_m, *[0.0] * (len(ROBOT_FIELDS) - 3)]


@pytest.mark.parametrize(
    ("depth_m", "low", "high"),
    [
        (None, 0.25, 8.0),
        (2.0, 2 / 4.4, 2.2),  # to 1 m less a tenth and to 4 m plus a tenth
        (1.0, 0.25, 1.1),
        (4.0, 4 / 4.4, 4.4),
        (0.5, 0.25, 1.0),  # it is nearer than any label, so it comes no nearer
        (9.0, 1.0, 8.0),
    ],
)
def test_zoom_keeps_depths_within_the_range_of_the_labels(
    depth_m: float | None, low: float, high: float
) -> None:
    maker, rng = build_augmenter(zoom=(0.25, 8.0)), np.random.default_rng(1)
    robot = None if depth_m is None else build_robot(depth_m)
    drawn = np.log([maker._sample_zoom(robot, rng) for _ in range(2000)])
    assert np.exp(drawn.min()) == pytest.approx(low, rel=0.02)
    assert np.exp(drawn.max()) == pytest.approx(high, rel=0.02)
    assert drawn.mean() == pytest.approx((np.log(low) + np.log(high)) / 2, abs=0.1)


def test_rotations_have_both_signs_and_a_share_is_mirrored() -> None:
    maker, rng = build_augmenter(rotation_deg=20.0, flip_share=0.25), np.random.default_rng(2)
    turns = np.array([maker._sample_rotation(2.0, rng) for _ in range(2000)])
    assert np.linalg.det(turns) == pytest.approx(np.where(np.linalg.det(turns) > 0, 0.25, -0.25))
    assert (np.linalg.det(turns) < 0).mean() == pytest.approx(0.25, abs=0.03)
    # A mirror changes the first column only, so the second gives the angle.
    angle = np.degrees(np.arctan2(-turns[:, 0, 1], turns[:, 1, 1]))
    assert (angle.min(), angle.max()) == pytest.approx((-20, 20), abs=0.2)
    assert angle.mean() == pytest.approx(0, abs=1)


def test_colour_jitter_changes_brightness_and_contrast_about_mid_grey() -> None:
    maker, rng = build_augmenter(colour=0.1), np.random.default_rng(3)
    grey, bright = [], []
    for _ in range(3000):
        pixels = np.array([[[128] * 3, [178] * 3]], np.uint8)
        pixels = maker._jitter_colours(pixels, rng).astype(float)
        grey.append(pixels[0, 0])
        bright.append((pixels[0, 1] - pixels[0, 0]) / 50)
    assert np.std(grey, axis=0) == pytest.approx([12.8] * 3, rel=0.06)
    assert np.ptp(grey, axis=1).max() == 0  # Mid-grey becomes lighter or darker, not coloured.
    gain = np.log(bright)
    assert gain.mean(axis=1).std() == pytest.approx(np.hypot(0.1, 0.05 / 3**0.5), rel=0.06)
    assert (gain - gain.mean(axis=1, keepdims=True)).std() == pytest.approx(
        0.05 * (2 / 3) ** 0.5, rel=0.06
    )


def test_defocus_blurs_a_point_symmetrically() -> None:
    maker, rng, middles = build_augmenter(blur_share=0.5), np.random.default_rng(4), []
    for _ in range(600):
        canvas = np.zeros((7, 9, 3), np.uint8)
        canvas[3, 4] = 250
        maker._degrade_image(canvas, rng)
        seen = canvas[..., 0].astype(int)
        assert seen.sum() == pytest.approx(250, abs=4.5)  # Nine pixels are rounded.
        assert (seen == seen[::-1]).all() and (seen == seen[:, ::-1]).all()
        assert not seen[:, [0, 1, 2, 6, 7, 8]].any() and not seen[[0, 1, 5, 6]].any()
        middles.append(float(np.sqrt(seen[3, 4] / 250)))
    blurred = [1 - middle for middle in middles if middle < 0.999]
    assert len(blurred) / 600 == pytest.approx(0.5, abs=0.06)
    assert (min(blurred), max(blurred)) == pytest.approx((0.2, 2 / 3), abs=0.02)


def test_without_geometry_keeps_photometric_settings_only() -> None:
    every = replace(GEOMETRY, colour=0.1, noise=0.2, blur_share=0.3, grey_share=0.4)
    wanted = Augmentation(flip_share=0.5, colour=0.1, noise=0.2, blur_share=0.3, grey_share=0.4)
    assert every.without_geometry == wanted


def test_camera_is_turned_only_where_depths_keep_a_quarter_of_the_largest() -> None:
    camera, rng = (60.0, 64.0, 80.0, 56.0), np.random.default_rng(5)
    maker, kept = build_augmenter(intrinsics=camera), []
    k = np.array([[60.0, 0, 80], [0, 64, 56], [0, 0, 1]])
    for _ in range(300):
        left, top = rng.integers(0, 60, 2).tolist()
        rect = (left, top, left + int(rng.integers(20, 100)), top + int(rng.integers(20, 50)))
        size = np.array([rect[2] - left, rect[3] - top])
        seen = (rng.uniform(-100, 260), rng.uniform(-100, 210))
        shown = (size[0] * rng.random(), size[1] * rng.random())
        turn = (
            rotation_to_pixel(camera, seen)
            @ rotation_to_pixel(camera, (shown[0] + left, shown[1] + top)).T
        )
        corners = np.array([[x, y, 1.0] for x in (left, rect[2]) for y in (top, rect[3])])
        ahead = (turn @ np.linalg.inv(k) @ corners.T)[2]
        window = maker._build_window(((1.0, 0.0), (0.0, 1.0)), 1.0, seen, shown, rect)
        kept.append(window.camera is not None)
        assert kept[-1] == (ahead.min() > 0.25 * ahead.max())
        found = apply_homography(window.matrix.tolist(), *shown)
        assert found == pytest.approx(seen, abs=1e-6)
    assert 0.2 < np.mean(kept) < 0.9


def test_window_is_turned_about_the_new_position_of_the_robot(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    maker, rng, asked = (
        build_augmenter(zoom=(1.0, 2.0), rotation_deg=20.0, flip_share=0.5),
        np.random.default_rng(6),
        [],
    )
    made = maker._build_window
    monkeypatch.setattr(maker, "_build_window", lambda *given: asked.append(given) or made(*given))
    robot, whole = maker._examples.robots[0, 0], (0, 0, 160, 112)
    shown_at = []
    for _ in range(60):
        found = maker._draw_layer(np.empty((112, 160, 3), np.uint8), whole, 0, [], rng)
        _, _, seen, shown, _ = asked[-1]
        if len(found):
            np.testing.assert_allclose(seen, robot[:2])
            np.testing.assert_allclose(found[0][:2], shown, atol=1e-3)
            shown_at.append(shown)
    assert len(shown_at) > 40  # Most windows show the robot.
    assert np.std(shown_at, axis=0).min() > 2  # The position varies.


def draw_layers(
    maker: Augmenter, rect: tuple[int, int, int, int], monkeypatch: pytest.MonkeyPatch, focus: float
) -> list[tuple[float, NDArray[np.float64], NDArray[np.float64]]]:
    """Return (zoom, corners (2, 2), position (2,) of its robot) of 300 windows of the first image.

    Corners are pixels of the source; the position is in pixels of the window. A share `focus` of
    the windows must show the robot.
    """
    monkeypatch.setattr(augment, "FOCUS_FRACTION", focus)
    asked: list[tuple[NDArray[np.float64], float, NDArray[np.float64], NDArray[np.float64]]] = []
    made = maker._build_window

    def window(*given: object) -> object:
        asked.append(given[:4])  # type: ignore[arg-type]
        return made(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(maker, "_build_window", window)
    monkeypatch.setattr(maker, "_render_window", lambda *given: given[5])
    rng = np.random.default_rng(8)
    size = np.array([rect[2] - rect[0], rect[3] - rect[1]])
    found, canvas = [], np.empty((112, 160, 3), np.uint8)
    for _ in range(300):
        maker._draw_layer(canvas, rect, 0, [], rng)
        turn, zoom, seen, shown = map(np.asarray, asked[-1])
        corners = np.array([seen + turn @ (at - shown) for at in (0 * size, size)])
        robot = maker._examples.robots[0, 0, :2]
        found.append((float(zoom), corners, np.linalg.inv(turn) @ (robot - seen) + shown))
    return found


@pytest.mark.parametrize("rect", [(0, 0, 160, 112), (20, 10, 120, 66), (5, 7, 45, 107)])
def test_crop_windows_cover_their_source_without_leaving_it(
    rect: tuple[int, int, int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    maker = build_augmenter(zoom=(1.5, 2.5))
    maker._examples.robots[0, 0, :3] = 90.0, 40.0, 2.0
    size, whole = np.array([rect[2] - rect[0], rect[3] - rect[1]]), np.array([160, 112])
    for focus in (0.0, 1.0):
        found = draw_layers(maker, rect, monkeypatch, focus)
        zooms = np.array([zoom for zoom, _, _ in found])
        # At zoom 2.2 the robot, 2 m away, is a tenth nearer than the nearest label of 1 m.
        assert (zooms.min(), zooms.max()) == pytest.approx((1.5, 2.2), abs=0.02)
        low, high = (np.array([corners[k] for _, corners, _ in found]) for k in (0, 1))
        assert high - low == pytest.approx(size / zooms[:, None])
        assert (low > -1e-9).all() and (high < whole + 1e-9).all()
        at = np.array([place for _, _, place in found])
        held = ((at >= 0) & (at <= size)).all(axis=1)
        # Windows are spread evenly over all positions that they may take.
        place = low / (whole - (high - low))
        if focus:
            assert held.all()
            assert at.min(axis=0) == pytest.approx(
                np.maximum(0, size - (whole - [90, 40]) * 2.2), abs=3
            )
        else:
            assert not held.all()
            assert place.min(axis=0) == pytest.approx([0, 0], abs=0.03)
            assert place.max(axis=0) == pytest.approx([1, 1], abs=0.03)
            assert place.mean(axis=0) == pytest.approx([0.5, 0.5], abs=0.05)


@pytest.mark.heavy
def test_zoom_is_limited_so_that_a_window_stays_within_its_source(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for rect, least in (((0, 0, 160, 112), 1.0), ((0, 0, 80, 112), 1.0), ((0, 0, 120, 28), 0.75)):
        found = draw_layers(build_augmenter(zoom=(0.1, 0.2)), rect, monkeypatch, 0.0)
        assert {zoom for zoom, _, _ in found} == {least}


@pytest.mark.heavy
def test_noise_pattern_starts_at_a_random_offset() -> None:
    maker, rng = build_augmenter(noise=0.1), np.random.default_rng(4)
    assert len(maker._grain) == 2 * 112 * 160 * 3
    assert maker._grain.std() == pytest.approx(1, abs=0.01)
    canvases = []
    for _ in range(40):
        canvases.append(np.full((112, 160, 3), 128, np.uint8))
        maker._degrade_image(canvases[-1], rng)
    noise = np.array(canvases).reshape(40, -1) - 128.0
    # Noise is rounded to the nearest integer, so it has no bias.
    assert np.abs(noise.mean(axis=1)).max() < 0.5
    loud = noise.std(axis=1) / 25.5
    assert 0 <= loud.min() < 0.3 and 0.7 < loud.max() <= 1.01
    # Find the offset into the pattern from the first pixels of each canvas.
    views = np.lib.stride_tricks.sliding_window_view(maker._grain, 12)
    begun = {
        int((views @ row[:12]).argmax()) for row, s in zip(noise, loud, strict=True) if s > 0.3
    }
    assert len(begun) > 20 and max(begun) > 20_000 > min(begun)
