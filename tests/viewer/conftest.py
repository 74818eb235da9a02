"""Recordings to look at, built in code."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl import topics
from dmrl.images import encode_jpeg, encode_png
from dmrl.messages import message
from dmrl.recording import Provenance, RecordingWriter

Make = Callable[..., Path]
STEP_NS = 100_000_000
WIDTH_PX, HEIGHT_PX = 64, 48
ROWS, COLS = HEIGHT_PX // 8, WIDTH_PX // 8


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """Recordings of ten images at 10 Hz of each robot, with all that a network adds."""

    def build(
        name: str = "flight.mcap",
        robots: tuple[str, ...] = ("cf1",),
        start_ns: int = 0,
        without: tuple[str, ...] = (),
    ) -> Path:
        with RecordingWriter(tmp_path / name, Provenance("test")) as sink:
            sink.write(start_ns, topics.attitude("cf1"), message("Attitude")())
            for k in range(10):
                for robot in robots:
                    for topic, sample in _messages(robot, k).items():
                        if topic.split("/")[2] not in without:
                            sink.write(start_ns + k * STEP_NS, topic, sample)
        return tmp_path / name

    return build


def _messages(robot: str, k: int) -> dict[str, Any]:
    rgb = np.full((HEIGHT_PX, WIDTH_PX, 3), 20 * k, np.uint8)
    picture = (encode_png(rgb), "png") if k % 2 else (encode_jpeg(rgb, 90), "jpeg")
    truth = {"peer": "cf2", "u_px": 20, "v_px": 12, "depth_m": 1.25, "source": "truth"}
    peers = [{**truth, "box_px": [16, 8, 28, 18]}, {**truth, "u_px": 30, "source": "published"}]
    cell = np.zeros((2, ROWS, COLS), "<f4")
    cell[0, 1, 2], cell[1, 1, 2] = 0.9, 1.2
    found = [
        {"u_px": 21, "v_px": 13, "depth_m": 1.2, "confidence": 0.9},
        {"u_px": 50, "v_px": 40, "depth_m": 2.0, "confidence": 0.1},
    ]
    return {
        topics.camera_image(robot): message("CompressedImage")(data=picture[0], format=picture[1]),
        # Nobody is labelled in the last image.
        topics.labels(robot): message("PeerLabels")(peers=peers if k < 9 else []),
        topics.detections(robot): message("Detections")(detections=found, threshold=0.5),
        topics.grid(robot): message("GridMap")(
            rows=ROWS,
            cols=COLS,
            channels=["confidence", "depth_m"],
            data=cell.tobytes(),
            stride_px=8,
        ),
    }


@pytest.fixture(autouse=True)
def no_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    """No window may open."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        if name in os.environ:
            monkeypatch.delenv(name)
