"""Windows of a turned camera, against points in space."""

import numpy as np
import pytest
from numpy.typing import NDArray

from dmrl.learn.batches import FIELDS
from dmrl.learn.windows import (
    Window,
    facing,
    feather,
    flat,
    inside,
    moved,
    parts,
    present,
    sample,
    slant,
    through,
    turned,
    under,
)

CAMERA = (120.0, 118.0, 160.0, 100.0)
WHOLE = (0, 0, 320, 224)


def seen_at(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels of points (n, 3) to the right, below and ahead of the camera."""
    fx, fy, cx, cy = CAMERA
    x, y, z = points.T
    return np.column_stack([fx * x / z + cx, fy * y / z + cy])


def robots_at(points: NDArray[np.float64]) -> NDArray[np.float32]:
    out = np.full((len(points), len(FIELDS)), np.nan, np.float32)
    out[:, :2], out[:, 2], out[:, 3:6] = seen_at(points), points[:, 2], (1.0, 1.0, 0.1)
    return out


@pytest.mark.parametrize("seed", range(5))
def test_a_turned_camera_sees_points_where_and_as_deep_as_they_then_are(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = np.array([0.3, -0.2, 1.0]) * rng.uniform(0.7, 1.3, (20, 3))
    source = seen_at(points[:1])[0]
    shown = rng.uniform((60, 40), (260, 180))
    corner = np.array([7.0, 5.0])
    matrix = turned(CAMERA, np.eye(2), source, shown - corner, corner)
    got = moved(robots_at(points), Window(matrix, 1.0, CAMERA), (7, 5, 320, 224))
    then = points @ (facing(CAMERA, source) @ facing(CAMERA, shown).T)
    np.testing.assert_allclose(got[:, :2], seen_at(then), atol=1e-3)
    np.testing.assert_allclose(got[:, 2], then[:, 2], rtol=1e-5)
    np.testing.assert_allclose(got[0, :2], shown, atol=1e-4)
    np.testing.assert_allclose(got[:, 5] / got[:, 2], 0.1 / points[:, 2], rtol=1e-5)


def test_what_is_straight_above_stays_straight_above() -> None:
    post = np.array([[0.5, y, 1.0] for y in (-0.4, 0.0, 0.3)])
    matrix = turned(CAMERA, np.eye(2), seen_at(post)[1], np.array([90.0, 100.0]), np.zeros(2))
    got = moved(robots_at(post), Window(matrix, 1.0, CAMERA), WHOLE)
    np.testing.assert_allclose(got[:, 0], 90.0, atol=1e-3)


def test_a_zoom_brings_the_point_it_is_about_nearer_by_as_much() -> None:
    point = np.array([[0.4, 0.1, 1.2]])
    at = seen_at(point)[0]
    matrix = turned(CAMERA, np.eye(2) / 1.5, at, at, np.zeros(2))
    got = moved(robots_at(point), Window(matrix, 1.5, CAMERA), WHOLE)
    np.testing.assert_allclose(got[0, :3], [*at, 1.2 / 1.5], rtol=1e-5)


def test_what_is_behind_a_turned_camera_is_nowhere() -> None:
    away = np.array([[-3.0, 0.0, 1.0]])
    matrix = turned(CAMERA, np.eye(2), np.array([318.0, 100]), np.array([0.0, 100]), np.zeros(2))
    got = moved(robots_at(away), Window(matrix, 1.0, CAMERA), WHOLE)
    assert np.isnan(got[0, :2]).all()


def test_what_is_beside_the_camera_is_nowhere() -> None:
    with np.errstate(all="raise"):
        got = through(np.eye(3)[[0, 1, 0]], np.array([[0.0, 1.0], [2.0, 1.0]]))
    assert np.isnan(got[0]).all() and got[1].tolist() == [1.0, 0.5]


def test_pixels_go_where_labels_go() -> None:
    point = np.array([[0.35, 0.15, 1.0]])
    u, v = seen_at(point)[0]
    down, across = np.indices((224, 320)) + 0.5
    spot = 255 * np.exp(-((across - u) ** 2 + (down - v) ** 2) / 50)
    shown = np.array([180.0, 90.0])
    window = Window(turned(CAMERA, np.eye(2), np.array([u, v]), shown, np.zeros(2)), 1.0, CAMERA)
    image = sample(spot[..., None].astype(np.uint8), window, (224, 320))[..., 0].astype(float)
    centre = np.array([(image * across).sum(), (image * down).sum()]) / image.sum()
    # A spot of 5 px is stretched a little to one side.
    np.testing.assert_allclose(centre, shown, atol=0.7)
    assert image[90, 180] > 240


def test_without_a_camera_a_window_is_cut_out() -> None:
    picture = (np.arange(40 * 60 * 3) % 251).astype(np.uint8).reshape(40, 60, 3)
    window = Window(flat(np.eye(2), np.array([20.0, 10.0]), np.array([0.0, 0.0])), 1.0)
    assert (sample(picture, window, (15, 25)) == picture[10:25, 20:45]).all()


def test_a_window_is_sharper_than_a_bilinear_one() -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(60, 200, (112, 160, 1), np.uint8)
    window = Window(flat(np.eye(2), np.array([10.5, 10.5]), np.zeros(2)), 1.0)
    shown = sample(picture, window, (80, 80))[..., 0]
    # Halfway between pixels: the mean of four, as a bilinear window is, halves the spread.
    assert shown.std() > 0.6 * picture.std()


def test_beyond_an_image_its_border_goes_on() -> None:
    picture = np.arange(40, dtype=np.uint8).reshape(4, 10)[..., None].repeat(3, axis=2)
    window = Window(flat(np.eye(2), np.array([-5.0, 0.0]), np.zeros(2)), 1.0)
    shown = sample(picture, window, (4, 10))
    assert (shown[:, :6] == picture[:, :1]).all()
    assert (shown[:, 5:] == picture[:, :5]).all()


def test_pixels_without_channels_have_one() -> None:
    mask = np.full((4, 6), 255, np.uint8)
    for zoom in (1, 2):
        window = Window(flat(np.eye(2) / zoom, np.zeros(2), np.zeros(2)), zoom)
        shape = (4 * zoom, 6 * zoom)
        assert sample(mask, window, shape).shape == (*shape, 1)


def centres(*uv: tuple[float, float]) -> NDArray[np.float32]:
    out = np.full((len(uv), len(FIELDS)), np.nan, np.float32)
    out[:, :2] = uv
    return out


def test_a_rectangle_is_cut_in_two_or_four_near_its_middle() -> None:
    rng, kinds = np.random.default_rng(0), set()
    for _ in range(60):
        cut = parts((10, 20, 70, 110), rng)
        seen = np.zeros((120, 80), int)
        for left, top, right, bottom in cut:
            assert right - left >= 20 and bottom - top >= 30
            seen[top:bottom, left:right] += 1
        assert (seen[20:110, 10:70] == 1).all() and seen.sum() == 90 * 60
        kinds.add((len({rect[0] for rect in cut}), len({rect[1] for rect in cut})))
    assert kinds == {(2, 1), (1, 2), (2, 2)}


def test_a_feathered_patch_grows_by_quarters_from_its_border() -> None:
    found = feather(9, 12)[..., 0]
    down = np.array([0.25, 0.5, 0.75, 1, 1, 1, 0.75, 0.5, 0.25])
    across = np.array([0.25, 0.5, 0.75, *[1.0] * 6, 0.75, 0.5, 0.25])
    np.testing.assert_allclose(found, down[:, None] * across, rtol=1e-6)


def test_a_rectangle_holds_its_left_and_upper_border() -> None:
    at = centres((5, 7), (4.9, 7), (5, 6.9), (14.9, 16.9), (15, 10), (10, 17))
    assert inside(at, (5, 7, 15, 17)).tolist() == [True, False, False, True, False, False]
    assert present(np.concatenate([at, centres((np.nan, 1))])).shape == at.shape
    opacity = np.zeros((10, 10, 1), np.float32)
    opacity[0, 0], opacity[9, 9] = 0.51, 0.49
    assert under(at, (5, 7, 15, 17), opacity).tolist() == [True] + [False] * 5
    assert under(at, (5, 7, 15, 17), None).tolist() == inside(at, (5, 7, 15, 17)).tolist()


def test_distance_over_depth_is_the_length_of_a_ray_one_deep() -> None:
    points = np.array([[0.0, 0, 2], [1, 0, 2], [0, -1.5, 3], [1, 2, 2]])
    wanted = np.linalg.norm(points, axis=1) / points[:, 2]
    assert slant(CAMERA, seen_at(points)) == pytest.approx(wanted)


def test_a_flat_window_is_a_turn_about_a_point() -> None:
    turn = np.array([[0.0, -0.5], [0.5, 0.0]])
    matrix = flat(turn, np.array([30.0, 40.0]), np.array([7.0, 9.0]))
    shown = np.array([[7.0, 9.0], [9.0, 9.0], [7.0, 11.0]])
    assert through(matrix, shown).tolist() == [[30, 40], [30, 41], [29, 40]]
    robots = centres((30, 40), (30, 41))
    robots[:, 2:6] = 4.0, 1.0, 2.0, 0.5
    got = moved(robots, Window(matrix, 2.0), (100, 200, 120, 220))
    assert got[:, :2].tolist() == [[107, 209], [109, 209]]
    assert got[:, 2:6].tolist() == [[2.0, 2.0, 4.0, 0.25]] * 2
