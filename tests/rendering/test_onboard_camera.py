"""Poses and pictures of peers as the camera of a robot sees them."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.geometry.frames import AIDECK, project
from dmrl.rendering.onboard_camera import (
    MIN_DEPTH_M,
    CameraView,
    build_view,
    is_in_front,
    relative_pose,
    render_sketches,
)
from dmrl.samples.flight import RobotPose

CAMERA = replace(AIDECK, distortion=())


def build_pose(
    x: float, y: float, z: float, yaw: float = 0, roll: float = 0, pitch: float = 0
) -> RobotPose:
    """Return a pose in the world, in metres and radians."""
    return RobotPose(np.array([x, y, z]), yaw, roll, pitch)


def test_a_peer_ahead_is_on_the_optical_axis_at_any_yaw() -> None:
    for yaw in (0.0, 1.0, 3.0):
        here = build_pose(1, 2, 3, yaw)
        pose = relative_pose(build_pose(1 + 2 * np.cos(yaw), 2 + 2 * np.sin(yaw), 3, yaw), here)
        assert pose.xyz_camera == pytest.approx((2, 0, 0))
        assert pose.camera_from_body == pytest.approx(np.eye(3))


def test_pitch_and_roll_move_the_peer_in_the_documented_direction() -> None:
    peer = build_pose(2, 0, 0)
    _, v_level = project(
        relative_pose(peer, build_pose(0, 0, 0)).xyz_camera[None], CAMERA.image_from_optical
    )[0][0]
    _, v_down = project(
        relative_pose(peer, build_pose(0, 0, 0, pitch=0.1)).xyz_camera[None],
        CAMERA.image_from_optical,
    )[0][0]
    assert v_down < v_level
    above = relative_pose(build_pose(2, 0, 0.5), build_pose(0, 0, 0, roll=0.2)).xyz_camera
    assert above[1] > 0  # The peer moves to the left.


def test_the_yaw_of_the_camera_is_subtracted_from_that_of_a_peer() -> None:
    pose = relative_pose(build_pose(2, 0, 0, yaw=0.7), build_pose(0, 0, 0, yaw=0.2))
    assert pose.camera_from_body[:, 0] == pytest.approx((np.cos(0.5), np.sin(0.5), 0))


def test_only_peers_in_front_of_the_camera_are_drawn() -> None:
    here = build_pose(0, 0, 0)
    assert is_in_front(relative_pose(build_pose(0.5, 0, 0), here))
    assert not is_in_front(relative_pose(build_pose(-0.5, 0, 0), here))
    assert not is_in_front(relative_pose(build_pose(MIN_DEPTH_M / 2, 0, 0), here))


def test_a_sketch_shows_the_peer_at_its_projection() -> None:
    pose = relative_pose(build_pose(0.5, 0.05, -0.1), build_pose(0, 0, 0))
    seen = CameraView(
        build_pose(0, 0, 0), {"cf2": pose}, {"cf2": np.zeros(3)}, np.zeros(2), (0, 0, 0)
    )
    (picture,) = render_sketches(CAMERA, [seen])
    uv, _ = project(pose.xyz_camera[None], CAMERA.image_from_optical)
    assert picture.uv_px == pytest.approx(uv)
    left, top, right, bottom = picture.box_px[0]
    assert left < uv[0, 0] < right and top < uv[0, 1] < bottom


def test_view_has_velocities_of_peers_and_camera() -> None:
    def bodies(time_s: float) -> dict[str, RobotPose]:
        here = build_pose(0, 0, 0, yaw=0.5 * time_s, pitch=0.2 * time_s)
        return {"cf1": here, "cf2": build_pose(2, time_s, 0), "cf3": build_pose(-2, 0, 0)}

    seen = build_view(bodies, "cf1", 0.0, (0, 0, 0))
    assert list(seen.poses) == ["cf2"]
    # The peer moves left at 1 m/s. The camera turns left and down, which moves it right and up.
    assert seen.velocity_mps["cf2"] == pytest.approx((0, 1 - 2 * 0.5, 2 * 0.2), abs=1e-4)
    assert seen.turning_rps == pytest.approx((0.5, -0.2), abs=1e-4)
