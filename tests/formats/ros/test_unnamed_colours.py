"""Colours of ROS images whose encoding or format does not name the channels."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from dmrl.formats.ros.ros_messages import CONVERTERS, MessageContext, _is_fixed_frame
from dmrl.images.bayer import to_bayer
from dmrl.images.codec import decode, encode_jpeg, encode_png
from dmrl.samples.sample import Sample

from .ros_writer import make_camera_info

SCENE = np.full((24, 32, 3), (200, 90, 30), np.uint8)


def convert(kind: str, message: object) -> tuple[list[Sample], MessageContext]:
    """Return the samples of a message of cf1, and its context after the conversion."""
    where = MessageContext(Path("bag"), "cf1")
    return list(CONVERTERS[kind](message, 1_500_000_000, where)), where


def test_unnamed_channels_are_read_as_bgr_and_reported() -> None:
    message = SimpleNamespace(
        height=24, width=32, encoding="8UC3", step=96, is_bigendian=0, data=SCENE[..., ::-1].ravel()
    )
    (found,), where = convert("sensor_msgs/msg/Image", message)
    assert decode(found.fields["data"]).tolist() == SCENE.tolist()
    assert where.changes == {"8UC3 is read as blue, green, red, as OpenCV has it": {"cf1"}}


@pytest.mark.parametrize("kind", ["png", "jpeg"])
def test_a_compressed_raw_picture_gets_its_colours(kind: str) -> None:
    raw = np.repeat(to_bayer(SCENE)[..., None], 3, 2)
    data = encode_png(raw) if kind == "png" else encode_jpeg(raw, 100)
    message = SimpleNamespace(
        data=np.frombuffer(data, np.uint8), format=f"bayer_rggb8; {kind} compressed "
    )
    (found,), _ = convert("sensor_msgs/msg/CompressedImage", message)
    inner = (slice(2, -2), slice(2, -2))
    assert np.abs(decode(found.fields["data"]).astype(int) - SCENE)[inner].max() < 9


def test_a_calibration_may_have_k_alone() -> None:
    message = make_camera_info(1_500_000_000, 100.0)
    full, _ = convert("sensor_msgs/msg/CameraInfo", message)
    message.p = message.r = np.zeros(0)
    assert convert("sensor_msgs/msg/CameraInfo", message)[0] == full


@pytest.mark.parametrize(
    ("frame", "fixed"),
    [
        *[(f, True) for f in ("map", "/cf1/odom", "cf1_odom", "local_origin", "odom_combined")],
        *[(f, False) for f in ("", "base_link", "cf1/base_footprint", "roadmap", "odometer")],
    ],
)
def test_frames_that_do_not_turn_are_known_by_their_end(frame: str, fixed: bool) -> None:
    assert _is_fixed_frame(frame) is fixed
