"""One observer's detections and its peers' positions, to calibrate its camera with."""

import numpy as np

from dmrl import topics
from dmrl.errors import MissingTopic
from dmrl.estimation.calibration.observations import CalibrationFlight, PeerPath
from dmrl.labelling.flight_log import FlightLog
from dmrl.labelling.ground_truth import find_true_path, list_true_pairs
from dmrl.labelling.observer_log import finite_attitude, select_detections
from dmrl.labelling.peer_positions import PeerPositions
from dmrl.messages import STATUS_OK

DEFAULT_COVARIANCE = np.eye(3) * 0.1**2
"""(3, 3) m^2, assumed for a position that has none: a decimetre each way."""
MOCAP_COVARIANCE = np.eye(3) * 0.01**2
"""(3, 3) m^2, of motion capture: markers are not quite at the robot's centre."""


def read_calibration_flight(
    flight: FlightLog, robot: str, threshold: float | None, positions: str
) -> CalibrationFlight:
    """Return one observer's detections and the paths of its peers.

    Parameters
    ----------
    flight
        With detections, attitude and positions.
    robot
        The observer.
    threshold
        Least confidence of a detection; None: the detector's own.
    positions
        Pattern of the topics of positions: `topics.POSITION`, or `topics.TRUTH`, for which
        motion capture of both robots does as well.

    Raises
    ------
    RecordingError
        If the flight lacks one of these.
    """
    pairs = list(flight.positions)
    if positions == topics.TRUTH:
        pairs = list_true_pairs(flight.topics)
    peers = [peer for observer, peer in pairs if observer == robot]
    if not peers:
        raise MissingTopic(positions.format(robot=robot, peer="*"), flight.topics, flight.path)
    time_ns, detections, first = select_detections(flight, robot, threshold)
    attitude_ns, attitude = finite_attitude(flight, robot)
    found = flight.true_positions if positions == topics.TRUTH else flight.positions
    paths = {
        peer: _to_path(flight, found[robot, peer])
        if (robot, peer) in found
        else _build_mocap_path(flight, robot, peer)
        for peer in peers
    }
    return CalibrationFlight(
        flight.to_seconds(time_ns),
        np.repeat(np.arange(len(time_ns)), np.diff(first)),
        detections[:, :2],
        flight.to_seconds(attitude_ns),
        attitude[:, :2],
        {peer: path for peer, path in paths.items() if len(path.time_s) > 1},
    )


def _to_path(flight: FlightLog, found: PeerPositions) -> PeerPath:
    """Return the positions with status OK."""
    good = found.status == STATUS_OK
    covariance = found.covariance[good]
    covariance[np.isnan(covariance).all(axis=(1, 2))] = DEFAULT_COVARIANCE
    return PeerPath(flight.to_seconds(found.time_ns[good]), found.xyz_m[good], covariance)


def _build_mocap_path(flight: FlightLog, robot: str, peer: str) -> PeerPath:
    """Return the positions by motion capture of both robots."""
    time_ns, xyz_m = find_true_path(flight, robot, peer)
    covariance = np.tile(MOCAP_COVARIANCE, (len(time_ns), 1, 1))
    return PeerPath(flight.to_seconds(time_ns), xyz_m, covariance)
