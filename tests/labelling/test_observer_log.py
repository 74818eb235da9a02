"""The log of an observer: detections, attitude, motion and ranges of each image."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl import topics
from dmrl.errors import MissingTopic, RecordingError
from dmrl.geometry.frames import AIDECK
from dmrl.labelling.calibration.calibration_flight import (
    DEFAULT_COVARIANCE,
    read_calibration_flight,
)
from dmrl.labelling.flight_log import read_flight
from dmrl.labelling.observer_log import LONGEST_GAP_S, ObserverLog, read_observer_log
from dmrl.messages import STATUS_AMBIGUOUS, STATUS_OK, message_class
from dmrl.recording import Provenance, RecordingWriter

SECOND_NS = 1_000_000_000
Row = tuple[float, str, str, dict[str, Any]]
"""Time (seconds), topic, message type and fields."""
TURN_RADPS = 0.2


def build_detection(
    u_px: float, confidence: float = 0.9, depth_m: float = 2.0, sigma_m: float = 0.1
) -> Any:
    """Return the fields of a detection."""
    values = {"u_px": u_px, "v_px": u_px / 2, "depth_m": depth_m, "confidence": confidence}
    return {**values, "sigma_depth_m": sigma_m}


def build_detections_row(time_s: float, *found_there: Any, threshold: float = 0.5) -> Row:
    """Return a row of detections at a time in seconds."""
    fields = {"detections": list(found_there), "threshold": threshold}
    return time_s, topics.DETECTIONS("cf1"), "Detections", fields


def list_motion_rows(velocity: bool = True, height: bool = True) -> list[Row]:
    """Return the log of 10 s of a robot with constant velocity, yaw rate, climb and tilt rates."""
    rows: list[Row] = []
    for time_s in np.arange(0, 10.05, 0.1).tolist():
        tilt = {"roll_rad": 0.01 * time_s, "pitch_rad": -0.02 * time_s}
        turn = {**tilt, "yaw_rate_radps": TURN_RADPS}
        rows.append((time_s, topics.ATTITUDE("cf1"), "Attitude", turn))
        if velocity:
            rows.append((time_s, topics.VELOCITY("cf1"), "Velocity", {"vx_mps": 1, "vy_mps": 0.5}))
        if height:
            rows.append((time_s, topics.HEIGHT("cf1"), "Height", {"height_m": 0.3 * time_s}))
    return rows


def write_recording(path: Path, rows: Sequence[Row]) -> Path:
    """Write rows of time, topic, type and fields; return the path."""
    with RecordingWriter(path, Provenance("test")) as sink:
        for time_s, topic, kind, fields in rows:
            sink.write(round(time_s * SECOND_NS), topic, message_class(kind)(**fields))
    return path


def read_log(
    path: Path, rows: Sequence[Row], threshold: float | None = None, **camera: Any
) -> ObserverLog:
    """Write rows and read them as the log of the observer cf1."""
    write_recording(path, rows)
    return read_observer_log(read_flight(path), "cf1", replace(AIDECK, **camera), threshold)


def test_detections_are_given_to_their_image(tmp_path: Path) -> None:
    rows = [
        build_detections_row(
            1.0, build_detection(10), build_detection(20, 0.5), build_detection(30, 0.49)
        ),
        build_detections_row(2.0),
        build_detections_row(
            3.0, build_detection(40, depth_m=0.0), build_detection(50, depth_m=3.0, sigma_m=0.0)
        ),
    ]
    sight = read_log(tmp_path / "a.mcap", [*rows, *list_motion_rows()])
    assert sight.view(0).uv.tolist() == [[10, 5], [20, 10]]
    assert sight.view(0).sigma_depth_m.tolist() == pytest.approx([0.1, 0.1])
    assert len(sight.view(1).uv) == 0
    assert sight.view(2).uv.tolist() == [[50, 25]]
    assert (sight.view(2).depth_m.tolist(), sight.view(2).sigma_depth_m.tolist()) == ([3.0], [0.0])


def test_a_given_threshold_replaces_that_of_the_detector(tmp_path: Path) -> None:
    rows = [
        build_detections_row(1.0, build_detection(10, 0.45), build_detection(20, 0.3)),
        *list_motion_rows(),
    ]
    assert len(read_log(tmp_path / "a.mcap", rows).detections) == 0
    assert read_log(tmp_path / "b.mcap", rows, 0.4).detections[:, 0].tolist() == [10]


def test_attitude_is_interpolated_at_the_exposure(tmp_path: Path) -> None:
    sight = read_log(
        tmp_path / "a.mcap", [build_detections_row(4.0), *list_motion_rows()], delay_s=0.5
    )
    assert (sight.log_time_ns[0], sight.time_ns[0]) == (4 * SECOND_NS, 3.5 * SECOND_NS)
    view = sight.view(0)
    assert (view.roll_rad, view.pitch_rad) == pytest.approx((0.035, -0.07))


def test_motion_between_images_is_along_the_axes_before(tmp_path: Path) -> None:
    sight = read_log(
        tmp_path / "a.mcap",
        [build_detections_row(2.0), build_detections_row(3.0), *list_motion_rows()],
    )
    first, moved = sight.motion(0), sight.motion(1)
    assert (first.dt_s, first.shift_m.tolist(), first.turn_rad) == (0.0, [0, 0, 0], 0.0)
    assert (moved.dt_s, moved.turn_rad) == pytest.approx((1.0, TURN_RADPS))
    # The path is an arc: the integral of e^(i w t) (vx + i vy) over a second.
    arc = (1 + 0.5j) * (np.exp(1j * TURN_RADPS) - 1) / (1j * TURN_RADPS)
    assert moved.shift_m == pytest.approx([arc.real, arc.imag, 0.3], abs=1e-3)
    assert sight.warnings == []


def test_missing_velocity_or_height_means_standing_still_and_warns(tmp_path: Path) -> None:
    sight = read_log(
        tmp_path / "a.mcap",
        [build_detections_row(2.0), build_detections_row(3.0), *list_motion_rows(False, False)],
    )
    assert sight.motion(1).shift_m.tolist() == [0, 0, 0]
    assert sight.warnings == [
        "/cf1/velocity: not there; cf1 is taken to stand still",
        "/cf1/height: not there; cf1 is taken to keep its height",
    ]


def test_the_nearest_range_counts_in_time_and_then_in_length(tmp_path: Path) -> None:
    heard = [(0.97, 2.0), (1.05, 3.0), (5.0 + LONGEST_GAP_S - 0.01, 4.0), (7.2, 5.0)]
    rows = [
        build_detections_row(1.0),
        build_detections_row(1.02),
        build_detections_row(5.0),
        build_detections_row(7.0),
        *list_motion_rows(),
    ]
    rows += [(t, topics.RANGE("cf1", "cf2"), "UwbRange", {"range_m": r}) for t, r in heard]
    rows += [(5.0, topics.RANGE("cf2", "cf1"), "UwbRange", {"range_m": 4.5})]
    rows += [(7.0, topics.RANGE("cf2", "cf3"), "UwbRange", {"range_m": 1.0})]
    sight = read_log(tmp_path / "a.mcap", rows)
    assert [sight.ranges(k) for k in range(4)] == [{"cf2": 2.0}, {"cf2": 3.0}, {"cf2": 4.0}, {}]


def test_an_observer_without_attitude_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(MissingTopic, match="/cf1/attitude"):
        read_log(tmp_path / "a.mcap", [build_detections_row(1.0)])
    lost = (1.0, topics.ATTITUDE("cf1"), "Attitude", {"roll_rad": float("nan")})
    with pytest.raises(RecordingError, match="/cf1/attitude holds no numbers"):
        read_log(tmp_path / "b.mcap", [build_detections_row(1.0), lost])


def test_calibration_flight_has_detections_and_peer_paths(tmp_path: Path) -> None:
    place = {"x": 1.0, "y": 2.0, "z": 3.0}
    spread = [0.04, 0, 0, 0, 0.05, 0, 0, 0, 0.06]
    topic = topics.POSITION("cf1", "cf2")
    rows: list[Row] = [
        build_detections_row(1.0, build_detection(10), build_detection(20)),
        build_detections_row(2.0),
        build_detections_row(3.0, build_detection(30)),
        *list_motion_rows(),
    ]
    rows += [(1.0, topic, "PeerPosition", {**place, "covariance": spread, "status": STATUS_OK})]
    rows += [(1.5, topic, "PeerPosition", {**place, "status": STATUS_AMBIGUOUS})]
    rows += [(2.0, topic, "PeerPosition", {**place, "x": 1.5, "status": STATUS_OK})]
    rows += [(1.0, topics.POSITION("cf1", "cf3"), "PeerPosition", {**place, "status": STATUS_OK})]
    rows += [(1.0, topics.POSITION("cf2", "cf3"), "PeerPosition", {**place, "status": STATUS_OK})]
    path = write_recording(tmp_path / "a.mcap", rows)
    flight = read_calibration_flight(read_flight(path), "cf1", None, topics.POSITION)
    assert flight.image_s.tolist() == [1.0, 2.0, 3.0]
    assert flight.image.tolist() == [0, 0, 2]
    assert flight.uv.tolist() == [[10, 5], [20, 10], [30, 15]]
    assert flight.attitude_rad[10].tolist() == pytest.approx([0.01, -0.02])
    assert flight.peers.keys() == {"cf2"}  # cf3 has a single position, which makes no path
    path_of = flight.peers["cf2"]
    assert path_of.time_s.tolist() == [1.0, 2.0]
    assert path_of.xyz_m.tolist() == [[1, 2, 3], [1.5, 2, 3]]
    assert path_of.covariance[0].diagonal().tolist() == [0.04, 0.05, 0.06]
    assert path_of.covariance[1].tolist() == DEFAULT_COVARIANCE.tolist()
    with pytest.raises(MissingTopic):
        read_calibration_flight(read_flight(path), "cf1", None, topics.TRUTH)
