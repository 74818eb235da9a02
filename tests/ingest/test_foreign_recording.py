"""Conversion of MCAP files with Foxglove's own schemas and writers."""

import base64
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.writer import Writer as PlainWriter
from mcap_protobuf.schema import build_file_descriptor_set
from mcap_protobuf.writer import Writer
from rosbags.typesys import Stores, get_typestore

import dmrl
from dmrl.errors import MissingTopic, SettingError, SourceError
from dmrl.images.codec import UNDECODABLE, decode, encode_png
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, match_topics, read_summary, recover
from dmrl.stages.convert import Settings, run
from dmrl.terminal.left_out import count_left_out

START_NS = 1_700_000_000_000_000_000
PIXELS = np.arange(24 * 32 * 3, dtype=np.uint8).reshape(24, 32, 3)


def set_timestamp(message: Any, time_ns: int) -> Any:
    """Set the time stamp of a message and return it."""
    message.timestamp.FromNanoseconds(time_ns)
    return message


def write_foxglove_file(path: Path, sent: dict[str, Any], count: int = 3) -> Path:
    """Write a message per topic every 0.1 s, each received 1 ms after its time stamp."""
    with path.open("wb") as stream, Writer(stream) as writer:
        for k in range(count):
            for topic, message in sent.items():
                time_ns = START_NS + k * 10**8
                late = time_ns + 10**6
                writer.write_message(topic, set_timestamp(message, time_ns), late, late)
    return path


def convert_and_open(path: Path, out: Path, **settings: Any) -> tuple[Any, dict[str, int]]:
    """Convert a file; return the recording, and the count of everything left out by reason."""
    with count_left_out() as left:
        run(path, out, Settings(**settings))
    return dmrl.open(out), dict(left.counts)


CAMERA = CameraCalibration(
    width=32, height=24, distortion_model="plumb_bob", D=[0.0] * 5,
    K=[20, 0, 15.5, 0, 20, 11.5, 0, 0, 1], R=np.eye(3).ravel(),
    P=[20, 0, 15.5, 0, 0, 20, 11.5, 0, 0, 0, 1, 0],
)  # fmt: skip


def build_pose(x: float = 1.0, w: float = 1.0) -> PoseInFrame:
    """Build a pose at x, metres, with this w of its quaternion."""
    made = PoseInFrame()
    made.pose.position.x, made.pose.orientation.w = x, w
    return made


def test_foxglove_s_messages_become_topics_of_robots(tmp_path: Path) -> None:
    raw = RawImage(width=32, height=24, encoding="bgr8", step=96, data=PIXELS.tobytes())
    sent = {
        "/camera/image": CompressedImage(data=encode_png(PIXELS), format="png"),
        "/camera/info": CAMERA,
        "/fleet/cf2/front/raw": raw,
        "/fleet/cf2/pose": build_pose(),
        "/vicon/cf2/pose": build_pose(2.0),
    }
    found, left = convert_and_open(
        write_foxglove_file(tmp_path / "a.mcap", sent), tmp_path / "b.mcap"
    )
    assert not left
    assert {topic: info.count for topic, info in found.topics.items()} == {
        "/cf1/camera/image": 3,
        "/cf1/camera/calibration": 1,
        "/cf2/camera/image": 3,
        "/cf2/pose": 3,
        "/cf2/pose/truth": 3,
    }
    table = found["/cf2/camera/image"].to_arrow()
    assert table["log_time"].to_pylist() == [START_NS + k * 10**8 for k in range(3)]
    assert table["publish_time"][0].as_py() == START_NS + 10**6
    np.testing.assert_array_equal(decode(table["data"][0].as_py()), PIXELS[..., ::-1])
    # As in ROS, Foxglove's pixel origin is the centre of the first pixel.
    assert found["/cf1/camera/calibration"].to_arrow()["K"][0].as_py()[2] == 16.0


def test_unusable_topics_are_reported(tmp_path: Path) -> None:
    image = CompressedImage(data=encode_png(PIXELS), format="png")
    sent = {
        "/a/image": image,
        "/a/video": CompressedImage(data=b"\0\0\0\1\x67", format="h264"),
        "/b/video": CompressedImage(data=b"\0\0\0\1\x67", format="h264"),
        "/b/pose": build_pose(math.nan),
        "/c/pose": build_pose(1.0, 0.0),
    }
    found, left = convert_and_open(
        write_foxglove_file(tmp_path / "a.mcap", sent), tmp_path / "b.mcap"
    )
    assert list(found.topics) == ["/a/camera/image"]
    assert left == {
        "messages on /a/video: another topic has this of a, /a/image": 3,
        f"{UNDECODABLE}, of format 'h264'": 3,
        "samples of /b/pose with values that are not finite": 3,
        "orientations of c that are no unit quaternion": 3,
    }


def test_unusable_messages_and_schemas_do_not_affect_others(tmp_path: Path) -> None:
    height = message_class("Height")
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = PlainWriter(stream)
        writer.start(library="another")
        wrong = build_file_descriptor_set(CompressedImage).SerializeToString()
        right = build_file_descriptor_set(height).SerializeToString()
        for topic, name, schema, data in (
            ("/cf1/height", "dmrl.v1.Height", right, height(height_m=2.0).SerializeToString()),
            ("/cf2/height", "dmrl.v1.Height", right, b"\xff\xff\xff"),
            ("/cf1/log/a", "dmrl.log.A", wrong, b""),
            ("/cf3/pose", "foxglove.PoseInFrame", wrong, build_pose().SerializeToString()),
        ):
            channel = writer.register_channel(
                topic, "protobuf", writer.register_schema(name, "protobuf", schema)
            )
            writer.add_message(channel, 5, data, 5)
        writer.finish()
    found, left = convert_and_open(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert list(found.topics) == ["/cf1/height"]
    assert left == {
        f"messages on {topic} that cannot be decoded": 1
        for topic in ("/cf2/height", "/cf1/log/a", "/cf3/pose")
    }


def write_json_file(path: Path, sent: dict[str, tuple[str, list[Any]]]) -> Path:
    """Write topics of JSON messages, given the schema name and messages of each."""
    with path.open("wb") as stream:
        writer = PlainWriter(stream)
        writer.start()
        for topic, (name, messages) in sent.items():
            schema = writer.register_schema(name, "jsonschema", b"{}")
            channel = writer.register_channel(topic, "json", schema)
            for k, message in enumerate(messages):
                data = message if isinstance(message, bytes) else json.dumps(message).encode()
                writer.add_message(channel, START_NS + k, data, START_NS + k)
        writer.finish()
    return path


def test_foxglove_s_messages_in_json(tmp_path: Path) -> None:
    stamp = {"sec": 1_700_000_001, "nsec": 5}
    image = {
        "timestamp": stamp, "frame_id": "c", "format": "png",
        "data": base64.b64encode(encode_png(PIXELS)).decode(),
    }  # fmt: skip
    pose = {
        "timestamp": stamp, "frame_id": "map",
        "pose": {"position": {"x": 1, "y": 2.5, "z": 3},
                 "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}},
    }  # fmt: skip
    path = write_json_file(
        tmp_path / "a.mcap",
        {
            "/cam": ("foxglove.CompressedImage", [image, image | {"data": "%%"}, b"{", [], {}]),
            "/pose": ("foxglove.PoseInFrame", [pose, {"pose": 3}]),
            "/other": ("my.Thing", [{"x": 1}]),
        },
    )
    found, left = convert_and_open(path, tmp_path / "b.mcap", robot="cf4")
    image_table = found["/cf4/camera/image"].to_arrow()
    assert image_table["log_time"].to_pylist() == [1_700_000_001_000_000_005]
    assert image_table["data"].to_pylist() == [encode_png(PIXELS)]
    position = found["/cf4/pose"].to_arrow()["pose"][0].as_py()["position"]
    assert position == {"x": 1.0, "y": 2.5, "z": 3.0}
    assert left == {
        "messages on /other: my.Thing in json is not converted": 1,
        "messages on /cam that cannot be decoded": 4,
        "messages on /pose that cannot be decoded": 1,
    }


def test_topics_are_renamed_to_topics_of_dmrl(tmp_path: Path) -> None:
    sent = {
        "/rec/x": CompressedImage(data=encode_png(PIXELS), format="png"),
        "/rec/y": build_pose(),
    }
    path = write_foxglove_file(tmp_path / "a.mcap", sent)
    names = "/rec/x=/cf5/camera/image,/rec/y=/cf6/pose/truth"
    found, _ = convert_and_open(path, tmp_path / "b.mcap", names=names)
    assert set(found.topics) == {"/cf5/camera/image", "/cf6/pose/truth"}
    with pytest.raises(SettingError, match=r"is not converted to /cf5/height"):
        run(path, tmp_path / "c.mcap", Settings(names="/rec/x=/cf5/height"))
    with pytest.raises(SettingError, match="is not OLD=NEW"):
        run(path, tmp_path / "c.mcap", Settings(names="x=/cf5/camera/image"))
    assert not (tmp_path / "c.mcap").exists()


def test_missing_topic_error_suggests_renaming(tmp_path: Path) -> None:
    sent = {"/camera/image": CompressedImage(data=encode_png(PIXELS), format="png")}
    path = write_foxglove_file(tmp_path / "a.mcap", sent)
    with pytest.raises(MissingTopic, match="--names /camera/image=/cf1/camera/image"):
        match_topics(path, ["/*/camera/image"])


def test_a_copy_that_dmrl_made_of_a_foreign_file_is_converted(tmp_path: Path) -> None:
    """The copy has dmrl's provenance but foreign topics."""
    sent = {"/cf7/camera/picture": CompressedImage(data=encode_png(PIXELS), format="png")}
    recover(write_foxglove_file(tmp_path / "a.mcap", sent), tmp_path / "b.mcap")
    assert run(tmp_path / "b.mcap", tmp_path / "c.mcap", Settings()) == {"/cf7/camera/image": 3}


def test_robots_of_a_recording_of_dmrl_are_renamed(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.add_metadata("dmrl.split", {"train": "[[5, 5]]"})
        label = message_class("PeerLabel")(peer="cf2", u_px=3.0)
        sink.write(5, "/cf1/labels", message_class("PeerLabels")(peers=[label]))
        sink.write(5, "/cf1/range/cf2", message_class("UwbRange")(range_m=1.5))
        sink.write(5, "/cf3/height", message_class("Height")(height_m=0.5))
    with pytest.raises(SourceError, match="is a recording already"):
        run(path, tmp_path / "b.mcap", Settings())
    found, left = convert_and_open(
        path, tmp_path / "b.mcap", names="cf2=red,/cf3/height=/blue/height"
    )
    assert not left and set(found.topics) == {"/cf1/labels", "/cf1/range/red", "/blue/height"}
    assert found.labels()["peer"].tolist() == ["red"]
    assert read_summary(tmp_path / "b.mcap").metadata["dmrl.split"] == [{"train": "[[5, 5]]"}]


@pytest.mark.parametrize(
    ("stamp", "time_ns"),
    [
        ({"sec": "1700000001", "nsec": 5}, 1_700_000_001_000_000_005),
        ("2023-11-14T22:13:21.000000005Z", 1_700_000_001_000_000_005),
        (1_700_000_001.5, 1_700_000_001_500_000_000),
        ("soon", START_NS),
    ],
)
def test_json_times_have_several_forms(
    stamp: object, time_ns: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = base64.urlsafe_b64encode(encode_png(PIXELS)).decode().rstrip("=")
    image = {"timestamp": stamp, "frame_id": "c", "format": "png", "data": data}
    path = write_json_file(tmp_path / "a.mcap", {"/cam": ("foxglove.CompressedImage", [image])})
    found, _ = convert_and_open(path, tmp_path / "b.mcap")
    assert found["/cf1/camera/image"].to_arrow()["log_time"].to_pylist() == [time_ns]
    assert ("get the bag's times: 1 on /cam" in capsys.readouterr().err) == (stamp == "soon")


@pytest.mark.parametrize("profile", ["", "ros2"])
@pytest.mark.parametrize("other", ["json", "protobuf", ""])
def test_ros_messages_beside_other_encodings_are_converted(
    profile: str, other: str, tmp_path: Path
) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "geometry_msgs/msg/PoseStamped"
    held, types = build_pose().pose, store.types
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = PlainWriter(stream)
        writer.start(profile=profile)
        text = store.generate_msgdef(kind)[0].encode()
        schema = writer.register_schema(kind, "ros2msg", text)
        channels = [writer.register_channel("/cf1/pose", "cdr", schema)]
        if other:
            number = writer.register_schema("my.M", other, b"")
            channels.append(writer.register_channel("/other", other, number))
        for k in range(4):
            pose = types["geometry_msgs/msg/Pose"](
                types["geometry_msgs/msg/Point"](held.position.x, 0.0, 0.0),
                types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
            )
            stamp = types["builtin_interfaces/msg/Time"](7, k)
            header = types["std_msgs/msg/Header"](stamp, "map")
            data = bytes(store.serialize_cdr(types[kind](header, pose), kind))
            for channel in channels:
                writer.add_message(channel, START_NS + k, data, START_NS + k)
        writer.finish()
    found, left = convert_and_open(tmp_path / "a.mcap", tmp_path / "b.mcap")
    table = found["/cf1/pose"].to_arrow()
    assert table["log_time"].to_pylist() == [7_000_000_000 + k for k in range(4)]
    reason = f"messages on /other: my.M in {other} is not converted"
    assert left == ({reason: 4} if other else {})


def test_third_party_foxglove_file_is_converted(data: Path, tmp_path: Path) -> None:
    source = data / "strangers" / "fox-plain_topic" / "fx_plain.mcap"
    assert run(source, tmp_path / "a.mcap", Settings()) == {"/cf1/camera/image": 5}
