"""Topics of a recording are read as arrays."""

from pathlib import Path

import numpy as np
import pytest

from dmrl import topics
from dmrl.labelling.flight_log import SENSOR_TOPICS, read_flight
from dmrl.messages import STATUS_AMBIGUOUS, message_class
from dmrl.recording import Provenance, RecordingWriter

SECOND_NS = 1_000_000_000


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Write messages of several topics, one per second from 2 s."""
    rows = [
        (topics.ATTITUDE("a"), "Attitude", {"roll_rad": 1, "pitch_rad": 2, "yaw_rate_radps": 3}),
        (topics.VELOCITY("a"), "Velocity", {"vx_mps": 4, "vy_mps": 5}),
        (topics.RANGE("a", "b"), "UwbRange", {"range_m": 6}),
        (topics.POSITION("a", "b"), "PeerPosition", {"x": 1, "covariance": np.arange(9.0)}),
        (topics.POSITION("a", "b"), "PeerPosition", {"y": 2, "status": STATUS_AMBIGUOUS}),
        (topics.POSITION("a", "b"), "PeerPosition", {"z": 3, "covariance": np.arange(12.0)}),
        (topics.CALIBRATION("a"), "CameraCalibration", {"width": 320}),
        (topics.CALIBRATION("a"), "CameraCalibration", {"width": 640}),
    ]
    with RecordingWriter(tmp_path / "a.mcap", Provenance("test")) as sink:
        for k, (topic, kind, fields) in enumerate(rows, 2):
            sink.write(k * SECOND_NS, topic, message_class(kind)(**fields), publish_ns=k)
    return tmp_path / "a.mcap"


def test_a_flight_has_the_columns_of_its_sensors(path: Path) -> None:
    flight = read_flight(path, *SENSOR_TOPICS)
    assert (flight.path, flight.start_ns) == (path, 2 * SECOND_NS)
    assert flight.attitude["a"].values.tolist() == [[1, 2, 3]]
    assert flight.velocity["a"].values.tolist() == [[4, 5]]
    assert flight.ranges["a", "b"].values.tolist() == [[6]]
    assert (flight.height, flight.positions, flight.calibrations) == ({}, {}, {})
    assert flight.to_seconds(flight.velocity["a"].time_ns).tolist() == [1.0]
    assert flight.velocity["a"].set_back == 0


def test_a_covariance_that_is_missing_is_unknown(path: Path) -> None:
    found = read_flight(path, topics.POSITION).positions["a", "b"]
    assert found.xyz_m.tolist() == [[1, 0, 0], [0, 2, 0], [0, 0, 3]]
    assert found.covariance[0].ravel().tolist() == list(range(9))
    assert np.isnan(found.covariance[1:]).all()
    assert found.status.tolist() == [0, STATUS_AMBIGUOUS, 0]


def test_the_first_calibration_counts(path: Path) -> None:
    assert read_flight(path).calibrations["a"].width == 320
