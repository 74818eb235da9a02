"""Small synthetic sources of every binary format."""

import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from dmrl.formats.aideck.cpx import Image
from dmrl.formats.aideck.cpx_encode import pack_image
from dmrl.formats.aideck.cpx_state import RobotState
from dmrl.images.codec import encode_jpeg, encode_png

from . import plain_usd

STATE = ("x", "y", "z", "qx", "qy", "qz", "qw", "vx", "vy", "vz")
EVENTS: dict[int, tuple[str, plain_usd.Variables]] = {
    0xFFFF: (
        "fixedFrequency",
        [
            *((f"stateEstimate.{name}", "f") for name in STATE),
            *((f"gyro.{axis}", "f") for axis in "xyz"),
            ("pm.vbatMV", "H"),
            ("ranging.distance2", "H"),
        ],
    ),
    9: ("estPose", [(f"locSrv.{name}", "f") for name in STATE[:7]]),
    4: ("estDistance", [("id", "B"), ("distance", "f")]),
}


def pack_usd_log(version: int = 2, records: int = 100) -> bytes:
    """Return a micro-SD log of a flight at 1 m height, with motion capture and ranges at 50 Hz."""
    unit = {1: 1, 2: 1000}[version]
    rows: list[plain_usd.Record] = []
    for k in range(records):
        turn = (0.0, 0.0, float(np.sin(0.005 * k)), float(np.cos(0.005 * k)))
        state = (0.01 * k, 0.0, 1.0, *turn, 0.5, 0.0, 0.0, 0.0, 0.0, 28.6479)
        rows.append((0xFFFF, (1000 + 20 * k) * unit, (*state, 3900, 1500 + k)))
        if k % 5 == 0:
            rows.append((9, (1001 + 20 * k) * unit, (0.01 * k, 0.0, 1.0, *turn)))
            rows.append((4, (1002 + 20 * k) * unit, (3, 2.5 + 0.01 * k)))
    return plain_usd.encode(EVENTS, rows, version)


def pack_flash_dump(raw: Sequence[np.ndarray], values: Sequence[Sequence[float]]) -> bytes:
    """Return a HyperFlash dump of raw images, each with six numbers, and an end marker."""
    records = [
        pixels.astype(np.uint8).tobytes() + struct.pack("<6f", *numbers)
        for pixels, numbers in zip(raw, values, strict=True)
    ]
    return b"".join(records) + b"\xff" * 71704


def make_raw_images(count: int, height: int = 24, width: int = 32) -> list[np.ndarray]:
    """Return (height, width) uint8 images of random pixels; the same at every call."""
    rng = np.random.default_rng(5)
    return [rng.integers(0, 256, (height, width), np.uint8) for _ in range(count)]


def pack_cpx_stream() -> bytes:
    """Return three images in the CPX layout of nanocockpit, then one in that of Bitcraze."""
    state = RobotState(1000, 990_000, (1.0, 2.0, 0.5), (0.1, 0.0, 0.0))
    made = b"".join(
        pack_image(
            Image(32, 24, "raw", raw.tobytes(), 1_000_000 + 50_000 * k, k, state), "streamer"
        )
        for k, raw in enumerate(make_raw_images(3))
    )
    return made + pack_image(Image(32, 24, "raw", make_raw_images(1)[0].tobytes()))


def _make_messages(store: Any, ranges_stamped: bool) -> list[tuple[str, str, int, Any]]:
    """Return topic, type, time in nanoseconds and content of 25 messages at 10 Hz."""
    types = store.types

    def header(time_ns: int, fields: dict[str, Any]) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="world", **fields)

    def point(name: str, *xyz: float) -> Any:
        return types[f"geometry_msgs/msg/{name}"](*xyz)

    found = []
    more = {"seq": 0} if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__ else {}
    for k in range(5):
        time_ns = 10**12 + k * 10**8
        head = header(time_ns, more)
        pose = types["geometry_msgs/msg/Pose"](
            point("Point", 0.1 * k, 0.0, 1.0), point("Quaternion", 0.0, 0.0, 0.0, 1.0)
        )
        twist = types["geometry_msgs/msg/Twist"](
            point("Vector3", 1.0, 0.0, 0.0), point("Vector3", 0.0, 0.0, 0.2)
        )
        odometry = types["nav_msgs/msg/Odometry"](
            header=head,
            child_frame_id="base",
            pose=types["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
            twist=types["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)),
        )
        found.append(("/cf1/odom", "nav_msgs/msg/Odometry", time_ns, odometry))
        stamped = types["geometry_msgs/msg/PoseStamped"](head, pose)
        found.append(("/vrpn/cf1/pose", "geometry_msgs/msg/PoseStamped", time_ns, stamped))
        ranged = types["sensor_msgs/msg/Range"](
            header=head if ranges_stamped else header(0, more),
            radiation_type=0, field_of_view=0.0, min_range=0.0, max_range=0.0,
            range=1.5 + k,
        )  # fmt: skip
        found.append(("/uwb/cf1/cf2/distance", "sensor_msgs/msg/Range", time_ns, ranged))
        raw = make_raw_images(1)[0]
        image = types["sensor_msgs/msg/Image"](
            header=head, height=24, width=32, encoding="bayer_rggb8", is_bigendian=0, step=32,
            data=raw.ravel(),
        )  # fmt: skip
        found.append(("/cf1/camera/image_raw", "sensor_msgs/msg/Image", time_ns, image))
        text = types["std_msgs/msg/String"]("hello")
        found.append(("/chatter", "std_msgs/msg/String", time_ns, text))
    return found


def write_ros2_bag(
    folder: Path, storage: str = "sqlite3", *, late_ns: int = 0, ranges_stamped: bool = True
) -> Path:
    """Write a rosbag2 folder with odometry, motion capture, ranges, raw images and text.

    Messages are received ``late_ns`` after their stamps. Without ``ranges_stamped`` the stamps of
    the ranges are 0.
    """
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer2(folder, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        _write(writer, store, store.serialize_cdr, late_ns, ranges_stamped)
    return folder


def write_ros1_bag(path: Path) -> Path:
    """Write the messages of `write_ros2_bag` to a ROS 1 bag."""
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer1(path) as writer:
        _write(writer, store, store.serialize_ros1)
    return path


def _write(
    writer: Any,
    store: Any,
    serialize: Callable[[Any, str], Any],
    late_ns: int = 0,
    ranges_stamped: bool = True,
) -> None:
    """Write the messages to an open bag."""
    connections: dict[str, Any] = {}
    for topic, kind, time_ns, message in _make_messages(store, ranges_stamped):
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, kind, typestore=store)
        writer.write(connections[topic], time_ns + late_ns, serialize(message, kind))


def write_nanocockpit(folder: Path, count: int = 6) -> Path:
    """Write a folder of the nanocockpit client.

    Image number and time wrap between the third and the fourth image.
    """
    (folder / "camera_raw").mkdir(parents=True)
    state = "state_x,state_y,state_z,state_vx,state_vy,state_vz,state_ax,state_ay,state_az"
    lines = [
        "filename,metadata_version,frame_id,frame_gap8_timestamp,state_gap8_timestamp,"
        f"state_stm32_timestamp,tof_timestamp,{state},state_quat,state_rateRoll,state_ratePitch,"
        "state_rateYaw"
    ]
    for k, raw in enumerate(make_raw_images(count)):
        (folder / "camera_raw" / f"{k:05d}.png").write_bytes(encode_png(raw))
        time = (2**32 - 120_000 + 50_000 * k) % 2**32
        told = (time - 5_000) % 2**32
        level = 3 << 30  # w is largest, x = y = z = 0
        numbers = [10, (253 + k) % 256, time, told, k, 0, 100 * k, 0, 900, 500, 0, 0, 0, 0, 0]
        lines.append(",".join(map(str, [f"{k:05d}.jpg", *numbers, level - 2**32, 0, 0, 250])))
    (folder / "metadata.csv").write_text("\n".join(lines) + "\n")
    return folder


def encode_grey_image(height: int = 24, width: int = 32) -> dict[str, bytes]:
    """Return one image as PNG, JPEG and PPM, by file name."""
    rgb = np.repeat(make_raw_images(1, height, width)[0][..., None], 3, axis=2)
    head = f"P6\n# hi\n{width} {height}\n255\n".encode()
    return {"a.png": encode_png(rgb), "b.jpg": encode_jpeg(rgb), "c.ppm": head + rgb.tobytes()}
