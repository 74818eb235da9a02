"""Signs, projection and grid labels, compared with hand-drawn cases, OpenCV and the paper."""

import doctest
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl import topics
from dmrl.geometry import frames
from dmrl.geometry.frames import (
    AIDECK,
    PUBLISHED_RENDER,
    Array,
    build_grid_label,
    camera_from_horizontal,
    horizontal_from_pixels,
    is_inside,
    pixels_from_horizontal,
    project,
)

K = np.array([[184.0, 0.0, 160.0], [0.0, 184.0, 112.0], [0.0, 0.0, 1.0]])
ANGLE = st.floats(-1.5, 1.5)


def project_point(
    xyz_horizontal: tuple[float, float, float], roll_deg: float, pitch_deg: float
) -> Array:
    """Return the pixel (u, v) of a point, metres, seen by a robot with this attitude."""
    turn = camera_from_horizontal(np.radians(roll_deg), np.radians(pitch_deg))
    uv, _ = project(np.array([xyz_horizontal]) @ turn.T, K)
    return uv[0]


@pytest.mark.parametrize("module", [frames, topics], ids=lambda m: m.__name__)
def test_the_examples_in_the_docstrings_run(module: object) -> None:
    found = doctest.testmod(module)  # type: ignore[arg-type]
    assert found.attempted > 0
    assert found.failed == 0


def test_straight_ahead_is_the_principal_point_and_depth_is_x() -> None:
    uv, depth_m = project(np.array([[2.0, 0.0, 0.0]]), K)
    np.testing.assert_allclose(uv, [[160.0, 112.0]])
    np.testing.assert_allclose(depth_m, [2.0])


def test_left_of_the_robot_is_left_in_the_image_and_above_is_above() -> None:
    (left, above), depth_m = project(np.array([[2.0, 0.5, 0.0], [2.0, 0.0, 0.5]]), K)
    np.testing.assert_allclose(left, [160 - 184 / 4, 112])
    np.testing.assert_allclose(above, [160, 112 - 184 / 4])
    np.testing.assert_allclose(depth_m, [2.0, 2.0])


# Computed by hand for 30 degrees: sin = 0.5, cos = 0.8660. The point is one metre ahead.
def test_rolling_right_side_down_turns_the_scene_anticlockwise() -> None:
    """With the right side down, the camera's left axis points up.

    A peer on the left, level with the robot, lies below that axis: in the lower left.
    """
    u_px, v_px = project_point((1.0, 0.5, 0.0), 30, 0)
    assert u_px == pytest.approx(160 - 184 * 0.5 * 0.8660254)
    assert v_px == pytest.approx(112 + 184 * 0.5 * 0.5)


def test_rolling_leaves_the_point_ahead_where_it_was() -> None:
    np.testing.assert_allclose(project_point((1.0, 0.0, 0.0), 30, 0), [160, 112], atol=1e-12)


def test_a_nose_down_pitch_lifts_the_horizon() -> None:
    """The camera looks down at the floor, so what is level with it moves up the image."""
    u_px, v_px = project_point((1.0, 0.0, 0.0), 0, 10)
    assert u_px == pytest.approx(160)
    assert v_px == pytest.approx(112 - 184 * np.tan(np.radians(10)))


def test_axis_of_a_camera_pitched_10_degrees_hits_the_floor_ahead() -> None:
    height_m = 1.0
    ahead_m = height_m / np.tan(np.radians(10))
    np.testing.assert_allclose(project_point((ahead_m, 0.0, -height_m), 0, 10), [160, 112])


def test_pitch_is_applied_before_roll() -> None:
    """Nose down 90 degrees, then rolled about the camera's own axis, which points down."""
    turn = camera_from_horizontal(np.radians(90), np.radians(90))
    down, ahead = np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(turn @ down, [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(turn @ ahead, [0, 1, 0], atol=1e-12)


@given(ANGLE, ANGLE)
@pytest.mark.heavy
def test_paper_rotation_equals_ours_with_negated_angles(phi: float, theta: float) -> None:
    """Eq. 2 of the paper is Rx(phi) Ry(theta), rotations of the right-hand rule."""
    c, s = np.cos(phi), np.sin(phi)
    rx = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    c, s = np.cos(theta), np.sin(theta)
    ry = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    np.testing.assert_allclose(rx @ ry, camera_from_horizontal(-phi, -theta), atol=1e-12)


@pytest.mark.parametrize(("tilt_deg", "error_px"), [(3, 19), (6, 38), (10, 64)])
def test_printed_signs_of_the_paper_cause_large_pixel_errors(
    tilt_deg: float, error_px: float
) -> None:
    point = (1.0, 0.0, 0.0)
    wrong_px = np.asarray(project_point(point, 0, -tilt_deg)) - np.asarray(
        project_point(point, 0, tilt_deg)
    )
    assert np.linalg.norm(wrong_px) == pytest.approx(error_px, rel=0.03)


@given(ANGLE, ANGLE)
def test_rotation_keeps_lengths_and_handedness(roll_rad: float, pitch_rad: float) -> None:
    turn = camera_from_horizontal(roll_rad, pitch_rad)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)


def test_a_point_at_the_optical_centre_has_no_pixel() -> None:
    with pytest.raises(ValueError, match=r"row 0 with x = 0\.000 m"):
        project(np.array([[0.0, 1.0, 0.0]]), np.eye(3))


def test_points_behind_the_camera_are_refused_by_row() -> None:
    with pytest.raises(ValueError, match=r"1 of 2 points lie behind .* row 1 with x = -0\.500 m"):
        project(np.array([[1.0, 0, 0], [-0.5, 0, 0]]), K)


def test_cameras_equal_the_paper_and_the_published_images() -> None:
    np.testing.assert_allclose(
        AIDECK.image_from_optical, [[183.73, 0, 166.90], [0, 184.12, 77.51], [0, 0, 1]]
    )
    centre_px = [PUBLISHED_RENDER.width_px / 2, PUBLISHED_RENDER.height_px / 2]
    uv, _ = project(np.array([[1.0, 0, 0]]), PUBLISHED_RENDER.image_from_optical)
    np.testing.assert_allclose(uv[0], centre_px)


def test_left_and_top_edges_belong_to_the_image() -> None:
    uv = np.array([[0, 0], [319.999, 223.999], [320, 100], [100, 224], [-0.001, 5]])
    assert is_inside(uv, 320, 224).tolist() == [True, True, False, False, False]


def test_a_peer_marks_the_cell_at_row_v_and_column_u() -> None:
    grid = build_grid_label(np.array([[100.0, 50.0]]), np.array([1.5]))
    assert grid.shape == (2, 28, 40)
    assert grid.dtype == np.float32
    assert np.argwhere(grid[0]).tolist() == [[50 // 8, 100 // 8]]
    assert grid[1, 6, 12] == 1.5
    assert np.count_nonzero(grid) == 2


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_nearer_of_two_peers_wins_the_cell(order: list[int]) -> None:
    uv = np.array([[100.0, 50.0], [101.0, 51.0]])[order]
    grid = build_grid_label(uv, np.array([1.5, 0.7])[order])
    assert grid[1, 6, 12] == np.float32(0.7)
    assert grid[0].sum() == 1


def test_peers_outside_the_image_and_no_peers_leave_the_grid_empty() -> None:
    outside = np.array([[320.0, 5.0], [5.0, 224.0], [-1.0, 5.0], [5.0, -0.1]])
    assert not build_grid_label(outside, np.ones(4)).any()
    assert not build_grid_label(np.empty((0, 2)), np.empty(0)).any()


def test_the_corner_pixels_mark_the_corner_cells() -> None:
    uv = np.array([[0.0, 0.0], [319.9, 223.9]])
    grid = build_grid_label(uv, np.array([1.0, 2.0]))
    assert np.argwhere(grid[0]).tolist() == [[0, 0], [27, 39]]


def test_other_grids_than_the_paper_s_work_too() -> None:
    grid = build_grid_label(np.array([[30.0, 20.0]]), np.array([1.0]), shape=(2, 4), stride_px=16)
    assert np.argwhere(grid[0]).tolist() == [[1, 1]]


def test_projection_with_distortion_equals_opencv() -> None:
    rng = np.random.default_rng(0)
    camera = replace(AIDECK, distortion=(-0.0957, 0.0211, 0.003, -0.002, 0.01))
    roll, pitch = rng.uniform(-0.4, 0.4, (2, 200))
    xyz = rng.uniform([1.0, -0.8, -0.6], [4.0, 0.8, 0.6], (200, 3))
    uv, depth_m, _ = pixels_from_horizontal(xyz, roll, pitch, camera)
    for k in range(200):
        # The attitude for OpenCV is a product of rotations about single axes.
        ry = cv2.Rodrigues(np.array([0.0, pitch[k], 0.0]))[0]
        rx = cv2.Rodrigues(np.array([roll[k], 0.0, 0.0]))[0]
        turn = frames.OPTICAL_FROM_CAMERA @ (ry @ rx).T
        expected, _ = cv2.projectPoints(
            xyz[k],
            cv2.Rodrigues(turn)[0],
            np.zeros(3),
            camera.image_from_optical,
            np.array(camera.distortion),
        )
        assert uv[k] == pytest.approx(expected[0, 0], abs=1e-6)
        assert depth_m[k] == pytest.approx((turn @ xyz[k])[2])


def test_projection_without_distortion_equals_project() -> None:
    rng = np.random.default_rng(1)
    roll, pitch = rng.uniform(-0.4, 0.4, (2, 20))
    xyz = rng.uniform([1.0, -0.8, -0.6], [4.0, 0.8, 0.6], (20, 3))
    for camera, distorted in ((PUBLISHED_RENDER, True), (AIDECK, False)):
        uv, depth_m, _ = pixels_from_horizontal(xyz, roll, pitch, camera, distorted=distorted)
        for k in range(20):
            turned = xyz[k : k + 1] @ camera_from_horizontal(roll[k], pitch[k]).T
            expected, depth = project(turned, camera.image_from_optical)
            assert uv[k] == pytest.approx(expected[0])
            assert depth_m[k] == pytest.approx(depth[0])


def test_projection_jacobian_equals_finite_differences() -> None:
    rng = np.random.default_rng(2)
    given_at = np.column_stack(
        [rng.uniform([1.0, -0.8, -0.6], [4.0, 0.8, 0.6], (50, 3)), rng.uniform(-0.4, 0.4, (50, 2))]
    )

    def values(at: Array) -> Array:
        uv, depth_m, _ = pixels_from_horizontal(at[:, :3], at[:, 3], at[:, 4], AIDECK)
        return np.column_stack([uv, depth_m])

    jacobian = pixels_from_horizontal(given_at[:, :3], *given_at[:, 3:].T, AIDECK)[2]
    for column in range(5):
        step = 1e-6 * np.eye(5)[column]
        slope = (values(given_at + step) - values(given_at - step)) / 2e-6
        assert np.abs(slope - jacobian[:, :, column]).max() < 1e-4


def test_points_behind_the_camera_have_no_pixel() -> None:
    uv, depth_m, _ = pixels_from_horizontal(
        np.array([[-1.0, 0.2, 0.1]]), np.zeros(1), np.zeros(1), AIDECK
    )
    assert np.isnan(uv).all()
    assert depth_m[0] == -1.0


def test_pixels_and_depth_go_back_to_the_horizontal_frame() -> None:
    rng = np.random.default_rng(3)
    camera = replace(AIDECK, mount_rad=(0.05, -0.1, 0.2))
    xyz = rng.uniform((0.5, -0.4, -0.3), (3.0, 0.4, 0.3), (50, 3))
    roll, pitch = rng.uniform(-0.15, 0.15, (2, 50))
    uv, depth_m, _ = pixels_from_horizontal(xyz, roll, pitch, camera)
    assert np.allclose(horizontal_from_pixels(uv, depth_m, roll, pitch, camera), xyz, atol=1e-6)


def test_a_camera_mounted_nose_down_sees_as_a_robot_pitched_nose_down() -> None:
    xyz, zero, down = np.array([[1.5, 0.1, 0.05]]), np.zeros(1), np.full(1, 0.1)
    mounted = replace(AIDECK, mount_rad=(0.0, 0.1, 0.0))
    uv, _, _ = pixels_from_horizontal(xyz, zero, zero, mounted)
    expected, _, _ = pixels_from_horizontal(xyz, zero, down, AIDECK)
    assert np.allclose(uv, expected)


def test_a_camera_turned_to_the_left_sees_things_further_right() -> None:
    xyz, zero = np.array([[1.5, 0.0, 0.0]]), np.zeros(1)
    turned = replace(AIDECK, mount_rad=(0.0, 0.0, 0.1))
    (u, v), (u0, v0) = (pixels_from_horizontal(xyz, zero, zero, c)[0][0] for c in (turned, AIDECK))
    assert u - u0 == pytest.approx(AIDECK.fx_px * np.tan(0.1), rel=0.02)
    assert v == pytest.approx(v0, abs=0.5)


@given(st.tuples(ANGLE, ANGLE, ANGLE))
def test_a_mount_is_yaw_then_pitch_then_roll_of_the_camera(mount: tuple[float, ...]) -> None:
    roll, pitch, yaw = (
        cv2.Rodrigues(angle * axis)[0] for angle, axis in zip(mount, np.eye(3), strict=True)
    )
    camera = replace(AIDECK, mount_rad=mount)
    np.testing.assert_allclose(camera.camera_from_body, (yaw @ pitch @ roll).T, atol=1e-12)


@given(
    st.tuples(*[st.floats(-0.3, 0.3)] * 3),
    st.tuples(*[st.floats(-0.3, 0.3)] * 2),
    st.tuples(st.floats(0.8, 4.0), st.floats(-0.5, 0.5), st.floats(-0.4, 0.4)),
)
@pytest.mark.heavy
def test_projection_and_back_projection_round_trip(
    mount: tuple[float, ...], tilt: tuple[float, ...], bearing: tuple[float, ...]
) -> None:
    camera = replace(AIDECK, fx_px=150.0, mount_rad=mount)
    xyz = np.array([bearing]) * [1.0, bearing[0], bearing[0]]
    attitude = np.array([[tilt[0]], [tilt[1]]])
    uv, depth_m, _ = pixels_from_horizontal(xyz, *attitude, camera)
    if np.isfinite(uv).all():
        back = horizontal_from_pixels(uv, depth_m, *attitude, camera)
        np.testing.assert_allclose(back, xyz, atol=1e-6)


def test_point_beside_the_optical_centre_has_no_pixel() -> None:
    beside, level = np.array([[0.0, 1.0, 0.5], [-1.0, 0.0, 0.0]]), np.zeros(2)
    uv, depth_m, _ = pixels_from_horizontal(beside, level, level, AIDECK)
    assert depth_m.tolist() == [0, -1]
    assert np.isnan(uv).all()
