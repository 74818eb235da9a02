"""Tracks of the peers that a robot's camera detects, as messages."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dmrl import topics
from dmrl.estimation.tracking.detector_rates import DetectorRates
from dmrl.estimation.tracking.identity import TrackIdentity
from dmrl.estimation.tracking.tracker import Track, Tracker
from dmrl.estimation.tracking.tuning import Tuning
from dmrl.geometry.frames import Camera
from dmrl.labelling.flight_log import FlightLog
from dmrl.labelling.observer_log import read_observer_log
from dmrl.labelling.recorded_camera import read_robot_camera, require_camera
from dmrl.samples.sample import Sample
from dmrl.terminal.progress import say, track


@dataclass(frozen=True, slots=True)
class RobotReport:
    """Numbers of images and tracks of one robot; those named carry the name of a peer."""

    robot: str
    images: int
    tracks: int
    named: int
    per_image: float


def choose_camera(
    flight: FlightLog, robot: str, given: Path | None, *, undistorted: bool = False
) -> Camera:
    """Return the camera of a robot: a file's, or else the recording's.

    Raises
    ------
    MissingTopic
        If there is neither.
    """
    named = read_robot_camera(flight, robot, given) if given else None
    camera = require_camera(flight, robot, named)
    return replace(camera, distortion=()) if undistorted else camera


def track_peers(
    flight: FlightLog, robot: str, camera: Camera, threshold: float | None, tuning: Tuning
) -> tuple[list[Sample], RobotReport]:
    """Return the Tracks messages of one robot, one per image, and their numbers.

    Parameters
    ----------
    flight
        A recording with detections and attitude.
    robot
        Robot that observes the peers.
    camera
        Its camera.
    threshold
        Least confidence of a detection. None: that of the detector's rates.
    tuning
        Errors that the tracker assumes.
    """
    sight = read_observer_log(flight, robot, camera, threshold or 0.0)
    rates = DetectorRates(**(flight.detections[robot].rates or {}))
    for warning in sight.warnings:
        say(f"{flight.path}: {warning}")
    tracker, identity = Tracker(sight.camera, tuning, rates), TrackIdentity()
    made: list[Sample] = []
    seen: dict[int, str] = {}
    entries = 0
    for k in track(range(len(sight.time_ns)), f"Following from {robot}"):
        tracks = tracker.step(sight.motion(k), sight.view(k))
        names = identity.assign(tracks, sight.ranges(k), sight.motion(k).dt_s)
        seen |= {t.number: names.get(t.number) or seen.get(t.number, "") for t in tracks}
        entries += len(tracks)
        made.append(build_tracks(robot, int(sight.log_time_ns[k]), tracks, names, None))
    images = len(sight.time_ns)
    named = sum(bool(name) for name in seen.values())
    return made, RobotReport(robot, images, len(seen), named, round(entries / max(images, 1), 3))


def build_tracks(
    robot: str, time_ns: int, tracks: list[Track], names: dict[int, str], publish_ns: int | None
) -> Sample:
    """Build the Tracks of one image; ``names`` are those of the peers, by number of the track."""
    entries: list[dict[str, Any]] = []
    for one in tracks:
        numbers = [*one.position_m.tolist(), *one.velocity_mps.tolist()]
        keys = ("x", "y", "z", "vx_mps", "vy_mps", "vz_mps")
        entries.append(
            {
                "id": one.number,
                "peer": names.get(one.number, ""),
                **dict(zip(keys, numbers, strict=True)),
                "covariance": np.ravel(one.covariance).tolist(),
                "existence": one.existence,
                "age_s": one.age_s,
                "unseen_s": one.unseen_s,
            }
        )
    fields = {"frame_id": f"{robot}/horizontal", "tracks": entries}
    return Sample(time_ns, topics.TRACKS(robot), "Tracks", fields, publish_ns)
