"""Positions and labels as messages."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from dmrl import topics
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.estimate import Innovation
from dmrl.geometry.frames import Camera
from dmrl.labelling.flight_log import FlightLog, RobotPair, Times
from dmrl.labelling.image_labels import (
    MIN_DEPTH_M,
    SOURCE,
    CameraOptions,
    label_anywhere,
    label_images,
)
from dmrl.labelling.pair_report import PairReport
from dmrl.labelling.peer_positions import PeerPositions
from dmrl.labelling.recorded_camera import find_recorded_camera
from dmrl.labelling.sensor_logs import SensorLogs
from dmrl.messages import message_class
from dmrl.recording import Stamped
from dmrl.recording.label_sources import get_message_sources
from dmrl.samples.sample import Columns, Sample, round_values


def build_position_series(observer: str, peer: str, found: PeerPositions) -> Columns:
    """Return the PeerPosition messages of one pair."""
    x, y, z = found.xyz_m.T
    fields = {
        "frame_id": f"{observer}/horizontal",
        "x": x,
        "y": y,
        "z": z,
        "covariance": found.covariance.reshape(-1, 9),
        "status": found.status,
    }
    return Columns(topics.POSITION(observer, peer), "PeerPosition", found.time_ns, fields)


def build_cause_messages(
    start_ns: int,
    reports: Iterable[PairReport],
    innovations: Mapping[RobotPair, Sequence[Innovation]],
) -> Iterator[list[Sample]]:
    """Yield the PeerCauses message of each ordered pair.

    Parameters
    ----------
    start_ns
        Log time from which the seconds of causes count.
    reports
        Reports of the pairs.
    innovations
        Misfit of the signals of each pair.
    """
    for report in reports:
        both = report.robot, report.peer
        causes = [
            message_class("Cause")(**{**asdict(cause), "robot": cause.robot or ""})
            for cause in report.causes
        ]
        shown = [
            message_class("Innovation")(
                signal=one.signal,
                robot="" if one.robot is None else both[one.robot],
                at_s=one.time_s.round(2).tolist(),
                size=one.size.tolist(),
            )
            for one in innovations.get(both, ())
        ]
        fields = {"causes": causes, "innovations": shown}
        yield [Sample(start_ns, topics.CAUSES(*both), "PeerCauses", fields)]


def build_label_messages(
    flight: FlightLog,
    logs: SensorLogs,
    robot: str,
    positions: Mapping[str, PeerPositions],
    options: CameraOptions,
) -> Iterator[Sample]:
    """Yield PeerLabels of every image that has a position or had labels, in time order.

    If any peer is located in an image, every other robot that has a log gets a label too, as one
    that may be anywhere. Without it the image would count as one without that robot.

    Parameters
    ----------
    flight
        With images, their labels and the calibration.
    logs
        With the attitude of the robot.
    robot
        It carries the camera.
    positions
        By peer.
    options
        Options of the projection.
    """
    kept, sources = _select_other_sources(flight.labels.get(robot, []))
    camera = options.cameras.get(robot) or find_recorded_camera(flight, robot)
    images_ns = flight.images_ns[robot]
    fresh = _label_peers(logs, robot, positions, options, camera, images_ns) if camera else {}
    for time_ns in sorted({*kept, *fresh}):
        peers = [*kept.get(time_ns, []), *fresh.get(time_ns, [])]
        names = sorted(sources[time_ns] | ({SOURCE} if time_ns in fresh else set()))
        fields = {"peers": peers, "sources": names}
        yield Sample(time_ns, topics.LABELS(robot), "PeerLabels", fields)


def select_estimated(made: Iterable[Sample]) -> Iterator[Sample]:
    """Yield PeerLabels without the labels of other sources."""
    for labels in made:
        if SOURCE in labels.fields["sources"]:
            peers = [peer for peer in labels.fields["peers"] if peer.source == SOURCE]
            yield replace(labels, fields={"peers": peers, "sources": [SOURCE]})


def count_estimated(made: Iterable[Iterable[Sample]]) -> int:
    """Return the number of estimated labels, without those of other sources."""
    peers = (peer for messages in made for m in messages for peer in m.fields["peers"])
    return sum(peer.source == SOURCE for peer in peers)


def _label_peers(
    logs: SensorLogs,
    robot: str,
    positions: Mapping[str, PeerPositions],
    options: CameraOptions,
    camera: Camera,
    images_ns: Times,
) -> dict[int, list[Any]]:
    """Return the PeerLabel messages of the images at which any peer has a position."""
    exposures_ns = options.exposures_ns(robot, images_ns)
    made: dict[int, list[Any]] = defaultdict(list)
    unknown: dict[int, set[str]] = defaultdict(lambda: {*logs.flying} - {robot})
    for peer, found in positions.items():
        at = np.isin(found.time_ns, exposures_ns)
        mine = PeerPositions(
            found.time_ns[at], found.xyz_m[at], found.covariance[at], found.status[at]
        )
        attitude = _interpolate_attitude(logs, robot, mine.time_ns)
        labels = label_images(peer, mine, attitude, camera, options)
        stamps = images_ns[np.searchsorted(exposures_ns, mine.time_ns)].tolist()
        for time_ns, label in zip(stamps, labels, strict=True):
            made[time_ns] += [label] if label else []
            unknown[time_ns] -= {peer}
    for time_ns, peers in unknown.items():
        made[time_ns] += [label_anywhere(peer, camera, MIN_DEPTH_M) for peer in sorted(peers)]
    return {
        t: [message_class("PeerLabel")(**round_values(label)) for label in labels]
        for t, labels in made.items()
    }


def _select_other_sources(
    before: Iterable[Stamped],
) -> tuple[dict[int, list[Any]], dict[int, set[str]]]:
    """Return labels and sources by time, without earlier estimates."""
    kept: dict[int, list[Any]] = defaultdict(list)
    sources: dict[int, set[str]] = defaultdict(set)
    for stamped in before:
        labels = stamped.message
        kept[stamped.time_ns] += [peer for peer in labels.peers if peer.source != SOURCE]
        sources[stamped.time_ns] |= get_message_sources(labels) - {SOURCE}
    return kept, sources


def _interpolate_attitude(logs: SensorLogs, robot: str, time_ns: Times) -> Array:
    """Return (N, 2) roll and pitch at log times, radians."""
    at_s, values = logs.robots[robot].attitude
    time_s = (time_ns - logs.start_ns) * 1e-9
    return np.column_stack([np.interp(time_s, at_s, column) for column in values[:, :2].T])
