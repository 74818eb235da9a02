"""Where peers truly are: as a recording says it, or from motion capture of both robots.

A simulated flight says it pair by pair. Motion capture says where each robot is in the world, on
``/<robot>/pose/truth``; where its peers are, as the robot sees it, follows. Where both stand, what
is said of the pair counts. Estimates are in ``labelling.write``.
"""

from collections.abc import Iterable

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dmrl import topics
from dmrl.estimation.model.position_metrics import inside_truth
from dmrl.geometry.frames import Array
from dmrl.geometry.rotations import euler_zyx
from dmrl.recording import Contents

UNIT = 0.1
"""A quaternion whose length is further from 1 is none."""
TOLD = (topics.TRUTH, topics.TRUE_POSE)
"""Topics that tell it: what `Contents` has to hold."""
Times = NDArray[np.int64]


def true_pairs(held: Iterable[str]) -> list[tuple[str, str]]:
    """Robot and peer of every pair that there is truth for, sorted.

    Parameters
    ----------
    held
        Topics of a recording.
    """
    held = list(held)
    said = {(n["robot"], n["peer"]) for t in held if (n := topics.names(topics.TRUTH, t))}
    captured = topics.robots(held, topics.TRUE_POSE)
    return sorted(said | {(one, peer) for one in captured for peer in captured if one != peer})


def true_path(held: Contents, robot: str, peer: str) -> tuple[Times, Array]:
    """Where a peer truly was.

    Parameters
    ----------
    held
        A recording, best with what `TOLD` names.
    robot, peer
        One of `true_pairs`.

    Returns
    -------
    tuple
        (N,) log times, increasing, and (N, 3) metres in the robot's horizontal frame.

    Raises
    ------
    RecordingError
        If it cannot be read.
    """
    topic = topics.truth(robot, peer)
    if topic in held.topics:
        table = held.table(topic, ("x", "y", "z"))
        return table["log_time"].to_numpy(), _stack(table, "xyz")
    time_ns, place, yaw = _poses(held, robot)
    peer_ns, peer_place, _ = _poses(held, peer)
    # Lost markers leave no straight line.
    known = inside_truth(time_ns, peer_ns)
    time_ns, place, yaw = time_ns[known], place[known], yaw[known]
    if not len(time_ns):
        return time_ns, place
    there = np.column_stack([np.interp(time_ns, peer_ns, axis) for axis in peer_place.T])
    x, y, z = (there - place).T
    c, s = np.cos(yaw), np.sin(yaw)
    return time_ns, np.column_stack([c * x + s * y, c * y - s * x, z])


def _poses(held: Contents, robot: str) -> tuple[Times, Array, Array]:
    """Times, (N, 3) places in the world and yaw of a robot; poses that are none are left out."""
    table = held.table(topics.true_pose(robot), ("pose",))
    time_ns = table["log_time"].to_numpy()
    pose = pa.Table.from_struct_array(table["pose"])
    place = _stack(pa.Table.from_struct_array(pose["position"]), "xyz")
    turn = _stack(pa.Table.from_struct_array(pose["orientation"]), "xyzw")
    size = np.linalg.norm(turn, axis=1)
    good = np.isfinite(place).all(axis=1) & (np.abs(size - 1) < UNIT)
    yaw = euler_zyx(turn[good] / size[good, None])[:, 2]
    return time_ns[good], place[good], yaw


def _stack(table: pa.Table, names: str) -> Array:
    return np.column_stack([table[name].to_numpy() for name in names])
