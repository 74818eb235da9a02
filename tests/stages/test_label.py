"""`dmrl label`: positions, labels and reproducibility."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl import topics
from dmrl.errors import MissingTopic, OutputError, SettingError
from dmrl.flight import NOISE
from dmrl.geometry.frames import AIDECK_PINHOLE, pixels_from_horizontal
from dmrl.labelling import pair_estimation
from dmrl.messages import STATUS_AMBIGUOUS, STATUS_OK, STATUS_UNCONVERGED, message_class
from dmrl.recording import (
    Provenance,
    RecordingWriter,
    check,
    read,
    read_raw,
    read_summary,
    read_table,
)
from dmrl.stages import convert, fly, label
from dmrl.stages.label import Settings

SECOND_NS = 1_000_000_000
LENIENT = Settings(gate_m=0.5)  # a flight of half a minute is too short for the usual gate


@pytest.fixture(scope="module")
def labelled_flight(flight: Path) -> Path:
    """Return the labelled flight."""
    out = flight.with_name("labelled.mcap")
    label.run(flight, out, LENIENT)
    return out


@pytest.mark.heavy
def test_everything_else_is_copied_bit_for_bit(flight: Path, labelled_flight: Path) -> None:
    topics = [t for t in read_summary(flight).topics if t != "/cf1/labels"]
    assert list(read_raw(labelled_flight, *topics)) == list(read_raw(flight, *topics))
    assert not [f for f in check(labelled_flight) if f.level == "error"]


@pytest.mark.heavy
def test_positions_come_at_20_hz_and_at_every_image(labelled_flight: Path) -> None:
    there = set(read_table(labelled_flight, "/cf1/peer/cf2/position")["log_time"].to_pylist())
    images = read_table(labelled_flight, "/cf1/camera/image", fields=())["log_time"].to_pylist()
    assert set(images) <= there
    back = read_table(labelled_flight, "/cf2/peer/cf1/position")["log_time"].to_numpy()
    assert (np.diff(back) == SECOND_NS // 20).all()
    first = next(read(labelled_flight, "/cf1/peer/cf2/position")).message
    assert first.frame_id == "cf1/horizontal"
    assert len(first.covariance) == 9


@pytest.mark.heavy
def test_positions_are_near_the_truth(labelled_flight: Path) -> None:
    for one, other in (("cf1", "cf2"), ("cf2", "cf1")):
        found = read_table(labelled_flight, f"/{one}/peer/{other}/position")
        truth = read_table(labelled_flight, f"/{one}/peer/{other}/truth")
        time_ns = truth["log_time"].to_numpy()
        errors = [
            found[axis].to_numpy()
            - np.interp(found["log_time"].to_numpy(), time_ns, truth[axis].to_numpy())
            for axis in ("x", "y", "z")
        ]
        assert np.median(np.hypot(*errors[:2])) < 0.2
        assert np.abs(errors[2]).mean() < 0.1


def test_labels_stand_beside_those_of_other_sources(flight: Path, labelled_flight: Path) -> None:
    before = {s.time_ns: s.message for s in read(flight, "/cf1/labels")}
    after = {s.time_ns: s.message for s in read(labelled_flight, "/cf1/labels")}
    assert after.keys() == before.keys()
    for time_ns, peers in after.items():
        assert [p for p in peers.peers if p.source == "truth"] == list(before[time_ns].peers)
    ours = [p for m in after.values() for p in m.peers if p.source == "estimate"]
    assert len(ours) > len(after) / 2
    assert all(p.peer == "cf2" and p.sigma_u_px > 0 and p.sigma_depth_m > 0 for p in ours)


def test_labels_are_projections_of_the_positions(labelled_flight: Path) -> None:
    attitude = read_table(labelled_flight, "/cf1/attitude")
    positions = {s.time_ns: s.message for s in read(labelled_flight, "/cf1/peer/cf2/position")}
    seen = 0
    for stamped in read(labelled_flight, "/cf1/labels"):
        at = positions[stamped.time_ns]
        roll, pitch = (
            np.interp([stamped.time_ns], attitude["log_time"].to_numpy(), attitude[n].to_numpy())
            for n in ("roll_rad", "pitch_rad")
        )
        uv, depth_m, _ = pixels_from_horizontal(
            np.array([[at.x, at.y, at.z]]), roll, pitch, AIDECK_PINHOLE
        )
        for peer in stamped.message.peers:
            if peer.source == "estimate" and peer.status == STATUS_OK:
                assert (peer.u_px, peer.v_px) == pytest.approx(tuple(uv[0]))
                assert peer.depth_m == pytest.approx(depth_m[0])
                seen += 1
    assert seen > 5


def measure_error_px(recording: Path) -> float:
    """Return the root mean square error of the labels that are OK, pixels."""
    off = []
    for stamped in read(recording, "/cf1/labels"):
        by_source = {peer.source: peer for peer in stamped.message.peers}
        one, true = by_source.get("estimate"), by_source.get("truth")
        if one and true and one.status == STATUS_OK:
            off.append((one.u_px - true.u_px, one.v_px - true.v_px))
    return float(np.sqrt(np.mean(np.square(off).sum(axis=1))))


@pytest.mark.heavy
def test_detections_improve_labels(flight: Path, labelled_flight: Path, tmp_path: Path) -> None:
    seen, rng = tmp_path / "seen.mcap", np.random.default_rng(0)
    with RecordingWriter(seen, Provenance("test")) as sink:
        for stamped in read(flight):
            sink.write(stamped.time_ns, stamped.topic, stamped.message)
            if stamped.topic != topics.LABELS("cf1"):
                continue
            found = [
                {
                    "u_px": peer.u_px + 4 * rng.standard_normal(),
                    "v_px": peer.v_px + 4 * rng.standard_normal(),
                    "depth_m": peer.depth_m * np.exp(0.2 * rng.standard_normal()),
                    "confidence": 0.9,
                }
                for peer in stamped.message.peers
            ]
            made = message_class("Detections")(detections=found, threshold=0.33)
            sink.write(stamped.time_ns, topics.DETECTIONS("cf1"), made)
    label.run(seen, tmp_path / "refined.mcap", replace(LENIENT, detections=True))
    assert measure_error_px(tmp_path / "refined.mcap") < 0.6 * measure_error_px(labelled_flight)
    with pytest.raises(
        SettingError, match="--detections goes with --method batch or swarm, not ekf"
    ):
        label.run(seen, tmp_path / "none.mcap", Settings(method="ekf", detections=True))
    with pytest.raises(MissingTopic, match="no topic /\\*/detections"):
        label.run(flight, tmp_path / "none.mcap", replace(LENIENT, detections=True))
    assert not (tmp_path / "none.mcap").exists()


@pytest.mark.heavy
def test_labelling_again_changes_no_position(labelled_flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "again.mcap"
    label.run(labelled_flight, out, LENIENT)
    assert read_summary(out).topics == read_summary(labelled_flight).topics
    assert [s.message for s in read(out, "/*/peer/*/position", "/cf1/labels")] == [
        s.message for s in read(labelled_flight, "/*/peer/*/position", "/cf1/labels")
    ]


@pytest.mark.heavy
def test_the_same_input_gives_the_same_bytes(
    flight: Path, labelled_flight: Path, tmp_path: Path
) -> None:
    label.run(flight, tmp_path / "labelled.mcap", LENIENT)
    assert (tmp_path / "labelled.mcap").read_bytes() == labelled_flight.read_bytes()


@pytest.mark.heavy
def test_the_report_knows_the_error_where_the_truth_is_recorded(
    flight: Path, tmp_path: Path
) -> None:
    result = label.run(flight, tmp_path / "labelled.mcap", Settings(method="ekf"))
    assert [(p.robot, p.peer) for p in result.pairs] == [("cf1", "cf2"), ("cf2", "cf1")]
    assert all(p.rmse_m is not None for p in result.pairs)
    # The filter is too uncertain to label half a minute by the usual gate, and warns of it.
    assert not [text for text in result.warnings if "nothing is kept" not in text]


def test_existing_output_is_not_overwritten(flight: Path) -> None:
    with pytest.raises(OutputError, match="exists"):
        label.run(flight, flight, Settings())


@pytest.mark.heavy
def test_robot_without_positions_is_unconverged_in_every_image(
    flight: Path, tmp_path: Path
) -> None:
    third, out = tmp_path / "third.mcap", tmp_path / "labelled.mcap"
    with RecordingWriter(third, Provenance("test")) as sink:
        for stamped in read(flight):
            sink.write(stamped.time_ns, stamped.topic, stamped.message)
            if stamped.topic == "/cf2/attitude":
                sink.write(stamped.time_ns, "/cf3/attitude", stamped.message)
    said = label.run(third, out, LENIENT).warnings
    assert "cf3: it has a log but no position, so no image counts as one without it" in said
    looked = [m for s in read(out, "/cf1/labels") if "estimate" in (m := s.message).sources]
    assert len(looked) > 40
    for message_ in looked:
        (entry,) = [p for p in message_.peers if (p.peer, p.source) == ("cf3", "estimate")]
        assert (entry.status, entry.sigma_u_px) == (STATUS_UNCONVERGED, 320)


def test_labels_of_empty_images_name_their_source(flight: Path, labelled_flight: Path) -> None:
    assert {tuple(s.message.sources) for s in read(flight, "/cf1/labels")} == {("truth",)}
    looked = [set(s.message.sources) for s in read(labelled_flight, "/cf1/labels")]
    assert all("truth" in sources for sources in looked)
    assert sum("estimate" in sources for sources in looked) > 40


def test_the_noise_of_heights_is_smoothed_away(labelled_flight: Path) -> None:
    """The remaining error is the bias of the height sensors, which is constant during a flight."""
    found = read_table(labelled_flight, "/cf1/peer/cf2/position")
    truth = read_table(labelled_flight, "/cf1/peer/cf2/truth")
    time_ns, truth_ns = found["log_time"].to_numpy(), truth["log_time"].to_numpy()
    off_m = found["z"].to_numpy() - np.interp(time_ns, truth_ns, truth["z"].to_numpy())
    assert off_m.std() < 2**0.5 * NOISE["calibrated"].height_white_m / 3


@pytest.mark.heavy
def test_label_of_a_peer_without_bearing_is_ambiguous(tmp_path: Path) -> None:
    flown = tmp_path / "still.mcap"
    fly.run(
        flown,
        fly.Settings(
            2,
            20.0,
            "observer_static",
            "realistic",
            seed=1000,
            camera=True,
            cameras_max=1,
            camera_rate_hz=1.0,
        ),
    )
    out = tmp_path / "out.mcap"
    said = label.run(flown, out, Settings()).warnings
    assert any("cf1-cf2: cf1's robot hardly moves" in line for line in said)
    for stamped in read(out, "/cf1/labels"):
        (ours,) = [p for p in stamped.message.peers if p.source == "estimate"]
        assert ours.status == STATUS_AMBIGUOUS


@pytest.mark.heavy
def test_given_range_offset_reduces_the_estimated_one(flight: Path, tmp_path: Path) -> None:
    biases = []
    for offset_m in (0.0, 0.3):
        out = tmp_path / f"{offset_m}.mcap"
        found = label.run(flight, out, Settings(range_offset_m=offset_m)).pairs
        biases.append(found[0].range_bias_m)
    assert biases[0] - biases[1] > 0.15


@pytest.mark.slow
def test_real_ranges_label_moving_observers_only(data: Path, tmp_path: Path) -> None:
    source = data / "uwb-tiers" / "4robots_data_01.npz"
    convert.run(source, tmp_path / "ranges.mcap", convert.Settings())
    out = tmp_path / "out.mcap"
    reports = label.run(tmp_path / "ranges.mcap", out, Settings(range_offset_m=0.35)).pairs
    found = {(p.robot[-1], p.peer[-1]): p for p in reports}
    for pair in ("13", "14", "34", "43", "41"):
        error = found[pair[0], pair[1]].rmse_m
        assert error is not None
        assert error < 0.29
    for peer in "134":
        assert found["5", peer].ambiguous_share == 1.0
        assert found["5", peer].kept_share == 0.0


@pytest.mark.heavy
def test_pairs_in_other_processes_change_no_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight = tmp_path / "f.mcap"
    fly.run(flight, fly.Settings(robots=4, duration_s=8.0, noise="calibrated"))
    monkeypatch.setattr(pair_estimation, "MIN_PARALLEL_S", 0.0)
    for workers in (1, 2):
        out = tmp_path / f"{workers}.mcap"
        result = label.run(flight, out, label.Settings(), workers=workers)
        assert len(result.pairs) == 12
    assert (tmp_path / "1.mcap").read_bytes() == (tmp_path / "2.mcap").read_bytes()
