"""Positions and labels as messages."""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl import topics
from dmrl.estimation.model.pair import Array
from dmrl.geometry.frames import Camera
from dmrl.labelling.image_labels import NEAREST_M, SOURCE, Look, Positions, anywhere, image_labels
from dmrl.labelling.recorded_camera import camera_of
from dmrl.labelling.sensor_logs import Logs
from dmrl.messages import message
from dmrl.recording import Contents, Series, Timed
from dmrl.recording.label_sources import looked_at

Times = NDArray[np.int64]


def position_series(observer: str, peer: str, found: Positions) -> Series:
    """PeerPosition messages of one pair."""
    x, y, z = found.xyz_m.T
    fields = {
        "frame_id": f"{observer}/horizontal",
        "x": x,
        "y": y,
        "z": z,
        "covariance": found.covariance.reshape(-1, 9),
        "status": found.status,
    }
    topic = topics.position(observer, peer)
    return Series(topic, message("PeerPosition"), found.time_ns, fields)


def label_messages(
    held: Contents,
    logs: Logs,
    robot: str,
    positions: Mapping[str, Positions],
    look: Look,
) -> Iterator[Timed]:
    """PeerLabels of every image that has a position or had labels, in time order.

    Where any peer is located, every other that has a log is named too, as one that may be anywhere:
    else the image would be one without it.

    Parameters
    ----------
    held
        Where the images, their labels and the calibration are.
    logs
        Attitude of the robot.
    robot
        It carries the camera.
    positions
        By peer.
    look
        How positions become pixels.
    """
    kept, looked = _of_other_sources(held, topics.labels(robot))
    camera = look.cameras.get(robot) or camera_of(held, robot)
    images_ns = held.times(topics.camera_image(robot))
    fresh = _fresh(logs, robot, positions, look, camera, images_ns) if camera else {}
    for time_ns in sorted({*kept, *fresh}):
        peers = [*kept.get(time_ns, []), *fresh.get(time_ns, [])]
        sources = sorted(looked[time_ns] | ({SOURCE} if time_ns in fresh else set()))
        made = message("PeerLabels")(peers=peers, sources=sources)
        yield Timed(time_ns, topics.labels(robot), made)


def _fresh(
    logs: Logs,
    robot: str,
    positions: Mapping[str, Positions],
    look: Look,
    camera: Camera,
    images_ns: Times,
) -> dict[int, list[Any]]:
    """Entries of the images at which any peer has a position, by log time."""
    exposures_ns = look.exposures_ns(robot, images_ns)
    made: dict[int, list[Any]] = defaultdict(list)
    unknown: dict[int, set[str]] = defaultdict(lambda: {*logs.flying} - {robot})
    for peer, found in positions.items():
        at = np.isin(found.time_ns, exposures_ns)
        mine = Positions(found.time_ns[at], found.xyz_m[at], found.covariance[at], found.status[at])
        labels = image_labels(peer, mine, _attitude(logs, robot, mine.time_ns), camera, look)
        stamps = images_ns[np.searchsorted(exposures_ns, mine.time_ns)].tolist()
        for time_ns, label in zip(stamps, labels, strict=True):
            made[time_ns] += [label] if label else []
            unknown[time_ns] -= {peer}
    for time_ns, peers in unknown.items():
        made[time_ns] += [anywhere(peer, camera, NEAREST_M) for peer in sorted(peers)]
    return {t: [message("PeerLabel")(**label) for label in labels] for t, labels in made.items()}


def _of_other_sources(
    held: Contents, topic: str
) -> tuple[dict[int, list[Any]], dict[int, set[str]]]:
    """Entries of the labels that are there, and who looked, without earlier estimates."""
    kept: dict[int, list[Any]] = defaultdict(list)
    looked: dict[int, set[str]] = defaultdict(set)
    for stamped in held.messages(topic) if topic in held.topics else ():
        labels = stamped.message
        kept[stamped.time_ns] += [peer for peer in labels.peers if peer.source != SOURCE]
        looked[stamped.time_ns] |= looked_at(labels) - {SOURCE}
    return kept, looked


def _attitude(logs: Logs, robot: str, time_ns: Times) -> Array:
    """(N, 2) roll and pitch at log times, radians."""
    at_s, values = logs.robots[robot].attitude
    time_s = (time_ns - logs.start_ns) * 1e-9
    return np.column_stack([np.interp(time_s, at_s, column) for column in values[:, :2].T])
