"""True positions of peers: recorded pair by pair, or from motion capture of both robots.

A simulated flight has ``/<robot>/peer/<peer>/truth``. Motion capture has each robot's pose in the
world on ``/<robot>/pose/truth``; positions of peers follow from two of them. If a recording has
both, the positions of the pair count.
"""

from collections.abc import Iterable

import numpy as np

from dmrl import topics
from dmrl.estimation.model.position_metrics import is_covered_by_truth
from dmrl.geometry.frames import Array
from dmrl.geometry.rotations import quaternion_to_euler
from dmrl.labelling.flight_log import FlightLog, RobotPair, Times

QUATERNION_TOLERANCE = 0.1
"""Largest difference of a quaternion's length from 1; others are left out."""


def list_true_pairs(held: Iterable[str]) -> list[RobotPair]:
    """Return observer and peer of every pair that has true positions, sorted.

    Parameters
    ----------
    held
        Topics of a recording.
    """
    held = list(held)
    recorded = {(n["robot"], n["peer"]) for t in held if (n := topics.parse_topic(topics.TRUTH, t))}
    captured = topics.list_robots(held, topics.TRUE_POSE)
    return sorted(recorded | {(one, peer) for one in captured for peer in captured if one != peer})


def find_true_path(flight: FlightLog, robot: str, peer: str) -> tuple[Times, Array]:
    """Return the true positions of a peer.

    Parameters
    ----------
    flight
        With the topics `flight_log.TRUTH_TOPICS`.
    robot, peer
        One of `list_true_pairs`.

    Returns
    -------
    tuple
        (N,) log times, increasing, and (N, 3) metres in the robot's horizontal frame.
    """
    if (robot, peer) in flight.true_positions:
        found = flight.true_positions[robot, peer]
        return found.time_ns, found.xyz_m
    time_ns, place, yaw = _finite_poses(flight, robot)
    peer_ns, peer_place, _ = _finite_poses(flight, peer)
    # Lost markers leave no straight line.
    known = is_covered_by_truth(time_ns, peer_ns)
    time_ns, place, yaw = time_ns[known], place[known], yaw[known]
    if not len(time_ns):
        return time_ns, place
    peer_at = np.column_stack([np.interp(time_ns, peer_ns, axis) for axis in peer_place.T])
    x, y, z = (peer_at - place).T
    c, s = np.cos(yaw), np.sin(yaw)
    return time_ns, np.column_stack([c * x + s * y, c * y - s * x, z])


def _finite_poses(flight: FlightLog, robot: str) -> tuple[Times, Array, Array]:
    """Return times, (N, 3) places in the world and yaw of a robot's valid poses."""
    time_ns, _, rows = flight.true_poses[robot]
    place, turn = rows[:, :3], rows[:, 3:]
    length = np.linalg.norm(turn, axis=1)
    good = np.isfinite(place).all(axis=1) & (np.abs(length - 1) < QUATERNION_TOLERANCE)
    yaw = quaternion_to_euler(turn[good] / length[good, None])[:, 2]
    return time_ns[good], place[good], yaw
