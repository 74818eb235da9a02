"""Sketches of quadrotors: their pixels, labels and random scenes."""

from dataclasses import replace

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from dmrl.geometry.frames import AIDECK, Array, camera_from_horizontal, project
from dmrl.images.canvas import Canvas
from dmrl.rendering.robots.quadrotor import MESH, RADIUS_M, ROTOR_DISCS
from dmrl.rendering.sketch_renderer import Look, Pose, Sketch, render_sketch
from dmrl.rendering.sketch_scene import random_look, random_poses

CAMERA = replace(AIDECK, distortion=())
LEVEL = np.eye(3)


@pytest.fixture
def plain_look() -> Look:
    """Return the look of a white background in even light, seen by a sharp, noiseless sensor."""
    shape = (CAMERA.height_px, CAMERA.width_px, 3)
    return Look(
        background=np.full(shape, 255, np.uint8),
        light_camera=np.array([0.0, 0.0, 1.0]),
        ambient=1.0,
        shine=np.ones(3),
        rotor_opacity=0.5,
        blade_rad=0.3,
        blur=0.0,
        vignette=0.0,
        gain=np.ones(3),
        gamma=1.0,
        noise_deviation=0.0,
        noise=np.zeros(shape, np.float32),
    )


def build_pose(x: float, y: float, z: float, turn: Array = LEVEL) -> Pose:
    """Return the pose of a robot in the camera frame, in metres."""
    return Pose(np.array([x, y, z]), turn)


def find_changed_pixels(sketch: Sketch) -> Array:
    """Return pixels (n, 2) as (u, v) that are not background."""
    return np.argwhere((sketch.rgb < 254).any(axis=2))[:, ::-1] + 0.5


def test_a_robot_to_the_left_and_above_is_drawn_at_its_projection(plain_look: Look) -> None:
    sketch = render_sketch(CAMERA, [build_pose(1.0, 0.3, 0.1)], plain_look)
    np.testing.assert_allclose(
        sketch.uv_px, [[166.90 - 0.3 * 183.73, 77.51 - 0.1 * 184.12]], atol=1e-9
    )
    assert sketch.depth_m.tolist() == [1.0]
    middle = find_changed_pixels(sketch).mean(axis=0)
    assert np.abs(middle - sketch.uv_px[0]).max() < 3
    assert sketch.visible_share.tolist() == [1.0]


def test_a_robot_rolled_to_the_right_is_drawn_lower_on_the_right(plain_look: Look) -> None:
    turn = camera_from_horizontal(0.4, 0.0).T
    u, v = find_changed_pixels(
        render_sketch(CAMERA, [build_pose(0.5, 0.0, 0.0, turn)], plain_look)
    ).T
    assert np.corrcoef(u, v)[0, 1] > 0.3


def test_a_pitched_robot_shows_more_height_from_behind(plain_look: Look) -> None:
    # From behind, the far rotors are lower when the nose is down, and higher when it is up.
    heights = {}
    for pitch in (-0.4, 0.4):
        turn = camera_from_horizontal(0.0, pitch).T
        far = (ROTOR_DISCS.mean(axis=1) @ turn.T)[ROTOR_DISCS.mean(axis=1)[:, 0] > 0]
        heights[pitch] = far[:, 2].mean()
    assert heights[0.4] < 0 < heights[-0.4]
    down = render_sketch(
        CAMERA, [build_pose(0.5, 0.0, 0.0, camera_from_horizontal(0, 0.4).T)], plain_look
    )
    level = render_sketch(CAMERA, [build_pose(0.5, 0.0, 0.0)], plain_look)
    height = [s.box_px[0, 3] - s.box_px[0, 1] for s in (down, level)]
    assert height[0] > 1.5 * height[1]


def test_size_is_inversely_proportional_to_distance(plain_look: Look) -> None:
    boxes = [
        render_sketch(CAMERA, [build_pose(x, 0.0, -0.1 * x)], plain_look).box_px[0]
        for x in (0.4, 0.8, 1.6)
    ]
    widths = [box[2] - box[0] for box in boxes]
    np.testing.assert_allclose(widths, [widths[0], widths[0] / 2, widths[0] / 4], atol=2)
    # The two nearest rotors, 0.0325 m nearer than the centre, determine the width.
    near_m = 0.046 * np.cos(np.pi / 4)
    assert widths[0] == pytest.approx(2 * (near_m + 0.0235) * 183.73 / (0.4 - near_m), abs=1.5)


@pytest.mark.heavy
def test_the_box_encloses_the_changed_pixels_tightly(plain_look: Look) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        (pose,) = random_poses(rng, CAMERA, 1)
        sketch = render_sketch(CAMERA, [pose], plain_look)
        changed = find_changed_pixels(sketch)
        edges = np.concatenate([changed.min(axis=0) - 0.5, changed.max(axis=0) + 0.5])
        assert np.abs(sketch.box_px[0] - edges).max() <= 1


def test_the_nearer_robot_hides_the_farther(plain_look: Look) -> None:
    near, far = build_pose(0.5, 0.0, 0.0), build_pose(1.0, 0.05, 0.0)
    one, other = (
        render_sketch(CAMERA, [near, far], plain_look),
        render_sketch(CAMERA, [far, near], plain_look),
    )
    np.testing.assert_array_equal(one.rgb, other.rgb)
    np.testing.assert_array_equal(one.visible_share, other.visible_share[::-1])
    assert one.visible_share[0] == 1.0
    assert 0 < one.visible_share[1] < 0.8


def test_box_is_clipped_at_the_image_edge(plain_look: Look) -> None:
    sketch = render_sketch(CAMERA, [build_pose(0.3, 0.27, 0.0)], plain_look)
    assert sketch.box_px[0, 0] == 0.0
    assert sketch.box_px[0, 2] < 60
    outside = render_sketch(CAMERA, [build_pose(0.3, 2.0, 0.0)], plain_look)
    assert np.isnan(outside.box_px).all()
    assert outside.visible_share.tolist() == [0.0]
    assert (outside.rgb == 255).all()


def test_invalid_sketch_scene_is_refused(plain_look: Look) -> None:
    with pytest.raises(ValueError, match="behind the camera"):
        render_sketch(CAMERA, [build_pose(0.02, 0.0, 0.0)], plain_look)
    with pytest.raises(ValueError, match="without distortion"):
        render_sketch(AIDECK, [], plain_look)


def test_faces_are_anticlockwise_seen_from_outside() -> None:
    edge = np.diff(MESH.corners, axis=1)
    turned = np.cross(edge[:, 0], edge[:, 1])
    assert (np.einsum("fk,fk->f", turned, MESH.normals) > 0).all()


def test_the_radius_encloses_the_whole_quadrotor() -> None:
    for corners in (MESH.corners, ROTOR_DISCS):
        assert np.linalg.norm(corners, axis=-1).max() <= RADIUS_M + 1e-9


@pytest.mark.parametrize("opacity", [1.0, 0.5])
def test_a_polygon_covers_its_area_at_its_position(opacity: float) -> None:
    rng = np.random.default_rng(0)
    excess, off = [], []
    for _ in range(50):
        canvas = Canvas(10, 20, 80, 60)
        turn, half = rng.uniform(0, np.pi), rng.uniform(4, 15, 2)
        c, s = np.cos(turn), np.sin(turn)
        at = rng.uniform((35, 45), (65, 55))
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        corners = (signs * half) @ [[c, s], [-s, c]] + at
        (outline,) = canvas.make_outlines(corners[None], np.array([[1.0, 0.5, 0.0]]), opacity)
        canvas.draw_outline(outline)
        cover = canvas.to_opacity()[..., 0]
        np.testing.assert_allclose(
            canvas.to_rgb(), cover[..., None] * np.array([1.0, 0.5, 0.0]), atol=0.01
        )
        excess.append((cover.sum() / opacity - 4 * half.prod()) / (4 * half.sum()))
        v, u = (np.indices(cover.shape) + 0.5).reshape(2, -1)
        middle = np.average([u, v], axis=1, weights=cover.ravel())
        off.append(middle - (at - (10, 20)))
    # A polygon grows by less than a tenth of a pixel on each side.
    assert 0 <= np.mean(excess) < 0.1
    assert np.abs(np.mean(off, axis=0)).max() < 0.02 and np.abs(off).max() < 0.2


def test_polygon_is_composited_over_the_background(plain_look: Look) -> None:
    ground = np.full((8, 8, 3), 64, np.uint8)
    canvas = Canvas(0, 0, 8, 8, ground=ground)
    corners = np.array([[[0, 0], [4, 0], [4, 8], [0, 8]]])
    canvas.draw_outline(canvas.make_outlines(corners, np.ones((1, 3)), 0.5)[0])
    row = canvas.to_rgb()[3, :, 0]
    np.testing.assert_allclose(row[[0, 1, 2, 5, 6, 7]], [0.625] * 3 + [0.25] * 3, atol=0.005)
    with pytest.raises(ValueError, match="no opacity"):
        canvas.to_opacity()


@pytest.mark.heavy
def test_random_poses_fill_the_image_and_the_range_of_depths() -> None:
    rng = np.random.default_rng(0)
    xyz = np.array([p.xyz_camera for _ in range(400) for p in random_poses(rng, CAMERA, 3)])
    uv, depth_m = project(xyz, CAMERA.image_from_optical)
    assert len(xyz) > 1000
    assert (depth_m.min(), depth_m.max()) == pytest.approx((0.2, 2.0), rel=0.02)
    assert np.median(depth_m) == pytest.approx(np.sqrt(0.2 * 2.0), rel=0.1)
    shares = [np.histogram(uv[:, k], 4, (0, size))[0] for k, size in enumerate((320, 224))]
    assert np.ptp(np.array(shares) / len(xyz)) < 0.08


@pytest.mark.heavy
def test_the_seed_decides_the_picture() -> None:
    def picture(seed: int) -> Sketch:
        rng = np.random.default_rng(seed)
        return render_sketch(CAMERA, random_poses(rng, CAMERA, 2), random_look(rng, CAMERA))

    np.testing.assert_array_equal(picture(3).rgb, picture(3).rgb)
    assert (picture(3).rgb != picture(4).rgb).mean() > 0.9


@pytest.mark.benchmark(group="sketch")
def test_speed_of_a_sketch(benchmark: BenchmarkFixture) -> None:
    rng = np.random.default_rng(0)
    benchmark(lambda: render_sketch(CAMERA, random_poses(rng, CAMERA, 2), random_look(rng, CAMERA)))
