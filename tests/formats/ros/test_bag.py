"""ROS bags: formats, times, and the assignment of topics to robots."""

from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from dmrl import topics
from dmrl.errors import SourceError
from dmrl.formats.base import Options
from dmrl.formats.registry import find_format
from dmrl.formats.ros import bag as ros
from dmrl.images.bayer import demosaic
from dmrl.images.codec import decode
from dmrl.samples.sample import Sample
from dmrl.terminal.left_out import count_left_out

from .. import foreign
from ..reading import group_by_topic
from . import ros_writer


def write_bag(kind: str, folder: Path) -> Path:
    """Write a bag of a kind; return its path."""
    if kind == "ros1":
        return foreign.write_ros1_bag(folder / "flight.bag")
    return foreign.write_ros2_bag(folder / "flight", kind)


def read_samples(source: Path, options: Options | None = None) -> dict[str, list[Sample]]:
    """Return the samples of a bag by topic."""
    return group_by_topic(ros.load_content(source, options or Options()).samples)


@pytest.mark.parametrize("kind", ["sqlite3", "mcap", "ros1"])
@pytest.mark.heavy
def test_all_kinds_of_bags_give_equal_samples(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = write_bag(kind, tmp_path)
    assert find_format(source).name == "rosbag2"
    found = read_samples(source)
    assert {topic: len(v) for topic, v in found.items()} == dict.fromkeys(
        [
            "/cf1/attitude",
            "/cf1/camera/image",
            "/cf1/height",
            "/cf1/pose",
            "/cf1/pose/truth",
            "/cf1/range/cf2",
            "/cf1/velocity",
        ],
        5,
    )
    assert [s.time_ns for s in found["/cf1/height"]] == [10**12 + k * 10**8 for k in range(5)]
    assert [s.fields["range_m"] for s in found["/cf1/range/cf2"]] == [1.5, 2.5, 3.5, 4.5, 5.5]
    assert found["/cf1/velocity"][0].fields["vx_mps"] == 1.0
    assert found["/cf1/attitude"][0].fields["yaw_rate_radps"] == pytest.approx(0.2)
    pixels = decode(found["/cf1/camera/image"][0].fields["data"])
    np.testing.assert_array_equal(pixels, demosaic(foreign.make_raw_images(1)[0]))
    assert "left out: messages on /chatter: std_msgs/msg/String" in capsys.readouterr().err


@pytest.mark.heavy
def test_receive_time_becomes_publish_time(tmp_path: Path) -> None:
    found = read_samples(foreign.write_ros2_bag(tmp_path / "flight", late_ns=7_000_000))
    for topic in ("/cf1/height", "/cf1/range/cf2", "/cf1/camera/image"):
        assert [s.time_ns for s in found[topic]] == [10**12 + k * 10**8 for k in range(5)]
        received = [s.publish_ns or 0 for s in found[topic]]
        assert received == [10**12 + k * 10**8 + 7_000_000 for k in range(5)]


@pytest.mark.parametrize(
    ("parent", "child", "down"),
    [
        ("odom_ned", "base_link", True),
        ("map", "cf1/base_link_frd", True),
        ("NED", "", True),
        ("odom", "aligned", False),
        ("odom", "base_link", False),
    ],
)
def test_motions_in_frames_whose_z_is_down_are_left_out(
    parent: str, child: str, down: bool
) -> None:
    held = ros_writer.make_odometry(1)
    held.header.frame_id, held.child_frame_id = parent, child
    line = ros.TopicPlan("/cf1/odom", ros.ODOMETRY, 1, "cf1")
    where = ros.MessageContext(Path("bag"), "cf1")
    with count_left_out() as left:
        assert bool(list(ros.convert_message(line, held, 1, where))) != down
    assert any("its z is down" in why for why in left.counts) == down


@pytest.mark.heavy
def test_zero_stamps_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    late_ns = 48 * 86_400 * 10**9
    source = foreign.write_ros2_bag(tmp_path / "flight", late_ns=late_ns, ranges_stamped=False)
    found = read_samples(source)
    assert found["/cf1/range/cf2"][0].time_ns == 10**12 + late_ns
    assert "get the bag's times: 5 on /uwb/cf1/cf2/distance" in capsys.readouterr().err


@pytest.mark.heavy
def test_robots_get_the_given_names(tmp_path: Path) -> None:
    found = read_samples(write_bag("sqlite3", tmp_path), Options(names={"cf1": "a", "cf2": "b"}))
    assert "/a/range/b" in found and "/a/attitude" in found


def test_bag_without_known_topics_gives_one_line_error(tmp_path: Path) -> None:
    lines, why = ros.plan_topics([("/chatter", "std_msgs/msg/String", 3)], Options())
    assert (lines, list(why)) == ({}, [("/chatter", "std_msgs/msg/String")])
    path = tmp_path / "a.db3"
    path.write_bytes(b"SQLite format 3\0" + b"\0" * 100)
    with pytest.raises(SourceError, match="cannot be read as a ROS bag") as e:
        read_samples(path)
    assert "\n" not in str(e.value)


def test_longer_of_two_odometry_topics_is_used() -> None:
    kind = "nav_msgs/msg/Odometry"
    lines, why = ros.plan_topics([("/cf1/odom", kind, 5), ("/vio/cf1/odom", kind, 50)], Options())
    assert [line.topic for line in lines.values()] == ["/vio/cf1/odom"]
    assert list(why) == [("/cf1/odom", kind)]


@pytest.mark.heavy
def test_a_real_bag_of_ranges_odometry_and_motion_capture(data: Path) -> None:
    counts = Counter(
        sample.topic
        for sample in ros.load_content(data / "uwb-tiers" / "shortbag.db3", Options()).samples
    )
    assert counts["/n_2/range/n_5"] == 252
    assert counts["/turtlebot3_cap/pose/truth"] == 1032
    assert counts["/turtle03/velocity"] == counts["/turtle03/attitude"] == 340
    assert sum(counts.values()) == 16204


RANGE, ODOMETRY, IMU = (
    "sensor_msgs/msg/Range",
    "nav_msgs/msg/Odometry",
    "sensor_msgs/msg/Imu",
)
POSE, TWIST = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TwistStamped"


def plan(*held: tuple[str, str, int], **names: str) -> tuple[dict[str, tuple[str, str]], list[str]]:
    """Return robot and peer of each topic that is converted, and the topics that are not."""
    lines, why = ros.plan_topics(list(held), Options(robot="me", names=names))
    found = {line.topic: (line.robot, line.peer) for line in lines.values()}
    return found, [topic for topic, _ in why]


def test_topics_are_assigned_to_robots() -> None:
    found, unknown = plan(
        ("/cf1/uwb/cf2/range", RANGE, 5),
        ("/imu/data", IMU, 5),
        ("/drone 3/odom", ODOMETRY, 5),
        ("/cf1/uwb", RANGE, 5),  # no peer is named
        ("/cf1/cf1/range", RANGE, 5),
        ("/cf9/odom", ODOMETRY, 0),
        (topics.MASKS.format(robot="cf1"), "sensor_msgs/msg/Image", 5),
        ("/chatter", "std_msgs/msg/String", 1),
        ("/quiet", "std_msgs/msg/String", 0),
        cf2="anchor",
    )
    assert found == {
        "/cf1/uwb/cf2/range": ("cf1", "anchor"),
        "/imu/data": ("me", ""),
        "/drone 3/odom": ("drone_3", ""),
    }
    assert {"/cf1/uwb", "/cf1/cf1/range", "/chatter"} <= set(unknown)
    assert not {"/cf9/odom", "/quiet"} & set(unknown)


@pytest.mark.parametrize(
    ("command", "kind"),
    [
        ("/mavros/setpoint_position/local", POSE),
        ("/mavros/setpoint_velocity/cmd_vel", TWIST),
        ("/goal_pose", POSE),
        ("/cf1/pose_desired", POSE),
    ],
)
def test_a_command_is_no_measurement_unless_the_user_says_so(command: str, kind: str) -> None:
    measured = "/mavros/local_position/measured"
    assert plan((command, kind, 9), (measured, kind, 5))[1] == [command]
    pattern = topics.POSE if kind == POSE else topics.VELOCITY
    found, unknown = plan((command, kind, 9), **{command: pattern.format(robot="cf1")})
    assert found == {command: ("cf1", "")} and not unknown


@pytest.mark.parametrize(
    ("part", "kind"),
    [
        *((part, TWIST) for part in ("vel", "velocity_body", "twist_local", "speed")),
        *((part, POSE) for part in ("vision_pose", "raw_data", "front_camera")),
    ],
)
def test_topic_part_that_names_its_content_is_not_a_robot(part: str, kind: str) -> None:
    found, _ = plan(("/drone/imu", IMU, 5), (f"/drone/{part}", kind, 5))
    assert {robot for robot, _ in found.values()} == {"drone"}


def test_a_velocity_of_the_body_comes_before_a_longer_one_of_the_map() -> None:
    found, unknown = plan(
        ("/mavros/local_position/velocity_local", TWIST, 9),
        ("/mavros/local_position/velocity_body", TWIST, 5),
    )
    assert found == {"/mavros/local_position/velocity_body": ("me", "")} and len(unknown) == 1


def test_a_pose_of_motion_capture_is_kept_beside_another_of_the_robot() -> None:
    kind = "geometry_msgs/msg/PoseStamped"
    found, unknown = plan(
        ("/cf1/pose", kind, 5), ("/vrpn_client_node/cf1/pose", kind, 9), ("/vio/cf1/pose", kind, 5)
    )
    assert found.keys() == {"/cf1/pose", "/vrpn_client_node/cf1/pose"}
    assert unknown == ["/vio/cf1/pose"]  # as many messages as the first one


@pytest.mark.heavy
def test_expected_message_count_is_an_estimate_per_topic(tmp_path: Path) -> None:
    content = ros.load_content(write_bag("sqlite3", tmp_path), Options())
    with_odometry = 4  # a message becomes attitude, velocity, height and pose
    assert content.total == len(list(content.samples)) - 5 * (with_odometry - 1)


def test_ranges_of_both_directions_and_our_own_messages_are_all_kept() -> None:
    ours = "dmrl_msgs/msg/Height"
    held = [
        ("/cf1/uwb/cf2/range", RANGE, 5),
        ("/cf2/uwb/cf1/range", RANGE, 9),
        ("/far/cf1/uwb/cf2/range", RANGE, 5),  # as many messages as the first one
        ("/cf1/height", ours, 1),
        ("/cf2/height", ours, 2),
        ("/cf1/odom", ODOMETRY, 2),
        ("/cf1/imu", IMU, 3),
    ]
    found, unknown = plan(*held)
    assert found == {
        "/cf1/uwb/cf2/range": ("cf1", "cf2"),
        "/cf2/uwb/cf1/range": ("cf2", "cf1"),
        "/cf1/height": ("", ""),
        "/cf2/height": ("", ""),
        "/cf1/odom": ("cf1", ""),
        "/cf1/imu": ("cf1", ""),
    }
    assert unknown == ["/far/cf1/uwb/cf2/range"]
    lines, _ = ros.plan_topics(held, Options())
    assert {line.topic: line.count for line in lines.values()} == {
        topic: count for topic, _, count in held if topic in found
    }


@pytest.mark.parametrize(
    ("stamp", "time_ns"), [((3, 5), 3_000_000_005), ((0, 0), 0), ((-1, 5), 0), (None, None)]
)
def test_a_header_s_stamp_is_whole_nanoseconds(
    stamp: tuple[int, int] | None, time_ns: int | None
) -> None:
    held = stamp and SimpleNamespace(sec=stamp[0], nanosec=stamp[1])
    message = SimpleNamespace(header=SimpleNamespace(stamp=held)) if held else SimpleNamespace()
    assert ros.header_time_ns(message) == time_ns


@pytest.mark.parametrize(
    ("name", "head", "known"),
    [
        ("a.db3", b"SQLite format 3\0", True),
        ("a.bag", b"#ROSBAG V2.0\n", True),
        ("a.bag", b"#ROSBAG V1.2\n", False),
        ("a.mcap", b"\x89MCAP0\r\n" + b"\1" * 20 + b"ros2", True),
        ("a.mcap", b"\x89MCAP0\r\n" + b"\1" * 20 + b"ros1", False),
        ("a.mcap", b"\1" * 60 + b"ros2", True),
        ("a.mcap", b"\1" * 61 + b"ros2", False),
        ("a.txt", b"SQLite format 3\0", False),
    ],
)
def test_bag_is_recognized_by_its_first_bytes(
    name: str, head: bytes, known: bool, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(head)
    assert ros.can_read(tmp_path / name) == known
    assert ros.can_read(tmp_path) == name.endswith(".db3")
    (tmp_path / "metadata.yaml").write_text("")
    assert ros.can_read(tmp_path)
