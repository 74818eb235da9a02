"""True positions of peers from motion capture of both robots."""

from pathlib import Path

import numpy as np

from dmrl import topics
from dmrl.labelling.flight_log import FlightLog, read_flight
from dmrl.labelling.ground_truth import find_true_path, list_true_pairs
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter

PLACES = {"cf1": (1.0, 2.0, 0.5), "cf2": (1.0, 5.0, 0.9)}


def write_captured_flight(path: Path, lost: tuple[int, int] = (0, 0)) -> FlightLog:
    """Write a recording with cf2 3 m in front of cf1; poses of cf2 are missing in a span."""
    turn = {"z": np.sin(np.pi / 4), "w": np.cos(np.pi / 4)}
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(100):
            for robot, place in PLACES.items():
                if robot == "cf2" and lost[0] <= k < lost[1]:
                    continue
                pose = {"position": dict(zip("xyz", place, strict=True)), "orientation": turn}
                made = message_class("PoseInFrame")(frame_id="world", pose=pose)
                sink.write(k * 20_000_000, topics.TRUE_POSE(robot), made)
    return read_flight(path)


def test_true_positions_of_a_peer_are_in_the_frame_of_the_robot(tmp_path: Path) -> None:
    held = write_captured_flight(tmp_path / "a.mcap")
    assert list_true_pairs(held.topics) == [("cf1", "cf2"), ("cf2", "cf1")]
    time_ns, xyz = find_true_path(held, "cf1", "cf2")
    assert len(time_ns) == 100
    np.testing.assert_allclose(xyz, [[3.0, 0.0, 0.4]] * 100, atol=1e-9)
    back = find_true_path(held, "cf2", "cf1")[1]
    np.testing.assert_allclose(back, [[-3.0, 0.0, -0.4]] * 100, atol=1e-9)


def test_true_path_omits_lost_markers(tmp_path: Path) -> None:
    held = write_captured_flight(tmp_path / "a.mcap", lost=(20, 60))
    time_ns, _ = find_true_path(held, "cf1", "cf2")
    gone = (time_ns > 19 * 20_000_000) & (time_ns < 60 * 20_000_000)
    assert not gone.any() and len(time_ns) == 60
