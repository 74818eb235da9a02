"""Small synthetic recordings for the viewer."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl import topics
from dmrl.images.codec import encode_jpeg, encode_png
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter

Make = Callable[..., Path]
STEP_NS = 100_000_000
WIDTH_PX, HEIGHT_PX = 64, 48
ROWS, COLS = HEIGHT_PX // 8, WIDTH_PX // 8


@pytest.fixture
def make_recording(tmp_path: Path) -> Make:
    """Return a function that writes ten images at 10 Hz of each robot.

    Each image has labels, detections and maps, except those named in ``without``.
    """

    def build(
        name: str = "flight.mcap",
        robots: tuple[str, ...] = ("cf1",),
        start_ns: int = 0,
        without: tuple[str, ...] = (),
    ) -> Path:
        with RecordingWriter(tmp_path / name, Provenance("test")) as sink:
            sink.write(start_ns, topics.ATTITUDE("cf1"), message_class("Attitude")())
            for k in range(10):
                for robot in robots:
                    for topic, sample in _make_image_messages(robot, k).items():
                        if topic.split("/")[2] not in without:
                            sink.write(start_ns + k * STEP_NS, topic, sample)
        return tmp_path / name

    return build


def _make_image_messages(robot: str, k: int) -> dict[str, Any]:
    """Return the messages of image k of a robot by topic."""
    rgb = np.full((HEIGHT_PX, WIDTH_PX, 3), 20 * k % 256, np.uint8)
    picture = (encode_png(rgb), "png") if k % 2 else (encode_jpeg(rgb, 90), "jpeg")
    truth = {"peer": "cf2", "u_px": 20, "v_px": 12, "depth_m": 1.25, "source": "truth"}
    peers = [{**truth, "box_px": [16, 8, 28, 18]}, {**truth, "u_px": 30, "source": "published"}]
    cell = np.zeros((2, ROWS, COLS), "<f4")
    cell[0, 1, 2], cell[1, 1, 2] = 0.9, 1.2
    cell[0, 3, 4], cell[1, 3, 4] = 0.04, 2.0  # below the lowest confidence that is shown
    cell[0, 4, 4], cell[1, 4, 4] = 0.06, 1.8
    found = [
        {"u_px": 21, "v_px": 13, "depth_m": 1.2, "confidence": 0.9},
        {"u_px": 50, "v_px": 40, "depth_m": 2.0, "confidence": 0.1},
    ]
    return {
        topics.CAMERA_IMAGE(robot): message_class("CompressedImage")(
            data=picture[0], format=picture[1]
        ),
        # The last image has no labelled peer.
        topics.LABELS(robot): message_class("PeerLabels")(peers=peers if k < 9 else []),
        topics.DETECTIONS(robot): message_class("Detections")(detections=found, threshold=0.5),
        topics.GRID(robot): message_class("GridMap")(
            rows=ROWS,
            cols=COLS,
            channels=["confidence", "depth_m"],
            data=cell.tobytes(),
            stride_px=8,
        ),
    }


@pytest.fixture
def make_flight(tmp_path: Path) -> Make:
    """Return a function that writes a flight of two robots over 2 s, with cf2 1 m ahead of cf1.

    Both robots stand still; cf1 faces along the world's y at (1, 2, 0.5), metres. Its estimates are
    0.1 m too far, which is one standard deviation. With ``moving`` both robots fly, and the truth
    and /tf come a third of a step after the other messages.
    """

    def build(
        name: str = "flight.mcap", without: tuple[str, ...] = (), *, moving: bool = False
    ) -> Path:
        with RecordingWriter(tmp_path / name, Provenance("test")) as sink:
            for k in range(20):
                for topic, sample in _make_flight_messages(k, 0.05 * k * moving).items():
                    late = moving and topic in (topics.TRANSFORMS, topics.TRUTH("cf1", "cf2"))
                    if not any(word in topic for word in without):
                        sink.write(k * STEP_NS + late * STEP_NS // 3, topic, sample)
        return tmp_path / name

    return build


def _make_flight_messages(k: int, way_m: float) -> dict[str, Any]:
    """Return the messages of step k by topic; the robots have moved by ``way_m`` metres."""
    exact, known = [0.0] * 9, [0.01, 0, 0, 0, 0.04, 0, 0, 0, 0.0025]
    truth = {"x": 1.0 + way_m, "covariance": exact, "frame_id": "cf1/horizontal"}
    followed = {"id": 3, "peer": "cf2", "x": 1.0, "vx_mps": 0.5, "covariance": known}
    messages = {
        topics.TRANSFORMS: message_class("FrameTransforms")(
            transforms=[
                _make_transform(
                    "world", "cf1/horizontal", (1.0 + way_m, 2.0, 0.5), (0, 0, 0.5**0.5, 0.5**0.5)
                ),
                _make_transform(
                    "world", "cf2/horizontal", (1.0, 3.0 + 0.01 * k, 0.5), (0, 0, 0, 1)
                ),
            ]
        ),
        topics.TRUTH("cf1", "cf2"): message_class("PeerPosition")(**truth),
        topics.POSITION("cf1", "cf2"): message_class("PeerPosition")(
            **{**truth, "x": 1.1 + way_m, "covariance": known, "status": 0 if k > 4 else 1}
        ),
        topics.RANGE("cf1", "cf2"): message_class("UwbRange")(range_m=1.05),
        topics.RANGE("cf2", "cf1"): message_class("UwbRange")(range_m=1.0),
        topics.TRACKS("cf1"): message_class("Tracks")(tracks=[followed] if k < 15 else []),
        topics.CALIBRATION("cf1"): message_class("CameraCalibration")(
            width=WIDTH_PX, height=HEIGHT_PX, K=[40, 0, 32, 0, 40, 24, 0, 0, 1]
        ),
        **_make_image_messages("cf1", k),
    }
    for robot in ("cf1", "cf2"):
        messages[topics.HEIGHT(robot)] = message_class("Height")(height_m=0.5)
        messages[topics.ATTITUDE(robot)] = message_class("Attitude")(
            roll_rad=0.1, yaw_rad=3.1 + 0.01 * k
        )
    return messages


def _make_transform(
    parent: str, child: str, xyz: tuple[float, ...], xyzw: tuple[float, ...]
) -> dict[str, Any]:
    """Return a transform with a translation, metres, and a quaternion."""
    return {
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": dict(zip("xyz", xyz, strict=True)),
        "rotation": dict(zip("xyzw", xyzw, strict=True)),
    }


@pytest.fixture(autouse=True)
def no_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Remove the display from the environment, so that no window can open."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        if name in os.environ:
            monkeypatch.delenv(name)
