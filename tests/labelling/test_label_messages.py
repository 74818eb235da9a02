"""Messages of positions, labels and causes in a recording."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl import topics
from dmrl.estimation.solver.estimate import Innovation
from dmrl.geometry.frames import AIDECK, Camera, pixels_from_horizontal
from dmrl.labelling.flight_log import read_flight
from dmrl.labelling.image_labels import MIN_DEPTH_M, CameraOptions
from dmrl.labelling.label_messages import (
    build_cause_messages,
    build_label_messages,
    build_position_series,
)
from dmrl.labelling.pair_report import PairCause, PairReport
from dmrl.labelling.peer_positions import PeerPositions
from dmrl.labelling.sensor_logs import RobotLog, SensorLogs
from dmrl.messages import STATUS_OK, STATUS_UNCONVERGED, message_class
from dmrl.recording import Provenance, RecordingWriter, read

SECOND_NS = 1_000_000_000
START_NS = 5 * SECOND_NS
TIMES_S = np.array([0.0, 10.0])
ROLL_RATE, PITCH_RATE = 0.02, -0.01


def build_log() -> RobotLog:
    """Return the log of a robot with constant roll and pitch rates, so each time has a tilt."""
    attitude = np.column_stack([ROLL_RATE * TIMES_S, PITCH_RATE * TIMES_S, 0 * TIMES_S])
    return RobotLog((TIMES_S, attitude), (TIMES_S, np.zeros((2, 2))), (TIMES_S, np.ones((2, 1))))


def build_logs(flying: Sequence[str] = ("cf1", "cf2")) -> SensorLogs:
    """Return the sensor logs of a flight in which only cf1 has a log."""
    return SensorLogs(START_NS, {"cf1": build_log()}, {}, frozenset(flying), [])


def write_flight(path: Path, images_s: Sequence[float], labels: Sequence[Any] = ()) -> Path:
    """Write a flight of cf1 with empty images at times in seconds, and labels."""
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.write(START_NS, topics.HEIGHT("cf1"), message_class("Height")(height_m=1.0))
        for moment in images_s:
            time_ns = START_NS + round(moment * SECOND_NS)
            sink.write(time_ns, topics.CAMERA_IMAGE("cf1"), message_class("CompressedImage")())
        for time_ns, entry in labels:
            sink.write(time_ns, topics.LABELS("cf1"), entry)
    return path


def build_positions(time_s: Sequence[float], status: int = STATUS_OK) -> PeerPositions:
    """Return positions of a peer that moves from right to left, 2 m ahead."""
    count = len(time_s)
    xyz_m = np.column_stack(
        [np.full(count, 2.0), np.linspace(-0.2, 0.2, count), np.full(count, 0.1)]
    )
    time_ns = START_NS + np.rint(np.array(time_s) * SECOND_NS).astype(np.int64)
    covariance = np.tile(np.diag([0.04, 0.03, 0.02]), (count, 1, 1))
    return PeerPositions(time_ns, xyz_m, covariance, np.full(count, status, np.int8))


def build_labels(
    path: Path, found: dict[str, PeerPositions], camera: Camera, known: SensorLogs
) -> list[Any]:
    """Return the label messages of cf1 with its camera."""
    look = CameraOptions(0.01, cameras={"cf1": camera})
    return list(build_label_messages(read_flight(path), known, "cf1", found, look))


def test_position_message_has_time_frame_covariance_and_status(tmp_path: Path) -> None:
    found = build_positions([1.0, 2.0], STATUS_UNCONVERGED)
    series = build_position_series("cf1", "cf2", found)
    assert series.topic == "/cf1/peer/cf2/position"
    with RecordingWriter(tmp_path / "a.mcap", Provenance("test")) as sink:
        sink.write_series(series)
    first, second = read(tmp_path / "a.mcap")
    assert (first.time_ns, first.topic) == (START_NS + SECOND_NS, "/cf1/peer/cf2/position")
    said = second.message
    assert (said.x, said.y, said.z) == pytest.approx((2.0, 0.2, 0.1))
    assert list(said.covariance) == pytest.approx([0.04, 0, 0, 0, 0.03, 0, 0, 0, 0.02])
    assert (said.frame_id, said.status) == ("cf1/horizontal", STATUS_UNCONVERGED)


@pytest.mark.parametrize("delay_s", [0.0, 0.5])
def test_label_has_the_image_time_and_its_exposure_time(tmp_path: Path, delay_s: float) -> None:
    logged_s = [2.0, 4.0, 6.0]
    taken_s = [moment - delay_s for moment in logged_s]
    found = build_positions([0.25, *taken_s, 9.0])  # the first and last belong to no image
    path = write_flight(tmp_path / "a.mcap", logged_s)
    made = build_labels(path, {"cf2": found}, replace(AIDECK, delay_s=delay_s), build_logs())
    assert [m.time_ns for m in made] == [START_NS + round(t * SECOND_NS) for t in logged_s]
    for entry, taken, xyz_m in zip(made, taken_s, found.xyz_m[1:4], strict=True):
        tilt = np.array([ROLL_RATE * taken]), np.array([PITCH_RATE * taken])
        (uv,), (depth_m,), _ = pixels_from_horizontal(xyz_m[None], *tilt, AIDECK)
        (label,) = entry.fields["peers"]
        assert (label.u_px, label.v_px) == pytest.approx(tuple(uv))
        assert label.depth_m == pytest.approx(depth_m)
        assert entry.fields["sources"] == ["estimate"]


def test_labels_of_other_sources_stay_and_old_estimates_are_replaced(tmp_path: Path) -> None:
    kinds = [{"peer": "cf2", "source": source, "depth_m": 1.0} for source in ("truth", "estimate")]
    before = message_class("PeerLabels")(peers=kinds, sources=["truth", "estimate"])
    image_ns, other_ns = START_NS + 2 * SECOND_NS, START_NS + 3 * SECOND_NS
    path = write_flight(tmp_path / "a.mcap", [2.0, 3.0], [(image_ns, before), (other_ns, before)])
    first, second = build_labels(path, {"cf2": build_positions([2.0])}, AIDECK, build_logs())
    assert [p.source for p in first.fields["peers"]] == ["truth", "estimate"]
    assert list(first.fields["sources"]) == ["estimate", "truth"]
    assert [p.source for p in second.fields["peers"]] == ["truth"]
    assert list(second.fields["sources"]) == ["truth"]


def test_robot_without_position_is_unconverged_in_every_labelled_image(tmp_path: Path) -> None:
    path = write_flight(tmp_path / "a.mcap", [2.0, 3.0])
    (only,) = build_labels(
        path, {"cf2": build_positions([2.0])}, AIDECK, build_logs(["cf1", "cf2", "cf3", "cf4"])
    )
    known, *unknown = only.fields["peers"]
    assert (known.peer, known.status) == ("cf2", STATUS_OK)
    assert [(p.peer, p.status) for p in unknown] == [(f"cf{k}", STATUS_UNCONVERGED) for k in (3, 4)]
    assert {(p.u_px, p.v_px, p.depth_m) for p in unknown} == {(160.0, 112.0, MIN_DEPTH_M)}


def test_without_any_calibration_there_are_no_labels(tmp_path: Path) -> None:
    path = write_flight(tmp_path / "a.mcap", [2.0])
    made = build_label_messages(
        read_flight(path), build_logs(), "cf1", {"cf2": build_positions([2.0])}, CameraOptions(0.01)
    )
    assert list(made) == []


def test_causes_and_innovations_name_their_robots() -> None:
    report = PairReport(
        "cf2", "cf1", 1, 1.0, 0.0, 0.0, 0.1, None, None,
        [PairCause("flow does not fit", 1.0, 3.0, 5.0, "cf1")],
    )  # fmt: skip
    shown = Innovation("flow", np.array([1.0, 3.0]), np.array([0.5, 9.0]), 1)
    ranged = replace(shown, signal="range", robot=None)
    both = {("cf2", "cf1"): (shown, ranged)}
    ((made,),) = build_cause_messages(START_NS, [report], both)
    assert made.topic == topics.CAUSES("cf2", "cf1")
    assert [(one.signal, one.robot) for one in made.fields["innovations"]] == [
        ("flow", "cf1"), ("range", ""),
    ]  # fmt: skip
    assert list(made.fields["innovations"][0].at_s) == [1.0, 3.0]
    assert made.fields["causes"][0].name == "flow does not fit"
    assert "No known error explains it" in str(report.causes[0])
