"""Export of recordings to ROS 2 bags, read by rosbags and converted back."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from dmrl.exchange.ros2 import write_bag
from dmrl.images.codec import encode_png
from dmrl.messages import LogType, message_class
from dmrl.recording import RecordingWriter, build_provenance, read, read_summary
from dmrl.stages import convert

PNG = encode_png(np.full((4, 4, 3), 7, np.uint8))
STAMP = {"seconds": 3, "nanos": 5}


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Write a recording with one message of every type of dmrl."""
    path = tmp_path / "in.mcap"
    k = [100.0, 0, 2.5, 0, 101.0, 1.5, 0, 0, 1]
    messages = {
        "/cf1/camera/image": message_class("CompressedImage")(
            timestamp=STAMP, frame_id="cf1/optical", data=PNG, format="png"
        ),
        "/cf1/camera/calibration": message_class("CameraCalibration")(
            timestamp=STAMP, frame_id="cf1/optical", width=4, height=4, K=k, D=[0.1] * 5,
            P=[*k[:3], 0, *k[3:6], 0, *k[6:], 0], R=np.eye(3).ravel(), distortion_model="plumb_bob",
        ),
        "/cf1/attitude": message_class("Attitude")(roll_rad=0.1, pitch_rad=-0.2, yaw_rad=3.0),
        "/cf1/velocity": message_class("Velocity")(vx_mps=1.5),
        "/cf1/height": message_class("Height")(height_m=0.7),
        "/cf1/range/cf2": message_class("UwbRange")(range_m=2.25),
        "/cf1/labels": message_class("PeerLabels")(
            peers=[{"peer": "cf2", "box_px": [1, 2, 3, 4], "status": 2, "source": "truth"}]
        ),
        "/cf1/detections/grid": message_class("GridMap")(rows=1, channels=["a", "b"], data=b"\1\2"),
        "/cf1/peer/cf2/truth": message_class("PeerPosition")(
            frame_id="x", x=1.0, covariance=[0.0] * 9
        ),
        "/cf1/pose": message_class("PoseInFrame")(
            timestamp=STAMP, frame_id="world",
            pose={"position": {"x": 1, "y": 2, "z": 3}, "orientation": {"w": 1}},
        ),
        "/cf1/log/state": message_class(LogType("state", (("a.b", "f"), ("a.B", "H"), ("c", "h"))))(
            a_b=0.5, a_B=7, c=-3
        ),
        "/tf": message_class("FrameTransforms")(
            transforms=[
                {
                    "timestamp": STAMP, "parent_frame_id": "world", "child_frame_id": "a",
                    "translation": {"x": 1}, "rotation": {"w": 1},
                }
            ]
        ),
    }  # fmt: skip
    with RecordingWriter(path, build_provenance("test")) as sink:
        for topic, sent in messages.items():
            sink.write(3_000_000_005, topic, sent)
            sink.write(3_000_000_006, topic, sent)
    return path


@pytest.mark.heavy
def test_rosbags_reader_finds_every_exported_message(recording: Path, tmp_path: Path) -> None:
    counts = write_bag(recording, tmp_path / "bag")
    assert counts == {t: i.count for t, i in read_summary(recording).topics.items()}
    kinds = {}
    with AnyReader([tmp_path / "bag"]) as reader:
        for connection, time_ns, data in reader.messages():
            kinds[connection.topic] = connection.msgtype
            decoded = reader.deserialize(data, connection.msgtype)
            assert time_ns in (3_000_000_005, 3_000_000_006)
            if connection.topic == "/cf1/camera/calibration":
                # The pixel origin of ROS is the centre of the first pixel, dmrl's its corner.
                assert decoded.k[[0, 2, 5]].tolist() == [100.0, 2.0, 1.0]
            if connection.topic == "/cf1/labels":
                assert (decoded.peers[0].peer, decoded.peers[0].status) == ("cf2", 2)
    assert kinds["/cf1/camera/image"] == "sensor_msgs/msg/CompressedImage"
    assert kinds["/cf1/pose"] == "geometry_msgs/msg/PoseStamped"
    assert kinds["/cf1/attitude"] == "dmrl_msgs/msg/Attitude"
    assert kinds["/cf1/log/state"] == "dmrl_msgs/msg/LogState"


@pytest.mark.heavy
def test_exported_bag_converts_back_to_the_recording(recording: Path, tmp_path: Path) -> None:
    write_bag(recording, tmp_path / "bag")
    again = tmp_path / "again.mcap"
    convert.run(tmp_path / "bag", again, convert.Settings())
    before = {t: [s.message for s in read(recording, t)] for t in read_summary(recording).topics}
    after = {t: [s.message for s in read(again, t)] for t in read_summary(again).topics}
    # A calibration is written once; fields of log variables come back with other names.
    assert len(after["/cf1/camera/calibration"]) == 1
    assert len(after.pop("/cf1/log/state")) == len(before.pop("/cf1/log/state"))
    before["/cf1/camera/calibration"].pop()
    for topic, messages in before.items():
        got = [m.SerializeToString(deterministic=True) for m in after[topic]]
        for one, other in zip(messages, after[topic], strict=True):
            if one.DESCRIPTOR.full_name in ("foxglove.CompressedImage", "foxglove.PoseInFrame"):
                one.ClearField("timestamp"), other.ClearField("timestamp")
                if topic == "/cf1/pose":
                    assert one == other
                else:
                    assert (one.data, one.format) == (other.data, other.format)
            else:
                assert one == other, topic
        assert len(got) == len(messages)
