"""Third-party bags: readable data are kept, the rest is counted and named."""

import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

import dmrl
from dmrl.errors import SettingError, SourceError
from dmrl.formats.base import Options
from dmrl.formats.ros.bag import load_content
from dmrl.images.codec import UNDECODABLE, encode_jpeg
from dmrl.samples.sample import Sample
from dmrl.stages.convert import Settings, run
from dmrl.terminal.left_out import count_left_out

from ..reading import group_by_topic
from . import ros_writer as ros
from .ros_writer import START_NS, Sent, make_times

pytestmark = pytest.mark.heavy


def read_samples(path: Path, **options: object) -> tuple[dict[str, list[Sample]], dict[str, int]]:
    """Return the samples of a bag by topic, and the counts of what was left out."""
    with count_left_out() as left:
        found = group_by_topic(load_content(path, Options(**options)).samples)  # type: ignore[arg-type]
    return found, dict(left.counts)


def convert(folder: Path, sent: list[Sent]) -> tuple[dict[str, list[Sample]], dict[str, int]]:
    """Write messages to a bag; return its samples by topic, and what was left out."""
    return read_samples(ros.write_bag(folder / "bag", sent))


def send_odometry(topic: str, count: int = 5) -> list[Sent]:
    """Return odometry messages at 10 Hz."""
    return [Sent(topic, t, ros.make_odometry(t)) for t in make_times(count)]


def send_calibration(topic: str, focal_px: float, count: int = 5) -> list[Sent]:
    """Return calibrations at 10 Hz."""
    return [Sent(topic, t, ros.make_camera_info(t, focal_px)) for t in make_times(count)]


def send_images(topic: str, encoding: str = "rgb8", count: int = 5) -> list[Sent]:
    """Return images at 10 Hz."""
    return [Sent(topic, t, ros.make_image(t, encoding)) for t in make_times(count)]


@pytest.mark.parametrize(
    ("topic", "others", "pair"),
    [
        ("/cf1/range/down", (), None),
        ("/cf1/tof/range", (), None),
        ("/cf1/range_front", (), None),
        ("/cf1/zrange", (), None),
        ("/cf1/vl53l1x_1/range", (), None),
        ("/cf1/sonar2", (), None),
        ("/cf1/mystery/range", (), None),
        ("/drone/teraranger_evo/distance", (), None),
        ("/mavros/distance_sensor/hrlv_ez4_pub", (), None),
        ("/cf1/range/cf2", (), ("cf1", "cf2")),
        ("/cf1/uwb/cf2", (), ("cf1", "cf2")),
        ("/uwb/alice/bob/distance", (), ("alice", "bob")),
        ("/alice/range/bob", ("/bob/odom",), ("alice", "bob")),
        ("/alice/range/bob", ("/alice/odom",), None),
        ("/swarm/cf1/uwb/swarm/cf2", (), ("cf1", "cf2")),
    ],
)
def test_range_topics_without_two_robots_are_left_out(
    topic: str, others: tuple[str, ...], pair: tuple[str, str] | None, tmp_path: Path
) -> None:
    sent = [Sent(topic, t, ros.make_range(t)) for t in make_times()] + send_odometry("/x7/odom")
    for other in others:
        sent += send_odometry(other)
    found, left = convert(tmp_path, sent)
    wanted = [f"/{pair[0]}/range/{pair[1]}"] if pair else []
    assert [t for t in found if "/range/" in t] == wanted
    why = "it names no two robots, so it is no range to a peer"
    reason = f"messages on {topic}: {why} (--names {topic}=/ROBOT/range/PEER)"
    assert left == ({} if pair else {reason: 5})


@pytest.mark.parametrize(
    ("odom", "camera", "robot"),
    [
        ("/swarm/ns/cf7/mavros/local_position/odom", "/swarm/ns/cf7/camera/color/image_raw", "cf7"),
        ("/cf7/vins_estimator/odometry", "/cf7/cam0/image_raw", "cf7"),
        ("/drone_3/state_estimator/ekf2/odom", "/drone_3/front_cam/image", "drone_3"),
        ("/alpha/planner/odom", "/alpha/camera/image", "alpha"),
        ("/mavros/local_position/odom", "/camera/image_raw", "cf1"),
        ("/fleet/uav2/odom", "/fleet/uav2/realsense/infra1/image_rect_raw", "uav2"),
        ("/robot/odom", "/robot/camera/image_raw", "robot"),
    ],
)
def test_ros_namespaces_are_not_taken_for_robots(
    odom: str, camera: str, robot: str, tmp_path: Path
) -> None:
    found, left = convert(tmp_path, send_odometry(odom) + send_images(camera))
    assert {topic.split("/")[1] for topic in found} == {robot} and not left
    assert len(found[f"/{robot}/camera/image"]) == len(found[f"/{robot}/pose"]) == 5


def test_guessed_robot_name_is_reported_and_can_be_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sent = send_odometry("/lab/alpha/odom") + send_odometry("/cf2/odom")
    path = ros.write_bag(tmp_path / "bag", sent)
    found, _ = read_samples(path)
    assert "/lab/height" in found
    assert "/lab/alpha/odom is taken as lab's. --names /lab/alpha/odom=NAME decides" in (
        capsys.readouterr().err
    )
    for names in ({"/lab/alpha/odom": "cf9"}, {"alpha": "cf9"}):
        found, _ = read_samples(path, names=names)
        assert {"/cf9/height", "/cf2/height"} <= found.keys()
    assert "is taken as" not in capsys.readouterr().err
    run(path, tmp_path / "a.mcap", Settings(names="/lab/alpha/odom=cf9,cf2=cf3"))
    assert dmrl.open(tmp_path / "a.mcap").robots == ["cf3", "cf9"]
    with pytest.raises(SettingError, match="is not OLD=NEW"):
        run(path, tmp_path / "b.mcap", Settings(names="/lab/alpha/odom=c f"))


def test_non_finite_numbers_are_omitted_and_counted(tmp_path: Path) -> None:
    nan, sent = math.nan, []
    turns = [(0.0, 0.0, 0.0, 1.0), (nan, 0.0, 0.0, 1.0), (0.0,) * 4, (0.0, 0.0, 0.0, 1.0)]
    for t, z, turn in zip(make_times(4), (1.0, 1.0, 1.0, math.inf), turns, strict=True):
        sent.append(Sent("/cf1/odom", t, ros.make_odometry(t, z, turn)))
    for t, value in zip(make_times(6), (nan, math.inf, 0.0, -1.0, 99.0, 2.0), strict=True):
        sent.append(Sent("/cf1/uwb/cf2", t, ros.make_range(t, value)))
        sent.append(Sent("/vicon/cf1/pose", t, ros.make_pose(t, value)))
        sent.append(Sent("/cf1/camera_info", t, ros.make_camera_info(t, 0.0)))
    found, left = convert(tmp_path, sent)
    assert {topic: len(held) for topic, held in found.items()} == {
        "/cf1/pose": 1,
        "/cf1/height": 3,
        "/cf1/attitude": 2,
        "/cf1/velocity": 2,
        "/cf1/range/cf2": 1,
        "/cf1/pose/truth": 4,
    }
    assert left == {
        "samples of /cf1/pose with values that are not finite": 1,
        "samples of /cf1/height with values that are not finite": 1,
        "orientations of cf1 that are no unit quaternion": 2,
        "ranges of /cf1/range/cf2 that are not over 0 and under 60 m": 5,
        "samples of /cf1/pose/truth with values that are not finite": 2,
        "calibrations of cf1 without a focal length": 6,
    }


@pytest.mark.parametrize(
    ("other", "encoding"),
    [
        ("/cf1/camera/depth/image_rect_raw", "16UC1"),
        ("/cf1/aaa/image", "32FC1"),
        ("/cf1/aaa/image", "nonsense9"),
    ],
)
def test_images_that_are_no_picture_spare_the_camera(
    other: str, encoding: str, tmp_path: Path
) -> None:
    sent = send_images(other, encoding, 9) + send_odometry("/cf1/odom")
    sent += send_images("/cf1/camera/image_raw")
    found, left = convert(tmp_path, sent)
    assert len(found["/cf1/camera/image"]) == len(found["/cf1/height"]) == 5
    (reason,) = left
    assert left == {reason: 9} and reason.startswith(f"messages on {other}: ")
    why = "those of depths" if "depth" in other else "this of cf1, /cf1/camera/image_raw"
    assert why in reason


def test_depths_alone_are_no_pictures_unless_they_are_named(tmp_path: Path) -> None:
    depth = "/cf1/depth/image_rect_raw"
    path = ros.write_bag(tmp_path / "bag", send_images(depth, "16UC1") + send_odometry("/cf1/odom"))
    found, left = read_samples(path)
    assert "/cf1/camera/image" not in found and len(found["/cf1/height"]) == 5
    assert left == {
        f"messages on {depth}: its name and encoding are those of depths "
        f"(--names {depth}=/cf1/camera/image takes it as images)": 5
    }
    found, left = read_samples(path, names={depth: "/cf1/camera/image"})
    assert len(found["/cf1/camera/image"]) == 5 and not left


def test_the_topics_that_the_user_names_are_taken_among_several(tmp_path: Path) -> None:
    sent = send_images("/cf1/front/image_raw", "rgb8", 9) + send_images("/cf1/down/image_raw")
    sent += send_calibration("/cf1/front/camera_info", 100.0)
    sent += send_calibration("/cf1/down/camera_info", 55.0)
    path = ros.write_bag(tmp_path / "bag", sent)
    found, left = read_samples(path, names={"/cf1/down/image_raw": "/cf1/camera/image"})
    assert len(found["/cf1/camera/image"]) == 5
    assert found["/cf1/camera/calibration"][0].fields["K"][0] == 55.0
    why = "another topic has this of cf1, /cf1/down/image_raw"
    assert f"messages on /cf1/front/image_raw: {why}" in left


def test_calibrations_that_change_are_counted(tmp_path: Path) -> None:
    sent = [
        Sent("/cf1/camera_info", t, ros.make_camera_info(t, 50.0 + k))
        for k, t in enumerate(make_times())
    ]
    last_ns = make_times()[-1] + 1
    sent.append(Sent("/cf1/camera_info", last_ns, ros.make_camera_info(last_ns, 50.0)))
    found, left = convert(tmp_path, sent)
    assert len(found["/cf1/camera/calibration"]) == 1
    assert left == {"calibrations on /cf1/camera/calibration that differ from the first": 4}


def test_numbered_vehicles_of_px4_are_robots(tmp_path: Path) -> None:
    sent = send_odometry("/px4_1/fmu/out/odom") + send_odometry("/px4_2/fmu/out/odom")
    found, left = convert(tmp_path, sent)
    assert {topic.split("/")[1] for topic in found} == {"px4_1", "px4_2"} and not left


def test_video_and_torn_pictures_spare_the_others(tmp_path: Path) -> None:
    whole = encode_jpeg(np.full((24, 32, 3), 90, np.uint8))
    sent = send_odometry("/cf1/odom")
    for k, t in enumerate(make_times(8)):
        data = whole[: len(whole) // 2] if k == 3 else b"" if k == 5 else whole
        sent.append(Sent("/cf1/cam/compressed", t, ros.make_compressed_image(t, "jpeg", data)))
        video = b"\0\0\0\1\x67" + bytes(40)
        sent.append(Sent("/cf1/cam/h264", t, ros.make_compressed_image(t, "h264", video)))
        sent.append(Sent("/cf2/cam/h264", t, ros.make_compressed_image(t, "h264", video)))
    found, left = read_samples(ros.write_bag(tmp_path / "bag", sent, "sqlite3"))
    assert len(found["/cf1/camera/image"]) == 6 and "/cf2/camera/image" not in found
    assert left == {
        "messages on /cf1/cam/h264: another topic has this of cf1, /cf1/cam/compressed": 8,
        f"{UNDECODABLE}, of format 'jpeg'": 2,
        f"{UNDECODABLE}, of format 'h264'": 8,
    }


def test_calibration_belongs_to_the_camera_of_the_kept_images(tmp_path: Path) -> None:
    sent = send_images("/cf1/color/image_raw") + send_images("/cf1/depth/image_raw", "16UC1", 9)
    sent += send_calibration("/cf1/depth/camera_info", 100.0, 9)
    sent += send_calibration("/cf1/color/camera_info", 55.0, 1)
    found, _ = convert(tmp_path, sent)
    (calibration,) = found["/cf1/camera/calibration"]
    assert calibration.fields["K"][0] == 55.0


@pytest.mark.parametrize(
    ("name", "rectified"), [("image_rect_color", True), ("image_raw", False), ("rectangle", False)]
)
def test_rectified_images_have_the_calibration_without_the_lens(
    tmp_path: Path, name: str, *, rectified: bool
) -> None:
    told = ros.make_camera_info(START_NS, 55.0)
    told.p[[0, 5]] = 44.0
    sent = [*send_images(f"/cf1/camera/{name}"), Sent("/cf1/camera/camera_info", START_NS, told)]
    found, _ = convert(tmp_path, sent)
    (calibration,) = found["/cf1/camera/calibration"]
    assert calibration.fields["K"][0] == (44.0 if rectified else 55.0)


def test_an_imu_with_an_orientation_comes_before_a_longer_raw_one(tmp_path: Path) -> None:
    sent = []
    for name, count, first in (("data_raw", 9, -1.0), ("data", 4, 0.0)):
        for t in make_times(count):
            held = ros.make_odometry(t)
            turn, rate = held.pose.pose.orientation, held.twist.twist.angular
            told = ros.TYPES["sensor_msgs/msg/Imu"](
                *(held.header, turn, np.array([first, *[0.0] * 8])),
                *(rate, np.zeros(9), rate, np.zeros(9)),
            )
            sent.append(Sent(f"/cf1/imu/{name}", t, told))
    found, left = convert(tmp_path, sent)
    assert len(found["/cf1/attitude"]) == 4
    assert list(left.values()) == [9]


def test_messages_that_cannot_be_decoded_spare_the_others(tmp_path: Path) -> None:
    sent = send_odometry("/cf1/odom")
    kind = "nav_msgs/msg/Odometry"
    for t, torn in zip(make_times(2), (b"", b"\0\1\0\0ab"), strict=True):
        sent.append(Sent("/cf1/odom", t + 1, torn, kind))
    found, left = convert(tmp_path, sent)
    assert len(found["/cf1/height"]) == 5
    assert left == {f"messages on /cf1/odom that cannot be decoded as {kind}": 2}
    all_torn = [Sent("/cf1/odom", t, b"\0\1\0\0", kind) for t in make_times()]
    with pytest.raises(SourceError, match="nothing in it can be used"):
        run(ros.write_bag(tmp_path / "torn", all_torn), tmp_path / "a.mcap", Settings())
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize("text", ["MSG: a/srv/B_Event\nuint8 k\n---\nint64 s\n", "", "\0\1", "}{"])
def test_definitions_that_cannot_be_parsed_spare_the_others(tmp_path: Path, text: str) -> None:
    """Definitions of service events, for example, hold several types of one name."""
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        sent = {"/add/_service_event": "a/srv/B_Event", "/x": "custom_msgs/msg/X"}
        sent["/cf1/odom"] = "nav_msgs/msg/Odometry"
        for topic, kind in sent.items():
            data = text.encode()
            schema = writer.register_schema(kind, "ros2msg", data)
            channel = writer.register_channel(topic, "cdr", schema)
            for t in make_times():
                body = bytes(ros.STORE.serialize_cdr(ros.make_odometry(t), "nav_msgs/msg/Odometry"))
                writer.add_message(channel, t, body, t)
        writer.finish()
    found, left = read_samples(tmp_path / "a.mcap")
    assert len(found["/cf1/height"]) == 5
    assert left == {
        "messages on /add/_service_event: a/srv/B_Event is not converted": 5,
        "messages on /x: custom_msgs/msg/X is not converted": 5,
    }


def test_pose_topic_is_left_out_beside_longer_odometry(tmp_path: Path) -> None:
    sent = send_odometry("/cf1/odom")
    sent += [Sent("/cf1/pose", t, ros.make_pose(t)) for t in make_times(9)]
    found, left = convert(tmp_path, sent)
    assert len(found["/cf1/pose"]) == 5
    assert left == {"messages on /cf1/pose: another topic has this of cf1, /cf1/odom": 9}


@pytest.mark.parametrize(
    ("name", "wanted", "line"),
    [
        ("range_down_sensor", {"height": 20}, "/cf1/range/down"),
        ("namespaced_deep", {"height": 20, "camera/image": 20}, ""),
        ("odom_nan", {"height": 16, "pose": 16, "camera/image": 20}, "not finite"),
        ("rgb_and_depth", {"height": 20, "camera/image": 20}, "/cf1/camera/depth/image_rect_raw"),
        ("comp_h264_beside", {"height": 20, "camera/image": 20}, "/cf1/cam2/image_raw/compressed"),
        ("comp_one_truncated", {"height": 20, "camera/image": 19}, "be decoded, of format 'jpeg'"),
        ("svc_event.mcap", {"height": 20}, "/add/_service_event"),
    ],
)
def test_third_party_bags_are_converted(
    name: str,
    wanted: dict[str, int],
    line: str,
    data: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    source = data / "strangers" / f"ros-{name.removesuffix('.mcap')}" / name
    with count_left_out():
        counts = Counter(run(source, tmp_path / "a.mcap", Settings()))
    assert len(dmrl.open(tmp_path / "a.mcap").robots) == 1
    kept = {topic.split("/", 2)[2]: count for topic, count in counts.items()}
    assert kept | wanted == kept and not any("range" in topic for topic in kept)
    assert line in capsys.readouterr().err
