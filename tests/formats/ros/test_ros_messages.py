"""ROS messages converted to dmrl's frames and units."""

from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import hypothesis
import numpy as np
import PIL.Image
import pytest
from hypothesis import strategies as st

from dmrl.formats.ros.ros_messages import (
    CONVERTERS,
    MessageContext,
    _compute_yaw_rate,
    _is_fixed_frame,
    _rotate_from_body,
    _rotate_from_fixed,
    _to_euler,
)
from dmrl.geometry.frames import camera_from_horizontal
from dmrl.geometry.rotations import euler_to_quaternion
from dmrl.images.codec import decode, encode_jpeg, encode_png
from dmrl.samples.sample import Sample
from dmrl.terminal.left_out import count_left_out

from .ros_writer import make_camera_info

QUARTER = np.pi / 2


@pytest.mark.parametrize(
    ("angles", "body", "level"),
    [
        ((QUARTER, 0, 0), (0, 1, 0), (0, 0, 1)),  # rolled to the right: its left side is up
        ((0, QUARTER, 0), (1, 0, 0), (0, 0, -1)),  # nose down
        ((QUARTER, QUARTER, 0), (0, 1, 0), (1, 0, 0)),
        ((QUARTER, QUARTER, 0), (0, 0, 1), (0, -1, 0)),
        ((0, 0, QUARTER), (1, 0, 0), (1, 0, 0)),  # the heading has no effect
    ],
)
def test_a_tilted_robot_s_vectors_are_levelled(
    angles: tuple[float, ...], body: tuple[float, ...], level: tuple[float, ...]
) -> None:
    got = _rotate_from_body(np.array(body), np.array(angles))
    assert got == pytest.approx(np.array(level), abs=1e-12)


def test_a_fixed_frame_s_vectors_are_turned_by_the_heading() -> None:
    left = np.array([0.3, -0.2, QUARTER])  # the tilt has no effect
    ahead, up = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    assert _rotate_from_fixed(ahead, left) == pytest.approx(np.array([1.0, 0.0, 0.0]), abs=1e-12)
    right = np.array([1.0, 0.0, 0.0])
    assert _rotate_from_fixed(right, left) == pytest.approx(np.array([0.0, -1.0, 0.0]), abs=1e-12)
    assert _rotate_from_fixed(up, left) == pytest.approx(up)


def xyzw(*values: float) -> SimpleNamespace:
    """Return a message with the fields x, y, z and, for four values, w."""
    return SimpleNamespace(**dict(zip("xyzw", values, strict=False)))


def convert(kind: str, message: object, **where: Any) -> list[Sample]:
    """Return the samples of a message of cf1."""
    placed = MessageContext(Path("bag"), "cf1", **where)
    return list(CONVERTERS[kind](message, 1_500_000_000, placed))


TILT = (0.3, -0.2, 0.5)
TURN = xyzw(*euler_to_quaternion(np.array([TILT]))[0])


def make_odometry(child: str, linear: tuple[float, ...]) -> SimpleNamespace:
    """Return an Odometry with a velocity in the frame ``child``, m/s."""
    twist = SimpleNamespace(linear=xyzw(*linear), angular=xyzw(0.1, 0.2, 0.4))
    held = SimpleNamespace(position=xyzw(1.0, 2.0, 3.0), orientation=TURN)
    return SimpleNamespace(
        header=SimpleNamespace(frame_id="odom"),
        child_frame_id=child,
        pose=SimpleNamespace(pose=held),
        twist=SimpleNamespace(twist=twist),
    )


def test_odometry_in_the_body_frame_is_levelled() -> None:
    found = convert("nav_msgs/msg/Odometry", make_odometry("cf1/base_link", (1.0, 2.0, 3.0)))
    pose, height, attitude, velocity = found
    assert [s.topic for s in found] == [
        "/cf1/pose",
        "/cf1/height",
        "/cf1/attitude",
        "/cf1/velocity",
    ]
    assert pose.fields["pose"]["position"] == {"x": 1, "y": 2, "z": 3}
    assert pose.fields["pose"]["orientation"] == vars(TURN)
    assert pose.fields["timestamp"] == {"seconds": 1, "nanos": 500_000_000}
    assert height.fields == {"height_m": 3.0}
    # The yaw rate is the angular velocity about the vertical, divided by the cosine of the pitch.
    rate = (0.2 * np.sin(0.3) + 0.4 * np.cos(0.3)) / np.cos(-0.2)
    assert tuple(attitude.fields.values()) == pytest.approx((*TILT, rate))
    level = _rotate_from_body(np.array([1.0, 2.0, 3.0]), np.array(TILT))
    assert list(velocity.fields.values()) == pytest.approx(level.tolist())
    assert list(velocity.fields) == ["vx_mps", "vy_mps", "vz_mps"]


@pytest.mark.parametrize("child", ["odom", "cf1/world", "map", "earth"])
def test_odometry_in_a_fixed_frame_is_turned_by_the_yaw(child: str) -> None:
    *_, attitude, velocity = convert("nav_msgs/msg/Odometry", make_odometry(child, (1.0, 2.0, 3.0)))
    assert attitude.fields["yaw_rate_radps"] == 0.4
    c, s = np.cos(0.5), np.sin(0.5)
    wanted = (c + 2 * s, -s + 2 * c, 3.0)
    assert tuple(velocity.fields.values()) == pytest.approx(wanted)


@pytest.mark.parametrize(("norm", "there"), [(0.91, True), (0.89, False), (1.11, False)])
def test_quaternion_far_from_unit_norm_gives_no_angles(norm: float, there: bool) -> None:
    found = _to_euler(xyzw(*(norm * value for value in vars(TURN).values())))
    assert (found is not None) == there
    assert found is None or found == pytest.approx(np.array(TILT))


def test_imu_and_twist_are_used_without_odometry(
    capsys: pytest.CaptureFixture[str],
) -> None:
    imu = SimpleNamespace(orientation=TURN, angular_velocity=xyzw(0.1, 0.2, 0.4))
    (attitude,) = convert("sensor_msgs/msg/Imu", imu)
    rate = (0.2 * np.sin(0.3) + 0.4 * np.cos(0.3)) / np.cos(-0.2)
    assert tuple(attitude.fields.values()) == pytest.approx((*TILT, rate))
    twist = SimpleNamespace(linear=xyzw(1.0, 2.0, 3.0))
    moved = SimpleNamespace(twist=twist, header=SimpleNamespace(frame_id="cf1"))
    (velocity,) = convert("geometry_msgs/msg/TwistStamped", moved)
    assert tuple(velocity.fields.values()) == (1.0, 2.0, 3.0)
    assert not convert("sensor_msgs/msg/Imu", imu, odometry=True)
    assert not convert("geometry_msgs/msg/TwistStamped", moved, odometry=True)
    moved.header.frame_id = "cf1/odom"
    assert not convert("geometry_msgs/msg/TwistStamped", moved)
    assert (
        "velocities of cf1 in a frame that does not turn with the robot: 1"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize(("range_m", "count"), [(0.0, 0), (0.01, 1), (59.99, 1), (60.0, 0)])
def test_ranges_are_over_0_and_under_60_m(range_m: float, count: int) -> None:
    found = convert("sensor_msgs/msg/Range", SimpleNamespace(range=range_m), peer="cf2")
    assert [(s.topic, s.fields) for s in found] == [
        ("/cf1/range/cf2", {"range_m": range_m}),
    ] * count


@pytest.mark.parametrize(("limits", "count"), [((0.0, 0.0), 1), ((0.2, 1.0), 1), ((0.2, 0.9), 0)])
def test_ranges_outside_their_own_limits_are_left_out(
    limits: tuple[float, float], count: int
) -> None:
    told = SimpleNamespace(range=1.0, min_range=limits[0], max_range=limits[1])
    assert len(convert("sensor_msgs/msg/Range", told, peer="cf2")) == count


@pytest.mark.parametrize("what", ["orientation", "angular_velocity"])
def test_negative_covariance_marks_missing_imu_fields(
    what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    level = {"orientation": xyzw(0.0, 0.0, 0.0, 1.0), "angular_velocity": xyzw(0.0, 0.0, 0.0)}
    for first, count in ((0.0, 1), (-1.0, 0)):
        covariance = {f"{what}_covariance": np.array([first, *[0.0] * 8])}
        imu = SimpleNamespace(**level, **covariance)
        assert len(convert("sensor_msgs/msg/Imu", imu)) == count
    assert f"IMU messages of cf1 without {what.replace('_', ' ')}: 1" in capsys.readouterr().err


def test_poses_of_motion_capture_are_written_as_truth() -> None:
    held = SimpleNamespace(pose=SimpleNamespace(position=xyzw(1, 2, 3), orientation=TURN))
    kind = "geometry_msgs/msg/PoseStamped"
    assert [s.topic for s in convert(kind, held)] == ["/cf1/pose"]
    assert [s.topic for s in convert(kind, held, captured=True)] == ["/cf1/pose/truth"]


@pytest.mark.parametrize("names", ["kpdr", "KPDR"])
def test_principal_point_moves_by_half_a_pixel(names: str) -> None:
    k, p = np.array([7.0, *range(1, 9)]), np.arange(12.0)
    values = (k, p, [0.1, 0.2], np.eye(3).ravel())
    told = SimpleNamespace(
        **dict(zip(names, values, strict=True)), width=64, height=48, distortion_model="plumb_bob"
    )
    (found,) = convert("sensor_msgs/msg/CameraInfo", told)
    assert found.topic == "/cf1/camera/calibration"
    assert found.fields["K"] == [7, 1, 2.5, 3, 4, 5.5, 6, 7, 8]
    assert found.fields["P"] == [0, 1, 2.5, 3, 4, 5, 6.5, 7, 8, 9, 10, 11]
    assert found.fields["D"] == [0.1, 0.2]
    assert found.fields["R"] == np.eye(3).ravel().tolist()
    assert (found.fields["width"], found.fields["height"]) == (64, 48)
    assert found.fields["timestamp"] == {"seconds": 1, "nanos": 500_000_000}
    assert k[2] == 2  # the message is not modified


@pytest.mark.parametrize(("rectified", "fx", "cx"), [(False, 200, 90), (True, 180, 91.5)])
def test_a_calibration_is_of_the_part_the_binning_and_the_rectification_of_its_images(
    fx: float, cx: float, *, rectified: bool
) -> None:
    told = make_camera_info(1_500_000_000, 400.0)
    told.k[:] = [400, 0, 279.5, 0, 400, 239.5, 0, 0, 1]
    told.p[:] = [360, 0, 282.5, 0, 0, 360, 239.5, 0, 0, 0, 1, 0]
    told.width, told.height, told.binning_x, told.binning_y = 640, 480, 2, 2
    told.d = np.array([0.1, 0.0, 0.0, 0.0, 0.0])
    told.roi.x_offset, told.roi.y_offset, told.roi.width, told.roi.height = 100, 40, 400, 300
    (found,) = convert("sensor_msgs/msg/CameraInfo", told, rectified=rectified)
    assert (found.fields["width"], found.fields["height"]) == (200, 150)
    assert found.fields["K"] == [fx, 0, cx, 0, fx, 100, 0, 0, 1]
    assert found.fields["D"] == ([] if rectified else [0.1, 0, 0, 0, 0])


def make_transforms(*stamps: tuple[int, int]) -> SimpleNamespace:
    """Return a TFMessage with a transform for each stamp, seconds and nanoseconds."""

    def make_transform(sec: int, nanosec: int) -> SimpleNamespace:
        stamp = SimpleNamespace(sec=sec, nanosec=nanosec)
        held = SimpleNamespace(translation=xyzw(1, 2, 3), rotation=TURN)
        header = SimpleNamespace(stamp=stamp, frame_id="world")
        return SimpleNamespace(header=header, child_frame_id="cf1", transform=held)

    return SimpleNamespace(transforms=[make_transform(*stamp) for stamp in stamps])


@pytest.mark.parametrize(("stamp", "time_ns"), [((2, 5), 2_000_000_005), ((0, 0), 1_500_000_000)])
def test_transforms_use_their_stamp_or_receive_time(stamp: tuple[int, int], time_ns: int) -> None:
    (found,) = convert("tf2_msgs/msg/TFMessage", make_transforms(stamp))
    assert found.time_ns == time_ns
    (entry,) = found.fields["transforms"]
    assert entry["translation"] == {"x": 1, "y": 2, "z": 3}
    assert entry["rotation"] == vars(TURN)
    assert (entry["parent_frame_id"], entry["child_frame_id"]) == ("world", "cf1")
    assert entry["timestamp"] == {"seconds": stamp[0], "nanos": stamp[1]}


def make_image(encoding: str, channels: int, spare: int = 0) -> SimpleNamespace:
    """Return an Image of 5 x 4 pixels whose byte n of row v is n + 32 v."""
    step = 5 * channels + spare
    rows = np.arange(step)[None] + 32 * np.arange(4)[:, None]
    data = rows.astype(np.uint8).ravel()
    return SimpleNamespace(
        height=4, width=5, step=step, encoding=encoding, data=data, is_bigendian=0
    )


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"height": 10_001}, "images over 10000 px long"),
        ({"step": 14}, "images with another number of bytes than their size states"),
        ({"step": 16}, "images with another number of bytes than their size states"),
        ({"encoding": "32FC1"}, "images of encoding '32FC1', which is not supported"),
    ],
)
def test_invalid_images_are_left_out_and_counted(change: dict[str, Any], reason: str) -> None:
    with count_left_out() as counted:
        assert not convert(
            "sensor_msgs/msg/Image", SimpleNamespace(**vars(make_image("rgb8", 3)) | change)
        )
    assert counted.counts == {reason: 1}


ANGLE = st.floats(-1.4, 1.4)


@hypothesis.given(
    ANGLE, ANGLE, st.floats(-3, 3), st.lists(st.floats(-2, 2), min_size=3, max_size=3)
)
@pytest.mark.heavy
def test_vectors_and_rates_are_turned_as_the_robot_is(
    roll: float, pitch: float, yaw: float, vector: list[float]
) -> None:
    angles, body = np.array([roll, pitch, yaw]), np.array(vector)
    level = camera_from_horizontal(roll, pitch).T @ body
    assert _rotate_from_body(body, angles) == pytest.approx(level)
    c, s = np.cos(yaw), np.sin(yaw)
    heading = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    assert _rotate_from_fixed(heading @ level, angles) == pytest.approx(level)
    turn = camera_from_horizontal(roll, pitch) @ [0, 0, 0.7]  # about the vertical
    assert _compute_yaw_rate(turn, angles) == pytest.approx(0.7)
    (quaternion,) = euler_to_quaternion(angles[None])
    assert _to_euler(xyzw(*quaternion)) == pytest.approx(angles, abs=1e-6)


@pytest.mark.parametrize(
    ("frame", "parent", "fixed"),
    [
        ("", "", False),
        ("", "odom", False),
        ("base", "odom", False),
        ("base", "base", True),
        ("odom", "", True),
        ("a/b/map", "x", True),
        ("map/base", "x", False),
        ("mapped", "x", False),
    ],
)
def test_fixed_frames_are_recognized_by_name(frame: str, parent: str, fixed: bool) -> None:
    assert _is_fixed_frame(frame, parent) == fixed


def test_imu_without_orientation_gives_no_attitude() -> None:
    lost = SimpleNamespace(orientation=xyzw(0, 0, 0, 0), angular_velocity=xyzw(0.1, 0.2, 0.4))
    assert convert("sensor_msgs/msg/Imu", lost) == []
    held = make_odometry("base", (1.0, 2.0, 3.0))
    held.pose.pose.orientation = lost.orientation
    assert [s.message for s in convert("nav_msgs/msg/Odometry", held)] == ["Height"]


def test_compressed_pictures_keep_their_bytes() -> None:
    rgb = np.full((8, 8, 3), 90, np.uint8)
    for data, kind in ((encode_png(rgb), "png"), (encode_jpeg(rgb), "jpeg")):
        message = SimpleNamespace(data=np.frombuffer(data, np.uint8), format=kind)
        (found,) = convert("sensor_msgs/msg/CompressedImage", message)
        assert (found.topic, found.time_ns) == ("/cf1/camera/image", 1_500_000_000)
        assert (found.fields["data"], found.fields["format"]) == (data, kind)


@pytest.mark.parametrize("kind", ["PPM", "TIFF", "WEBP"])
def test_compressed_pictures_of_other_formats_become_png(kind: str) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (8, 8, 3), np.uint8)
    buffer = BytesIO()
    PIL.Image.fromarray(rgb).save(buffer, kind, lossless=True)
    message = SimpleNamespace(data=np.frombuffer(buffer.getvalue(), np.uint8), format=kind.lower())
    (found,) = convert("sensor_msgs/msg/CompressedImage", message)
    assert found.fields["format"] == "png"
    assert decode(found.fields["data"]).tolist() == rgb.tolist()


@pytest.mark.parametrize(
    "data", [b"\0\0\0\1\x67" * 40, encode_jpeg(np.zeros((64, 64, 3), np.uint8))[:-99]]
)
def test_a_video_and_a_cut_picture_are_left_out(data: bytes) -> None:
    message = SimpleNamespace(data=np.frombuffer(data, np.uint8), format="h264")
    with count_left_out() as counted:
        assert not convert("sensor_msgs/msg/CompressedImage", message)
    assert counted.counts == {"images that cannot be decoded, of format 'h264'": 1}


def test_image_goes_to_the_robot_of_its_topic() -> None:
    (found,) = convert("sensor_msgs/msg/Image", make_image("rgb8", 3))
    assert (found.topic, found.time_ns) == ("/cf1/camera/image", 1_500_000_000)
    v, u, k = np.meshgrid(np.arange(4), np.arange(5), np.arange(3), indexing="ij")
    assert decode(found.fields["data"]).tolist() == (32 * v + 3 * u + k).tolist()
