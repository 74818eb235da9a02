"""Label one flight: estimate its pairs, project the positions, and write them with the labels."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dmrl import topics
from dmrl.errors import MissingTopic, RecordingError, SettingError
from dmrl.estimation.model.pair import BearingMeasurements
from dmrl.estimation.solver.estimate import Innovation
from dmrl.labelling.camera_bearings import add_bearings, detections_to_bearings
from dmrl.labelling.flight_log import (
    OBSERVER_TOPICS,
    SENSOR_TOPICS,
    TRUTH_TOPICS,
    FlightLog,
    RobotPair,
    read_flight,
)
from dmrl.labelling.image_labels import CameraOptions
from dmrl.labelling.label_messages import (
    build_cause_messages,
    build_label_messages,
    build_position_series,
    count_estimated,
    select_estimated,
)
from dmrl.labelling.observer_log import read_observer_log
from dmrl.labelling.pair_estimation import PairSolver, Spread, estimate_all, orient_pair
from dmrl.labelling.pair_report import PairReport, explain_causes, report_pair
from dmrl.labelling.peer_positions import PeerPositions, sample_positions
from dmrl.labelling.recorded_camera import require_camera
from dmrl.labelling.sensor_file import SensorConstants, read_sensors
from dmrl.labelling.sensor_logs import SensorLogs, build_sensor_logs
from dmrl.recording import Provenance, rewrite
from dmrl.samples.sample import Sample


@dataclass(frozen=True, slots=True)
class LabelledFlight:
    """Positions of all peers and labels of all images.

    Parameters
    ----------
    positions
        By observer and peer.
    labels
        PeerLabels messages by robot that has images.
    reports
        One per ordered pair.
    innovations
        Misfit of the signals of each ordered pair.
    warnings
        One line for each thing that was left out or looks wrong.
    """

    positions: dict[RobotPair, PeerPositions]
    labels: dict[str, list[Sample]]
    reports: list[PairReport]
    innovations: Mapping[RobotPair, Sequence[Innovation]]
    warnings: list[str]

    @property
    def count(self) -> int:
        """Return the number of estimated labels."""
        return count_estimated(self.labels.values())


def read_label_inputs(path: Path, cameras: Collection[str], *, detections: bool) -> FlightLog:
    """Read the topics that labels are made from.

    Parameters
    ----------
    path
        The recording.
    cameras
        Robots whose camera is given by a file.
    detections
        Whether the detections are read as well.
    """
    wanted = {*SENSOR_TOPICS, *TRUTH_TOPICS, topics.LABELS, topics.CALIBRATION}
    wanted |= {*OBSERVER_TOPICS} if detections else set()
    return read_flight(path, *sorted(wanted), topics.CAMERA_IMAGE, sizes_of=cameras)


def require_pairs(
    flight: FlightLog,
    range_offset_m: float,
    sensors: Path | None,
    cameras: Collection[str],
    *,
    detections: bool = False,
) -> SensorLogs:
    """Return the sensor logs; raise unless there is a pair, and a robot for every file.

    Parameters
    ----------
    flight
        The recording's logs.
    range_offset_m
        Subtracted from every range.
    sensors
        TOML file of sensor constants.
    cameras
        Robots whose camera is given by a file.
    detections
        Whether detections replace missing ranges.

    Raises
    ------
    RecordingError
        If no pair can be estimated.
    SettingError
        If the constants, or a camera, are of other robots.
    """
    known = read_sensors(sensors) if sensors else SensorConstants()
    logs = build_sensor_logs(flight, range_offset_m, known, detections=detections)
    if sensors and not set(logs.robots) & set(known.names):
        raise SettingError(
            f"{sensors} is of {', '.join(known.names) or 'nobody'}, and {flight.path} has "
            f"{', '.join(logs.robots) or 'nobody'}. Calibrate with flights of these robots"
        )
    if not logs.pairs:
        whole = flight.attitude.keys() & flight.velocity.keys() & flight.height.keys()
        absent = [] if whole else ["no robot has attitude, velocity and height"]
        why = "; ".join(logs.warnings or [*absent, "there are no ranges on /ROBOT/range/PEER"])
        remedy = "Try: dmrl align" if why.endswith("?") else "Try: dmrl info"
        why += "" if why.endswith("?") else "."
        raise RecordingError(f"{flight.path}: no pair can be estimated: {why} {remedy}")
    if unknown := set(cameras) - set(logs.robots):
        raise SettingError(f"--camera.{min(unknown)}: {flight.path} has {', '.join(logs.robots)}")
    return logs


def read_bearings(
    flight: FlightLog, logs: SensorLogs, options: CameraOptions, method: str, pixel_std_px: float
) -> dict[str, BearingMeasurements]:
    """Return the bearings of the detections of all robots in pairs.

    Parameters
    ----------
    flight, logs
        With detections.
    options
        The cameras, and the error of their attitude.
    method
        Must be "batch" or "swarm".
    pixel_std_px
        Error of a detection in u and in v.

    Raises
    ------
    SettingError
        If the method takes no detections.
    MissingTopic
        If there are no detections, or a camera is unknown.
    """
    if method not in ("batch", "swarm"):
        raise SettingError(f"--detections goes with --method batch or swarm, not {method}")
    if not flight.detections:
        raise MissingTopic(topics.DETECTIONS("*"), flight.topics, flight.path)
    out = {}
    for robot in (robot for robot in sorted(flight.detections) if robot in logs.robots):
        camera = require_camera(flight, robot, options.cameras.get(robot))
        if not options.distorted:
            camera = replace(camera, distortion=())
        observer = read_observer_log(flight, robot, camera, None)
        stds = pixel_std_px, options.attitude_std_rad
        out[robot] = detections_to_bearings(observer, logs.start_ns, *stds)
    return out


def label_flight(
    flight: FlightLog,
    logs: SensorLogs,
    bearings: Mapping[str, BearingMeasurements],
    options: CameraOptions,
    solver: PairSolver,
    workers: int,
    spread: Spread,
) -> LabelledFlight:
    """Estimate the positions of all peers, and label the images with them.

    Parameters
    ----------
    flight, logs
        The recording's logs, with a pair or more.
    bearings
        Detections to solve with, by robot.
    options
        Options of the projection.
    solver, workers, spread
        See `pair_estimation.estimate_all`.
    """
    estimates = estimate_all(add_bearings(logs.pairs, bearings), solver, workers, spread)
    none = np.zeros(0, np.int64)
    images = {robot: flight.images_ns.get(robot, none) for robot in logs.robots}
    exposures = {robot: options.exposures_ns(robot, times) for robot, times in images.items()}
    positions = {}
    for (robot, peer), estimate in estimates.items():
        pair = orient_pair(logs.pairs, (robot, peer))
        positions[robot, peer] = sample_positions(logs.start_ns, pair, estimate, exposures[robot])
    filming = [robot for robot, times in images.items() if len(times)]
    labels = {}
    for robot in filming:
        mine = {peer: found for (one, peer), found in positions.items() if one == robot}
        labels[robot] = list(build_label_messages(flight, logs, robot, mine, options))
    reports = [report_pair(flight, pair, positions[pair], estimates[pair]) for pair in positions]
    warnings = [*logs.warnings, *_warn_without_camera(flight, filming, options.cameras)]
    warnings += explain_causes(reports, solver.gate)
    innovations = {pair: estimate.innovations for pair, estimate in estimates.items()}
    return LabelledFlight(positions, labels, reports, innovations, warnings)


def _warn_without_camera(
    flight: FlightLog, filming: Iterable[str], cameras: Collection[str]
) -> list[str]:
    """Return a warning for each robot whose images get no labels, as its camera is unknown."""
    return [
        f"{robot}: no {topics.CALIBRATION(robot)}; its images get no labels. Give one: "
        f"--camera.{robot} FILE"
        for robot in filming
        if robot not in cameras and topics.CALIBRATION(robot) not in flight.topics
    ]


def write_labelled(
    flight: FlightLog, out: Path, origin: Provenance, labelled: LabelledFlight, *, copy: bool
) -> None:
    """Write positions and labels, in a copy of the recording or alone.

    Parameters
    ----------
    flight
        The recording.
    out
        Recording to write.
    origin
        Its provenance.
    labelled
        Positions and labels.
    copy
        Keep all other messages; else labels of other sources are left out as well.
    """
    series = [build_position_series(*pair, found) for pair, found in labelled.positions.items()]
    causes = build_cause_messages(flight.start_ns, labelled.reports, labelled.innovations)
    if copy:
        replaced = [topics.LABELS(robot) for robot in labelled.labels]
        replaced += [
            topic
            for topic in flight.topics
            for pattern in (topics.POSITION, topics.CAUSES)
            if topics.parse_topic(pattern, topic)
        ]
        fresh = list(labelled.labels.values())
    else:
        replaced = list(flight.topics)
        fresh = [list(select_estimated(made)) for made in labelled.labels.values()]
    rewrite(flight.path, out, origin, without=replaced, fresh=[*fresh, *causes], series=series)
