"""`dmrl track`: tracks and their evaluation."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl import topics
from dmrl.errors import DmrlError, MissingTopic, OutputError, RecordingError, SettingError
from dmrl.geometry.camera_file import format_camera
from dmrl.labelling.flight_log import read_flight
from dmrl.labelling.recorded_camera import find_recorded_camera
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, read, read_raw, read_summary, trim
from dmrl.recording.provenance_inputs import hash_file
from dmrl.stages import evaluate, fly, track
from dmrl.stages.track import Settings

from .detector import with_detections

pytestmark = pytest.mark.heavy


@pytest.fixture(scope="module")
def detected_flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a flight of three robots over 30 s with simulated detections of cf1."""
    folder = tmp_path_factory.mktemp("track")
    flight = folder / "flight.mcap"
    fly.run(flight, fly.Settings(3, 30.0, noise="calibrated", seed=11))
    return with_detections(flight, folder / "detected.mcap")


@pytest.fixture(scope="module")
def tracked_flight(detected_flight: Path) -> Path:
    """Return the flight with tracks."""
    out = detected_flight.with_name("tracked.mcap")
    track.run(detected_flight, out, Settings())
    return out


@pytest.fixture(scope="module")
def evaluation(tracked_flight: Path) -> dict[str, Any]:
    """Return the evaluation of the tracks of cf1, the only observer."""
    made = evaluate.run([tracked_flight], None, evaluate.Settings(settle_s=3.0))
    assert isinstance(made, dict)
    (one,) = made["robots"]
    return one


def test_every_image_gets_its_tracks_in_the_observers_frame(tracked_flight: Path) -> None:
    made = list(read(tracked_flight, topics.TRACKS("cf1")))
    images = [one.time_ns for one in read(tracked_flight, topics.DETECTIONS("cf1"))]
    assert [one.time_ns for one in made] == images
    assert {one.message.frame_id for one in made} == {"cf1/horizontal"}
    entries = [entry for one in made for entry in one.message.tracks]
    covariance = np.array([entry.covariance for entry in entries]).reshape(-1, 3, 3)
    assert (np.linalg.eigvalsh(covariance) > 0).all()
    assert {entry.peer for entry in entries} <= {"", "cf2", "cf3"}


def test_tracks_reduce_the_error_with_consistent_covariance(evaluation: dict[str, Any]) -> None:
    assert evaluation["robot"] == "cf1"
    assert evaluation["reduction"] > 0.3
    assert evaluation["coverage_95"] > 0.85
    assert evaluation["named_right"] > 0.9
    assert evaluation["false_tracks_per_min"] <= 4


def test_tracks_are_judged_with_the_camera_that_made_them(
    detected_flight: Path, evaluation: dict[str, Any], tmp_path: Path
) -> None:
    late, out, path = (tmp_path / name for name in ("late.mcap", "out.mcap", "camera.toml"))
    with RecordingWriter(late, Provenance("test")) as sink:
        for one in read(detected_flight):
            seen = one.topic in (topics.DETECTIONS("cf1"), topics.CAMERA_IMAGE("cf1"))
            sink.write(one.time_ns + seen * 200_000_000, one.topic, one.message)
    camera = find_recorded_camera(read_flight(detected_flight), "cf1")
    assert camera is not None
    path.write_text(format_camera(replace(camera, delay_s=0.2)))
    track.run(late, out, Settings(camera={"cf1": path}))
    now = evaluate.run([out], None, evaluate.Settings(settle_s=3.0))
    assert isinstance(now, dict)
    for figure in ("rmse_m", "single_rmse_m", "coverage_95"):
        assert now["robots"][0][figure] == pytest.approx(evaluation[figure], rel=0.05)


def test_other_messages_stay_and_old_tracks_go(
    detected_flight: Path, tracked_flight: Path, tmp_path: Path
) -> None:
    again = tmp_path / "again.mcap"
    track.run(tracked_flight, again, Settings())
    kept = [raw.data for raw in read_raw(detected_flight)]
    others = [t for t in read_summary(again).topics if t != topics.TRACKS("cf1")]
    assert [raw.data for raw in read_raw(again, *others)] == kept
    assert read_summary(again).topics[topics.TRACKS("cf1")].count == len(
        list(read(detected_flight, topics.DETECTIONS("cf1")))
    )


def test_recorded_detector_rates_are_used_by_the_tracker(
    detected_flight: Path, tmp_path: Path
) -> None:
    """If the rates state that nearly all detections are false, no track is started."""
    told, out = tmp_path / "told.mcap", tmp_path / "out.mcap"
    rates = {
        "min_confidence": 0.2,
        "distance_m": [0.5, 1.5],
        "detected": [0.9, 0.5],
        "false_per_image": 40.0,
        "slope": 1.0,
        "offset": -6.0,
    }
    with RecordingWriter(told, Provenance("test")) as sink:
        for one in read(detected_flight):
            if one.topic == topics.DETECTIONS("cf1"):
                one.message.rates.MergeFrom(message_class("DetectorRates")(**rates))
            sink.write(one.time_ns, one.topic, one.message)
    found = read_flight(told, topics.DETECTIONS).detections["cf1"].rates
    assert found == {k: tuple(v) if isinstance(v, list) else v for k, v in rates.items()}
    assert read_flight(detected_flight, topics.DETECTIONS).detections["cf1"].rates is None
    assert track.run(told, out, Settings())[0].tracks == 0


def test_the_same_input_gives_the_same_bytes(
    detected_flight: Path, tracked_flight: Path, tmp_path: Path
) -> None:
    out = tmp_path / tracked_flight.name
    track.run(detected_flight, out, Settings())
    assert hash_file(out) == hash_file(tracked_flight)


@pytest.mark.parametrize(
    ("topic", "words"),
    [
        ("/cf1/detections", "Try: dmrl predict MODEL"),
        ("/cf1/attitude", "Merge the log of the robot with it: dmrl merge"),
        ("/cf1/camera/calibration", "Give the camera to dmrl convert: --camera"),
    ],
)
def test_missing_topic_is_reported(
    detected_flight: Path, tmp_path: Path, topic: str, words: str
) -> None:
    short = tmp_path / "short.mcap"
    others = [t for t in read_summary(detected_flight).topics if t != topic]
    trim(detected_flight, short, topics=others)
    out = tmp_path / "out.mcap"
    with pytest.raises(MissingTopic, match=r"detections|attitude|calibration") as caught:
        track.run(short, out, Settings())
    assert words in str(caught.value)
    assert not out.exists()


def test_tracking_without_velocity_and_height_warns(
    detected_flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short, out = tmp_path / "short.mcap", tmp_path / "out.mcap"
    gone = ("/cf1/velocity", "/cf1/height")
    trim(
        detected_flight,
        short,
        topics=[t for t in read_summary(detected_flight).topics if t not in gone],
    )
    track.run(short, out, Settings())
    output = capsys.readouterr().err
    assert "taken to stand still" in output
    assert "taken to keep its height" in output


def test_an_existing_output_is_refused(detected_flight: Path, tracked_flight: Path) -> None:
    with pytest.raises(OutputError):
        track.run(detected_flight, tracked_flight, Settings())


def test_a_camera_of_a_robot_that_is_not_there_is_named(
    detected_flight: Path, tmp_path: Path
) -> None:
    camera = tmp_path / "camera.toml"
    with pytest.raises(SettingError, match=r"camera\.cf9"):
        track.run(detected_flight, tmp_path / "out.mcap", Settings(camera={"cf9": camera}))


def test_tracks_without_truth_cannot_be_judged(tracked_flight: Path, tmp_path: Path) -> None:
    short = tmp_path / "short.mcap"
    kept = [
        t for t in read_summary(tracked_flight).topics if not topics.parse_topic(topics.TRUTH, t)
    ]
    trim(tracked_flight, short, topics=kept)
    with pytest.raises(RecordingError, match="no true position"):
        evaluate.run([short], None, evaluate.Settings(what="tracks"))


def test_the_plots_show_the_errors_of_both(tracked_flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "plots"
    evaluate.run([tracked_flight], out, evaluate.Settings(what="tracks"))
    assert {path.name for path in out.iterdir()} == {
        "tracks.json",
        "track-error-cf1.png",
        "track-error-cf1.svg",
    }


def test_a_file_that_is_no_recording_is_one_error(tmp_path: Path) -> None:
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"no")
    with pytest.raises(DmrlError):
        track.run(bad, tmp_path / "out.mcap", Settings())
