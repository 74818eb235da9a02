"""Windows of crops and of turned cameras, compared with points in space and with pixels."""

import numpy as np
import pytest
from numpy.typing import NDArray

from dmrl.learn.data.batches import ROBOT_FIELDS
from dmrl.learn.data.crops import (
    CropWindow,
    Intrinsics,
    Pixels,
    Point,
    Rect,
    apply_homography,
    build_crop_homography,
    build_feather_mask,
    build_rotation_homography,
    is_covered,
    is_inside,
    list_robots,
    move_labels,
    ray_length,
    rotation_to_pixel,
    sample_window,
    tile_mosaic,
)

CAMERA = (120.0, 118.0, 160.0, 100.0)
WHOLE = (0, 0, 320, 224)


UPRIGHT = ((1.0, 0.0), (0.0, 1.0))


def project(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return pixels (n, 2) of points (n, 3) in metres to the right, below and ahead of CAMERA."""
    fx, fy, cx, cy = CAMERA
    x, y, z = points.T
    return np.column_stack([fx * x / z + cx, fy * y / z + cy])


def build_robots(points: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return label rows (n, fields) of points (n, 3); sigmas are 1 px and 0.1 m."""
    out = np.full((len(points), len(ROBOT_FIELDS)), np.nan, np.float32)
    out[:, :2], out[:, 2], out[:, 3:6] = project(points), points[:, 2], (1.0, 1.0, 0.1)
    return out


def to_point(at: NDArray[np.float64]) -> Point:
    """Return a pixel (2,) as a tuple."""
    u, v = at.tolist()
    return u, v


def transform_labels(
    robots: NDArray[np.float32], window: CropWindow, rect: Rect
) -> NDArray[np.float64]:
    """Return label rows as a window in a rectangle of the canvas shows them."""
    return np.array(move_labels(robots.tolist(), window, rect))


@pytest.mark.parametrize("seed", range(5))
def test_turned_camera_projects_points_and_depths_correctly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = np.array([0.3, -0.2, 1.0]) * rng.uniform(0.7, 1.3, (20, 3))
    source = project(points[:1])[0]
    shown = rng.uniform((60, 40), (260, 180))
    corner = np.array([7.0, 5.0])
    matrix = build_rotation_homography(
        CAMERA, UPRIGHT, to_point(source), to_point(shown - corner), to_point(corner)
    )
    got = transform_labels(build_robots(points), CropWindow(matrix, 1.0, CAMERA), (7, 5, 320, 224))
    then = points @ (
        rotation_to_pixel(CAMERA, to_point(source)) @ rotation_to_pixel(CAMERA, to_point(shown)).T
    )
    np.testing.assert_allclose(got[:, :2], project(then), atol=1e-3)
    np.testing.assert_allclose(got[:, 2], then[:, 2], rtol=1e-5)
    np.testing.assert_allclose(got[0, :2], shown, atol=1e-4)
    np.testing.assert_allclose(got[:, 5] / got[:, 2], 0.1 / points[:, 2], rtol=1e-5)


def test_turned_camera_keeps_vertical_lines_vertical() -> None:
    post = np.array([[0.5, y, 1.0] for y in (-0.4, 0.0, 0.3)])
    matrix = build_rotation_homography(
        CAMERA, UPRIGHT, to_point(project(post)[1]), (90.0, 100.0), (0.0, 0.0)
    )
    got = transform_labels(build_robots(post), CropWindow(matrix, 1.0, CAMERA), WHOLE)
    np.testing.assert_allclose(got[:, 0], 90.0, atol=1e-3)


def test_zoom_divides_the_depth_of_its_centre() -> None:
    point = np.array([[0.4, 0.1, 1.2]])
    at = to_point(project(point)[0])
    matrix = build_rotation_homography(CAMERA, ((1 / 1.5, 0.0), (0.0, 1 / 1.5)), at, at, (0.0, 0.0))
    got = transform_labels(build_robots(point), CropWindow(matrix, 1.5, CAMERA), WHOLE)
    np.testing.assert_allclose(got[0, :3], [*at, 1.2 / 1.5], rtol=1e-5)


def test_points_behind_a_turned_camera_are_nan() -> None:
    away = np.array([[-3.0, 0.0, 1.0]])
    matrix = build_rotation_homography(CAMERA, UPRIGHT, (318.0, 100.0), (0.0, 100.0), (0.0, 0.0))
    got = transform_labels(build_robots(away), CropWindow(matrix, 1.0, CAMERA), WHOLE)
    assert np.isnan(got[0, :2]).all()


def test_homography_of_points_at_infinity_is_nan() -> None:
    sideways = np.eye(3)[[0, 1, 0]].tolist()
    assert np.isnan(apply_homography(sideways, 0.0, 1.0)).all()
    assert apply_homography(sideways, 2.0, 1.0) == (1.0, 0.5)


def test_warped_pixels_and_labels_agree() -> None:
    point = np.array([[0.35, 0.15, 1.0]])
    u, v = project(point)[0]
    down, across = np.indices((224, 320)) + 0.5
    spot = 255 * np.exp(-((across - u) ** 2 + (down - v) ** 2) / 50)
    shown = (180.0, 90.0)
    window = CropWindow(
        build_rotation_homography(CAMERA, UPRIGHT, (u, v), shown, (0.0, 0.0)), 1.0, CAMERA
    )
    image = sample_window(spot[..., None].astype(np.uint8), window, (224, 320))[..., 0].astype(
        float
    )
    centre = np.array([(image * across).sum(), (image * down).sum()]) / image.sum()
    # The turn stretches a spot of 5 px a little to one side.
    np.testing.assert_allclose(centre, shown, atol=0.7)
    assert image[90, 180] > 240


def test_without_a_camera_a_window_is_cut_out() -> None:
    picture = (np.arange(40 * 60 * 3) % 251).astype(np.uint8).reshape(40, 60, 3)
    window = CropWindow(build_crop_homography(UPRIGHT, (20.0, 10.0), (0.0, 0.0)), 1.0)
    assert (sample_window(picture, window, (15, 25)) == picture[10:25, 20:45]).all()
    mirror = CropWindow(
        build_crop_homography(((-1.0, 0.0), (0.0, 1.0)), (45.0, 10.0), (0.0, 0.0)), 1.0
    )
    assert (sample_window(picture, mirror, (15, 25)) == picture[10:25, 20:45][:, ::-1]).all()


def draw_picture(height: int, width: int) -> Pixels:
    """Return a colour picture with detail at several scales, as photos have."""
    rng, out = np.random.default_rng(0), np.full((height, width, 3), 128.0)
    for step in (1, 2, 4, 8):
        grain = rng.normal(0, 10, (height // step + 1, width // step + 1, 3))
        out += grain.repeat(step, 0).repeat(step, 1)[:height, :width]
    return np.clip(out, 0, 255).astype(np.uint8)


def measure_contrast(pixels: Pixels) -> float:
    """Return the root mean square of differences between neighbouring pixels of a row."""
    return float(np.sqrt(np.mean(np.diff(pixels[..., 0].astype(float), axis=1) ** 2)))


def test_a_window_is_sharper_than_a_bilinear_one() -> None:
    picture = draw_picture(112, 160)
    window = CropWindow(build_crop_homography(UPRIGHT, (10.5, 10.5), (0.0, 0.0)), 1.0)
    blurred = sample_window(picture, window, (80, 80), sharp=False)
    # The window lies halfway between pixels, where bilinear sampling is the mean of four.
    near = picture[10:91, 10:91].astype(float)
    mean = (near[1:, 1:] + near[:-1, 1:] + near[1:, :-1] + near[:-1, :-1]) / 4
    np.testing.assert_allclose(blurred, mean, atol=1)
    assert measure_contrast(sample_window(picture, window, (80, 80))) > 1.15 * measure_contrast(
        blurred
    )


@pytest.mark.parametrize("camera", [None, CAMERA])
def test_window_of_a_padded_image_shows_the_same_pixels(
    camera: Intrinsics | None,
) -> None:
    picture, rng = draw_picture(224, 320), np.random.default_rng(1)
    for _ in range(40):
        turn = tuple(map(tuple, (np.eye(2) + rng.uniform(-0.4, 0.4, (2, 2))).tolist()))
        seen, shown = (rng.uniform(low, high, 2).tolist() for low, high in ((20, 200), (0, 30)))
        matrix = (
            build_rotation_homography(camera, turn, seen, shown, (9.0, 4.0))
            if camera
            else build_crop_homography(turn, seen, shown)
        )
        size = (30, 30)
        whole = np.linalg.inv(_shift_by_margin(60)) @ matrix
        padded = np.pad(picture, ((60, 60), (60, 60), (0, 0)), mode="edge")
        got = sample_window(picture, CropWindow(matrix, 1.0), size).astype(int)
        wanted = sample_window(padded, CropWindow(whole, 1.0), size).astype(int)
        # OpenCV rounds positions to 1/32 px, and a shift can change the rounding.
        assert abs(got - wanted).max() <= 6 and abs(got - wanted).mean() < 0.2


def _shift_by_margin(margin_px: int) -> NDArray[np.float64]:
    """Return the matrix (3, 3) from pixels of a padded image to pixels of the image."""
    return np.array([[1, 0, -margin_px], [0, 1, -margin_px], [0, 0, 1.0]])


def test_border_pixels_repeat_beyond_the_image() -> None:
    picture = np.arange(40, dtype=np.uint8).reshape(4, 10)[..., None].repeat(3, axis=2)
    window = CropWindow(build_crop_homography(UPRIGHT, (-5.0, 0.0), (0.0, 0.0)), 1.0)
    shown = sample_window(picture, window, (4, 10), sharp=False)
    assert (shown[:, :6] == picture[:, :1]).all()
    assert (shown[:, 5:] == picture[:, :5]).all()
    nowhere = CropWindow(build_crop_homography(UPRIGHT, (-50.0, 20.0), (0.0, 0.0)), 1.0)
    assert (sample_window(picture, nowhere, (4, 10)) == picture[3, 0]).all()


def test_image_without_channel_axis_gets_one_channel() -> None:
    mask = np.full((4, 6), 255, np.uint8)
    for zoom in (1, 2):
        turn = ((1 / zoom, 0.0), (0.0, 1 / zoom))
        window = CropWindow(build_crop_homography(turn, (0.0, 0.0), (0.0, 0.0)), zoom)
        shape = (4 * zoom, 6 * zoom)
        assert sample_window(mask, window, shape).shape == (*shape, 1)


def build_centres(*uv: tuple[float, float]) -> NDArray[np.float32]:
    """Return label rows (n, fields) that know only their pixels."""
    out = np.full((len(uv), len(ROBOT_FIELDS)), np.nan, np.float32)
    out[:, :2] = uv
    return out


def test_mosaic_splits_a_rectangle_into_two_or_four_parts() -> None:
    rng, kinds = np.random.default_rng(0), set()
    for _ in range(60):
        cut = tile_mosaic((10, 20, 70, 110), rng)
        seen = np.zeros((120, 80), int)
        for left, top, right, bottom in cut:
            assert right - left >= 20 and bottom - top >= 30
            seen[top:bottom, left:right] += 1
        assert (seen[20:110, 10:70] == 1).all() and seen.sum() == 90 * 60
        kinds.add((len({rect[0] for rect in cut}), len({rect[1] for rect in cut})))
    assert kinds == {(2, 1), (1, 2), (2, 2)}


def test_a_feathered_patch_grows_by_quarters_from_its_border() -> None:
    found = build_feather_mask(9, 12)[..., 0]
    down = np.array([0.25, 0.5, 0.75, 1, 1, 1, 0.75, 0.5, 0.25])
    across = np.array([0.25, 0.5, 0.75, *[1.0] * 6, 0.75, 0.5, 0.25])
    np.testing.assert_allclose(found, down[:, None] * across, rtol=1e-6)


def test_a_rectangle_holds_its_left_and_upper_border() -> None:
    at = build_centres((5, 7), (4.9, 7), (5, 6.9), (14.9, 16.9), (15, 10), (10, 17))
    held = [True, False, False, True, False, False]
    robots, rect = list_robots(np.concatenate([at, build_centres((np.nan, 1))])), (5, 7, 15, 17)
    assert [robot[:2] for robot in robots] == at[:, :2].tolist()
    assert [is_inside(robot, rect) for robot in robots] == held
    opacity = np.zeros((10, 10, 1), np.float32)
    opacity[0, 0], opacity[9, 9] = 0.51, 0.49
    assert [is_covered(robot, rect, opacity) for robot in robots] == [True] + [False] * 5
    assert [is_covered(robot, rect, None) for robot in robots] == held


def test_ray_length_is_distance_over_depth() -> None:
    points = np.array([[0.0, 0, 2], [1, 0, 2], [0, -1.5, 3], [1, 2, 2]])
    wanted = np.linalg.norm(points, axis=1) / points[:, 2]
    assert [ray_length(CAMERA, *to_point(at)) for at in project(points)] == pytest.approx(wanted)


def test_crop_homography_rotates_and_scales_about_a_point() -> None:
    matrix = build_crop_homography(((0.0, -0.5), (0.5, 0.0)), (30.0, 40.0), (7.0, 9.0))
    shown = [(7.0, 9.0), (9.0, 9.0), (7.0, 11.0)]
    assert [apply_homography(matrix.tolist(), *at) for at in shown] == [
        (30, 40),
        (30, 41),
        (29, 40),
    ]
    robots = build_centres((30, 40), (30, 41))
    robots[:, 2:6] = 4.0, 1.0, 2.0, 0.5
    got = transform_labels(robots, CropWindow(matrix, 2.0), (100, 200, 120, 220))
    assert got[:, :2].tolist() == [[107, 209], [109, 209]]
    assert got[:, 2:6].tolist() == [[2.0, 2.0, 4.0, 0.25]] * 2
