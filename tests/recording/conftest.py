"""Fixtures: recordings that are built in code."""

from collections.abc import Callable
from pathlib import Path

import pytest

from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter

Make = Callable[..., Path]


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """Write 40 s of attitude at 100 Hz and ranges at 10 Hz, with a calibration at the start."""
    path = tmp_path / "flight.mcap"
    with RecordingWriter(path, Provenance("test", {"level": 1}, seed=3)) as sink:
        sink.write(
            0, "/cf1/camera/calibration", message_class("CameraCalibration")(width=320, height=224)
        )
        for k in range(4000):
            attitude = message_class("Attitude")(roll_rad=0.1 * k, pitch_rad=0.5 if k % 3 else 0.0)
            sink.write(k * 10_000_000, "/cf1/attitude", attitude)
            if k % 10 == 0:
                sink.write(
                    k * 10_000_000, "/cf1/range/cf2", message_class("UwbRange")(range_m=1 + k)
                )
        sink.add_metadata("dmrl.split", {"train": "[[0, 10]]"})
    return path
