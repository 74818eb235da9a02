"""Simulated flights as pairs, with their truth."""

from dataclasses import replace
from functools import cache

import numpy as np

from dmrl.estimation.model.pair import Array, Pair, SensorTrack, usable_ranges
from dmrl.estimation.signals.sensor_tracks import build_track as sensed
from dmrl.flight import NOISE, Flight, RobotLog, Scenario, Trajectory, simulate


@cache
def flown(trajectory: Trajectory, noise: str, seed: int, duration_s: float = 40.0) -> Flight:
    return simulate(Scenario(2, duration_s, trajectory), NOISE[noise], seed)


def track(log: RobotLog, grid_s: Array) -> SensorTrack:
    velocity = np.column_stack([log.vx_mps, log.vy_mps])
    yaw_rate, height = log.yaw_rate_radps[:, None], log.height_m[:, None]
    return sensed(*((log.time_s, values) for values in (yaw_rate, velocity, height)), grid_s)


def pair_of(flight: Flight, own: str = "cf1", peer: str = "cf2") -> Pair:
    """One direction's ranges, on the observer's clock."""
    grid_s = flight.robots[own].time_s
    found = flight.ranges[own, peer]
    good = usable_ranges(found.time_s, found.range_m)
    good &= (found.time_s >= grid_s[0]) & (found.time_s <= grid_s[-1])
    tracks = [track(flight.robots[name], grid_s) for name in (own, peer)]
    return Pair(grid_s, tracks[0], tracks[1], found.time_s[good], found.range_m[good])


def both_ranging(flight: Flight) -> Pair:
    """The pair with the ranges of both directions, as each robot stamped them."""
    pair, other = pair_of(flight), flight.ranges["cf2", "cf1"]
    time_s = np.concatenate([pair.range_time_s, other.time_s])
    order = np.argsort(time_s, kind="stable")
    order = order[(time_s[order] >= pair.time_s[0]) & (time_s[order] <= pair.time_s[-1])]
    sender = np.repeat([0, 1], [len(pair.range_m), len(other.range_m)]).astype(np.int8)
    range_m = np.concatenate([pair.range_m, other.range_m])
    return replace(
        pair, range_time_s=time_s[order], range_m=range_m[order], range_sender=sender[order]
    )


def truth_at(flight: Flight, time_s: Array, own: str = "cf1", peer: str = "cf2") -> Array:
    """(N, 2) where the peer truly is at times on the observer's clock."""
    true_s = flight.clocks[own].to_true_time(time_s)
    return flight.peer_in_horizontal(own, peer, true_s)[:, :2]
