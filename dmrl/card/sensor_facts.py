"""Describe the sensors and cameras of recordings in words for a card."""

from collections.abc import Iterable
from itertools import islice
from typing import Any

from dmrl import topics
from dmrl.recording import LoadedRecording

NOT_SENSORS = (topics.CAMERA_IMAGE, topics.LABELS, topics.DETECTIONS, topics.GRID, topics.TRACKS)
"""Topics that a dataset consists of, or that models compute: no sensors."""


def find_sensor_patterns(names: Iterable[str]) -> list[str]:
    """Return the patterns of sensor topics among these topics, in the order of the table."""
    names = set(names)
    patterns = (row.pattern for row in topics.TOPICS if row.pattern not in NOT_SENSORS)
    return [p for p in patterns if any(topics.parse_topic(p, name) is not None for name in names)]


def describe_cameras(held: Iterable[LoadedRecording]) -> dict[str, str]:
    """Describe the first calibration of each robot's camera, by recording and robot."""
    found = {}
    for one in held:
        for topic in one.topics:
            if (names := topics.parse_topic(topics.CALIBRATION, topic)) is None:
                continue
            for stamped in islice(one.iter_messages(topic), 1):
                if words := _describe_camera(stamped.message):
                    found[f"{one.path.name}: {names['robot']}"] = words
    return found


def _describe_camera(calibration: Any) -> str:
    """Describe a CameraCalibration in words; empty unless K is a row-major 3 x 3 matrix."""
    if len(calibration.K) != 9:
        return ""
    fx, _, cx, _, fy, cy, *_ = calibration.K
    size = f"{calibration.width} x {calibration.height} px"
    words = f"{size}, fx {fx:.2f}, fy {fy:.2f}, cx {cx:.2f}, cy {cy:.2f}"
    bent = ", ".join(f"{value:.4g}" for value in calibration.D)
    return f"{words}, distortion {bent}" if any(calibration.D) else words
