"""A plain factor graph of a pair in gtsam, without sensor error models, as a baseline.

It has poses of both robots ten times per second, odometry factors between successive poses, and
range factors with a Cauchy loss. Several initial bearings and headings of the peer are tried.
"""

from itertools import pairwise, product

import gtsam
import numpy as np
from gtsam import noiseModel

from dmrl.estimation.model.odometry import RelativeMotion, preintegrate, rotation_matrix
from dmrl.estimation.model.pair import Pair
from dmrl.geometry.frames import Array

KEY_HZ = 10.0
FIRST_S = 20.0
DIRECTIONS = 5
"""Number of initial bearings, and of initial headings."""
KEPT = 3
RANGE_STD_M, STEP_STD_M, TURN_STD_RAD = 0.10, 0.02, 0.002
"""Noise of a range and of 0.1 s of odometry, as simulated in bench_label_faults."""
MARGINAL_EVERY = 5
ANCHOR = noiseModel.Isotropic.Sigma(3, 1e-6)
ODOMETRY = noiseModel.Diagonal.Sigmas(np.array([STEP_STD_M, STEP_STD_M, TURN_STD_RAD]))
RANGE = noiseModel.Robust.Create(
    noiseModel.mEstimator.Cauchy.Create(1.0), noiseModel.Isotropic.Sigma(1, RANGE_STD_M)
)


Solved = tuple[Array, Array, Array]
"""Times (K,), relative poses (K, 3: x, y, yaw) and covariances (K, 3, 3) of a peer."""


def solve(pair: Pair) -> tuple[Solved, Solved]:
    """Solve a pair; return the peer relative to the observer, and the observer to the peer."""
    key_s = np.arange(pair.time_s[0], pair.time_s[-1], 1 / KEY_HZ)
    moves = [
        preintegrate(track, pair.time_s).relative_motion(key_s[:-1], key_s[1:])
        for track in (pair.own, pair.peer)
    ]
    level_m = _average_ranges(pair, key_s)
    few = min(len(key_s), int(FIRST_S * KEY_HZ))
    short, whole = _build_graph(moves, level_m, few), _build_graph(moves, level_m, len(key_s))
    first = float(level_m[np.isfinite(level_m)][0])
    angles = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    tried = [
        _optimise(short, moves, few, gtsam.Pose2(first * np.cos(a), first * np.sin(a), heading))
        for a, heading in product(angles, angles)
    ]
    likely = sorted(tried, key=short.error)[:KEPT]
    ends = [_optimise(whole, moves, len(key_s), v.atPose2(_peer(0))) for v in likely]
    values = min(ends, key=whole.error)
    at = np.arange(0, len(key_s), MARGINAL_EVERY)
    marginals = gtsam.Marginals(whole, values)
    out = []
    for here, there in ((_own, _peer), (_peer, _own)):
        found = [_compute_relative(values, marginals, here(k), there(k)) for k in at.tolist()]
        states, covariances = zip(*found, strict=True)
        out.append((key_s[at], np.array(states), np.array(covariances)))
    return out[0], out[1]


def _own(k: int) -> int:
    """Return the key of the robot's pose at a keyframe."""
    return 2 * k


def _peer(k: int) -> int:
    """Return the key of the peer's pose at a keyframe."""
    return 2 * k + 1


def _average_ranges(pair: Pair, key_s: Array) -> Array:
    """Return (K,) horizontal distances at the keyframes, from the median range of each, or NaN."""
    edges = np.searchsorted(
        pair.range_time_s, np.append(key_s, key_s[-1] + 1 / KEY_HZ) - 0.5 / KEY_HZ
    )
    found = [np.median(pair.range_m[a:b]) if b > a else np.nan for a, b in pairwise(edges.tolist())]
    high = np.interp(key_s, pair.time_s, pair.peer.height_m - pair.own.height_m)
    return np.sqrt(np.maximum(np.array(found) ** 2 - high**2, 0.05**2))


def _build_graph(
    moves: list[RelativeMotion], level_m: Array, count: int
) -> gtsam.NonlinearFactorGraph:
    """Return a graph of the odometry and ranges of the first keyframes."""
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorPose2(_own(0), gtsam.Pose2(), ANCHOR))
    for key, way in zip((_own, _peer), moves, strict=True):
        for k in range(count - 1):
            step = gtsam.Pose2(*way.shift_m[k], way.turn_rad[k])
            graph.add(gtsam.BetweenFactorPose2(key(k), key(k + 1), step, ODOMETRY))
    for k in np.flatnonzero(np.isfinite(level_m[:count])).tolist():
        graph.add(gtsam.RangeFactorPose2(_own(k), _peer(k), float(level_m[k]), RANGE))
    return graph


def _optimise(
    graph: gtsam.NonlinearFactorGraph, moves: list[RelativeMotion], count: int, start: gtsam.Pose2
) -> gtsam.Values:
    """Solve the first keyframes; dead reckoning from the peer's start gives the initial poses."""
    values = gtsam.Values()
    for key, way, pose in ((_own, moves[0], gtsam.Pose2()), (_peer, moves[1], start)):
        for k in range(count):
            values.insert(key(k), pose)
            if k < count - 1:
                pose = pose.compose(gtsam.Pose2(*way.shift_m[k], way.turn_rad[k]))
    return gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()


def _compute_relative(
    values: gtsam.Values, marginals: gtsam.Marginals, here: int, there: int
) -> tuple[Array, Array]:
    """Return pose (3,) and covariance (3, 3) of one pose in the frame of another."""
    joint = marginals.jointMarginalCovariance(gtsam.KeyVector([here, there]))
    apart = values.atPose2(here).between(values.atPose2(there))
    by_here, by_there = np.zeros((3, 3)), np.zeros((3, 3))
    by_here[:2, :2], by_here[:2, 2] = -np.eye(2), (apart.y(), -apart.x())
    by_there[:2, :2] = rotation_matrix(np.array(apart.theta()))
    by_here[2, 2], by_there[2, 2] = -1.0, 1.0
    rows = ((here, by_here), (there, by_there))
    spread = sum(a @ joint.at(i, j) @ b.T for i, a in rows for j, b in rows)
    return np.array([apart.x(), apart.y(), apart.theta()]), np.asarray(spread)
