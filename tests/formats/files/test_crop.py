"""Crops of larger images, with their labels and calibration."""

import numpy as np
import pytest

from dmrl.formats.files.label_csv import LabelRow
from dmrl.formats.files.pictures import Crop
from dmrl.geometry.frames import Camera, pixels_from_horizontal

WIDE, HIGH = Crop(1000, 500, 320, 240), Crop(400, 900, 320, 240)


@pytest.mark.parametrize(
    ("crop", "scale", "corner_px"),
    [(WIDE, 0.48, (500 - 320 / 0.96, 0.0)), (HIGH, 0.8, (0.0, 450 - 120 / 0.8))],
)
def test_the_largest_centred_part_is_kept(
    crop: Crop, scale: float, corner_px: tuple[float, float]
) -> None:
    assert crop.scale == scale
    assert crop.corner_px == pytest.approx(corner_px)
    assert crop.changes
    assert not Crop(320, 240, 320, 240).changes


@pytest.mark.parametrize("crop", [WIDE, HIGH])
def test_a_label_goes_where_the_camera_of_the_result_sees_it(crop: Crop) -> None:
    whole = Camera(crop.from_width_px, crop.from_height_px, 410.0, 390.0, 520.0, 260.0, (-0.1,))
    xyz, level = np.array([[2.0, 0.2, -0.3]]), np.zeros(1)
    (before,), _, _ = pixels_from_horizontal(xyz, level, level, whole)
    (after,), _, _ = pixels_from_horizontal(xyz, level, level, crop.crop_camera(whole))
    row = crop.crop_label(LabelRow("a.png", "cf2", *before.tolist(), 2.0, sigmas=(5.0, 10.0, 0.1)))
    assert (row.u_px, row.v_px, row.depth_m) == pytest.approx((*after, 2.0))
    assert row.sigmas == pytest.approx((5 * crop.scale, 10 * crop.scale, 0.1))
    assert (crop.crop_camera(whole).width_px, crop.crop_camera(whole).height_px) == (320, 240)


def test_boxes_are_clipped_and_dropped_outside_the_image() -> None:
    left, _ = WIDE.corner_px

    def crop_box(*box_px: float) -> tuple[float, ...]:
        return WIDE.crop_label(LabelRow("a.png", "cf2", box_px=box_px)).box_px

    assert crop_box(left + 100, 50, left + 200, 100) == pytest.approx((48, 24, 96, 48))
    assert crop_box(0, -50, 2000, 600) == pytest.approx((0, 0, 320, 240))
    assert crop_box(0, 50, left, 100) == ()
    assert crop_box(left + 100, 500, left + 200, 550) == ()
    assert crop_box() == ()


@pytest.mark.parametrize("crop", [WIDE, HIGH])
def test_cropped_pixels_equal_the_region(crop: Crop) -> None:
    v, u = np.mgrid[: crop.from_height_px, : crop.from_width_px]
    rgb = np.stack([u // 4, v // 4, 0 * u], axis=-1).astype(np.uint8)
    got = crop.crop_image(rgb)
    assert got.shape == (240, 320, 3)
    left, top = crop.corner_px
    wanted = ((left + 160 / crop.scale) / 4, (top + 120 / crop.scale) / 4)
    assert got[120, 160, :2].tolist() == pytest.approx(wanted, abs=2)


def test_a_part_that_is_cut_out_is_not_scaled() -> None:
    crop = Crop(324, 244, 320, 224, margin_px=(2, 10))
    assert (crop.scale, crop.corner_px) == (1.0, (2, 10))
    row = crop.crop_label(LabelRow("a.png", "cf2", 52.0, 30.0, sigmas=(1.0, 2.0, 3.0)))
    assert (row.u_px, row.v_px, row.sigmas) == (50.0, 20.0, (1.0, 2.0, 3.0))
    v, u = np.mgrid[:244, :324]
    rgb = np.stack([u // 2, v, 0 * u], axis=-1).astype(np.uint8)
    assert (crop.crop_image(rgb) == rgb[10:234, 2:322]).all()


def test_box_that_only_touches_an_edge_is_dropped() -> None:
    left, _ = WIDE.corner_px
    for box in ((left + 100, -9, left + 200, 0), (left + 100, 500, left + 200, 501)):
        assert WIDE.crop_label(LabelRow("a.png", "cf2", box_px=box)).box_px == ()
