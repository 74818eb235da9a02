"""Odometry and heights that contradict the ranges, and fast motion that does not."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.model.pair import Array, Pair, SensorTrack
from dmrl.estimation.signals.contradictions import drop_contradictions

GRID_S = np.arange(0, 20.001, 0.01)
RANGES_S = np.arange(0.1, 20, 0.05)


def build_track(speed: Array | float = 0.0, height: Array | float = 1.0) -> SensorTrack:
    """Return a log with this forward speed, m/s, and height, m, and a yaw rate of 0.1 rad/s."""
    zero = np.zeros(len(GRID_S))
    return SensorTrack(zero + speed, zero, zero + 0.1, zero + height, np.zeros(len(zero), bool))


def build_pair(own: SensorTrack, peer: SensorTrack, distance: Array | float = 2.0) -> Pair:
    """Return a pair with ranges of this distance, metres."""
    return Pair(GRID_S, own, peer, RANGES_S, np.zeros(len(RANGES_S)) + distance)


def build_runaway(start_s: float = 16.0, end_s: float = np.inf) -> Array:
    """Return a velocity that diverges to 9 m/s between two times, else 0."""
    inside = (start_s < GRID_S) & (end_s > GRID_S)
    return np.minimum(9.0, 6 * (GRID_S - start_s)) * inside


@pytest.mark.parametrize("robot", ["own", "peer"])
def test_log_of_a_crashed_robot_becomes_motionless_on_the_floor(robot: str) -> None:
    flight = build_pair(build_track(), build_track())
    found = drop_contradictions(replace(flight, **{robot: build_track(build_runaway())}))
    gone, other = (getattr(found, k) for k in (robot, "peer" if robot == "own" else "own"))
    assert gone.dropout[GRID_S > 17].all() and not gone.dropout[GRID_S < 15].any()
    for signal in (gone.vx_mps, gone.vy_mps, gone.yaw_rate_radps):
        assert not signal[GRID_S > 17].any()
    assert not gone.height_m[GRID_S > 18.5].any()
    assert gone.height_m[GRID_S < 15] == pytest.approx(1.0)
    assert not other.dropout.any() and (other.height_m == 1.0).all()


def test_log_that_spins_faster_than_its_speed_allows_is_a_crash() -> None:
    """A circle at 9 m/s and 12 rad/s has a radius of 0.75 m, so its displacement fits ranges."""
    late = GRID_S > 16
    spinning = replace(build_track(9.0 * late), yaw_rate_radps=0.1 + 11.9 * late)
    found = drop_contradictions(build_pair(spinning, build_track()))
    assert found.own.dropout[GRID_S > 16.5].all() and not found.own.dropout[GRID_S < 14].any()
    turning = replace(build_track(4.0), yaw_rate_radps=np.full(len(GRID_S), 3.5))
    assert not drop_contradictions(build_pair(turning, build_track())).own.dropout.any()


def test_temporary_estimate_error_is_no_crash() -> None:
    found = drop_contradictions(build_pair(build_track(build_runaway(8.0, 11.0)), build_track()))
    assert found.own.dropout[(GRID_S > 9) & (GRID_S < 11)].all()
    assert not found.own.dropout[(GRID_S < 7) | (GRID_S > 13)].any()
    assert (found.own.height_m == 1.0).all()


def test_fast_motion_consistent_with_ranges_is_kept() -> None:
    """One robot passes the other at 8 m/s; in the second case both fly side by side."""
    away = np.abs(8.0 * (RANGES_S - 10)) + 1.0
    past = build_pair(build_track(8.0), build_track(), np.minimum(away, 59.0))
    assert drop_contradictions(past).own.dropout.sum() == 0
    together = build_pair(build_track(8.0), build_track(8.0))
    assert drop_contradictions(together).own.dropout.sum() == 0


def test_single_outliers_and_wrong_scales_are_no_contradiction() -> None:
    speed = np.full(len(GRID_S), 0.2)
    speed[::50] = 20.0
    assert not drop_contradictions(build_pair(build_track(speed), build_track())).own.dropout.any()
    swing = 1.5 * np.sin(GRID_S)
    far = 2.0 + 1.5 * (1 - np.cos(RANGES_S))
    assert not drop_contradictions(
        build_pair(build_track(1.2 * swing), build_track(), far)
    ).own.dropout.any()


def test_no_contradiction_is_found_without_ranges() -> None:
    flight = build_pair(build_track(build_runaway(8.0, 11.0)), build_track())
    heard = (flight.range_time_s < 7) | (flight.range_time_s > 12)
    quiet = replace(flight, range_time_s=RANGES_S[heard], range_m=flight.range_m[heard])
    assert not drop_contradictions(quiet).own.dropout.any()
    few = replace(flight, range_time_s=RANGES_S[:10], range_m=flight.range_m[:10])
    assert drop_contradictions(few) is few


def test_height_difference_beyond_the_range_is_dropped() -> None:
    high = np.where((GRID_S > 5) & (GRID_S < 6), 9.0, 1.0)
    found = drop_contradictions(build_pair(build_track(), build_track(height=high)))
    assert found.peer.height_dropout is not None
    assert GRID_S[found.peer.height_dropout][[0, -1]] == pytest.approx([5.01, 5.99])
    assert found.peer.height_m == pytest.approx(1.0)
    assert found.own.height_dropout is None
