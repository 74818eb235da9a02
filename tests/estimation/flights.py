"""Simulated flights, their logs as pairs of robots, and their true positions."""

from dataclasses import replace
from functools import cache

import numpy as np

from dmrl.estimation.model.pair import Array, Pair, SensorTrack, usable_ranges
from dmrl.estimation.signals.sensor_tracks import build_track
from dmrl.flight import NOISE, Flight, RobotLog, Scenario, Trajectory, simulate


@cache
def simulate_flight(
    trajectory: Trajectory, noise: str, seed: int, duration_s: float = 40.0
) -> Flight:
    """Simulate a flight of two robots, once for all tests."""
    return simulate(Scenario(2, duration_s, trajectory), NOISE[noise], seed)


def resample_log(log: RobotLog, grid_s: Array) -> SensorTrack:
    """Resample the log of a robot on a time grid."""
    velocity = np.column_stack([log.vx_mps, log.vy_mps])
    yaw_rate, height = log.yaw_rate_radps[:, None], log.height_m[:, None]
    return build_track(*((log.time_s, values) for values in (yaw_rate, velocity, height)), grid_s)


def build_pair(flight: Flight, own: str = "cf1", peer: str = "cf2") -> Pair:
    """Return the logs of two robots with the ranges that the first one measured."""
    grid_s = flight.robots[own].time_s
    found = flight.ranges[own, peer]
    good = usable_ranges(found.time_s, found.range_m)
    good &= (found.time_s >= grid_s[0]) & (found.time_s <= grid_s[-1])
    tracks = [resample_log(flight.robots[name], grid_s) for name in (own, peer)]
    return Pair(grid_s, tracks[0], tracks[1], found.time_s[good], found.range_m[good])


def build_two_way_pair(flight: Flight) -> Pair:
    """Return a pair with the ranges of both robots, each on the clock of its robot."""
    pair, other = build_pair(flight), flight.ranges["cf2", "cf1"]
    time_s = np.concatenate([pair.range_time_s, other.time_s])
    order = np.argsort(time_s, kind="stable")
    order = order[(time_s[order] >= pair.time_s[0]) & (time_s[order] <= pair.time_s[-1])]
    sender = np.repeat([0, 1], [len(pair.range_m), len(other.range_m)]).astype(np.int8)
    range_m = np.concatenate([pair.range_m, other.range_m])
    return replace(
        pair, range_time_s=time_s[order], range_m=range_m[order], range_sender=sender[order]
    )


def compute_truth(flight: Flight, time_s: Array, own: str = "cf1", peer: str = "cf2") -> Array:
    """Return (N, 2) true positions of the peer, horizontal frame of the observer, on its clock."""
    true_s = flight.clocks[own].to_true_time(time_s)
    return flight.peer_in_horizontal(own, peer, true_s)[:, :2]
