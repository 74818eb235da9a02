"""Simulated camera bearings for the flights of `flights`."""

import numpy as np

from dmrl.estimation.model.bearings import to_bearing
from dmrl.estimation.model.pair import Array, BearingMeasurements, Pair, SensorTrack
from dmrl.flight import Flight

STD: Array = np.array([0.02, 0.03, 0.1])
NOISE: Array = np.array([0.01, 0.01, 0.1])
WIDE_RAD = 0.7
"""Half the horizontal field of view of the camera."""


def simulate_bearings(
    flight: Flight,
    own: str,
    peers: tuple[str, ...],
    *,
    hz: float = 5.0,
    missed: float = 0.15,
    wrong: float = 0.07,
    seed: int = 0,
) -> BearingMeasurements:
    """Return noisy and false detections of a robot's camera; images without any are left out.

    Parameters
    ----------
    flight
        A simulated flight.
    own, peers
        The robot, and the peers that it may detect.
    hz
        Images per second.
    missed
        Share of peers in view that are not detected.
    wrong
        Share of images with a false detection.
    seed
        Seed of the detector's errors.
    """
    rng = np.random.default_rng(seed)
    time_s = np.arange(flight.robots[own].time_s[0] + 0.03, flight.robots[own].time_s[-1], 1 / hz)
    polar = np.full((len(time_s), len(peers) + 1, 3), np.nan)
    for number, peer in enumerate(peers):
        true_s = flight.clocks[own].to_true_time(time_s)
        there = to_bearing(flight.peer_in_horizontal(own, peer, true_s))
        found = (np.abs(there[:, 0]) < WIDE_RAD) & (rng.random(len(there)) >= missed)
        noisy = there + NOISE * rng.standard_normal(there.shape)
        polar[:, number] = np.where(found[:, None], noisy, np.nan)
    nothing = rng.uniform([-WIDE_RAD, -0.4, -0.7], [WIDE_RAD, 0.4, 1.4], (len(time_s), 3))
    polar[:, -1] = np.where(rng.random(len(time_s))[:, None] < wrong, nothing, np.nan)
    shown = np.isfinite(polar[..., 0]).any(axis=1)
    return BearingMeasurements(
        time_s[shown], polar[shown], np.tile(STD, (shown.sum(), len(peers) + 1, 1))
    )


def compute_rmse(xy: Array, truth: Array) -> float:
    """Return the root mean square distance, metres."""
    return float(np.sqrt(((xy - truth) ** 2).sum(axis=1).mean()))


def build_still_pair(bearing_rad: float = 0.0) -> tuple[Pair, Array]:
    """Return a pair at rest for 10 s, the peer 2 m away at equal height, and its position (2,)."""
    time_s = np.arange(0, 10.005, 0.01)
    zero, never = np.zeros(len(time_s)), np.zeros(len(time_s), bool)
    still = SensorTrack(zero, zero, zero, zero, never)
    ranges_s = np.arange(0.05, 10, 0.05)
    where = 2.0 * np.array([np.cos(bearing_rad), np.sin(bearing_rad)])
    return Pair(time_s, still, still, ranges_s, np.full(len(ranges_s), 2.0)), where
