from dataclasses import replace

import numpy as np

from dmrl.estimation.estimated import Estimate
from dmrl.estimation.gate import OK, UNCONVERGED
from dmrl.estimation.pair import Pair
from dmrl.estimation.problem import GLOBALS, Noise, problem
from dmrl.estimation.stretches import contradicts, joined, mended, stretches

from .flights import flown, pair_of, truth_at


def silent(pair: Pair, start_s: float, end_s: float) -> Pair:
    """The pair without ranges for a while."""
    heard = (pair.range_time_s < start_s) | (pair.range_time_s > end_s)
    return replace(pair, range_time_s=pair.range_time_s[heard], range_m=pair.range_m[heard])


def standing(time_s: np.ndarray, x_m: float, status: int = OK) -> Estimate:
    """A peer that is x_m ahead, known to 0.1 m."""
    state = np.tile([x_m, 0.0, 0.0], (len(time_s), 1))
    spread = np.tile(0.01 * np.eye(3), (len(time_s), 1, 1))
    constants = np.zeros(len(GLOBALS))
    statuses = np.full(len(time_s), status, np.int8)
    return Estimate(time_s, state, spread, statuses, constants, Noise())


def test_long_silences_of_the_ranges_part_a_flight() -> None:
    pair = pair_of(flown("in_view", "calibrated", 1000, 60.0))
    assert stretches(pair) == []
    early, late = stretches(silent(pair, 20.0, 40.0))
    assert early.time_s[-1] <= 20.1 and late.time_s[0] >= 39.9
    lost = len(silent(pair, 20.0, 40.0).range_m) - len(early.range_m) - len(late.range_m)
    assert 0 <= lost <= 2  # between two samples of the grid
    assert len(stretches(silent(pair, 5.0, 20.0))) == 1  # five seconds tell nothing


def test_silent_odometry_parts_a_flight_too() -> None:
    pair = pair_of(flown("in_view", "calibrated", 1000, 60.0))
    gap = (pair.time_s > 20.0) & (pair.time_s < 25.0)
    early, late = stretches(replace(pair, peer=replace(pair.peer, gap=gap)))
    assert early.time_s[-1] <= 20.1 and late.time_s[0] >= 24.9
    short = (pair.time_s > 20.0) & (pair.time_s < 22.0)
    assert stretches(replace(pair, peer=replace(pair.peer, gap=short))) == []


def test_stretches_are_joined_by_dead_reckoning() -> None:
    flight = flown("in_view", "ideal", 1000, 60.0)
    pair = pair_of(flight)
    whole, cut = problem(pair), silent(pair, 20.0, 40.0)
    yaw = [flight.truth[name].yaw_at(whole.key_s) for name in ("cf1", "cf2")]
    truth = np.column_stack([truth_at(flight, whole.key_s), yaw[1] - yaw[0]])
    parts = []
    for number, part in enumerate(stretches(cut)):
        at = (whole.key_s >= part.time_s[0]) & (whole.key_s <= part.time_s[-1])
        turned = truth[at] + [0.0, 0.0, 2 * np.pi * number]  # which turn of the circle is nobody's
        parts.append(replace(standing(whole.key_s[at], 0.0), state=turned))
    state = joined(whole, parts)
    assert np.abs(state[:, :2] - truth[:, :2]).max() < 0.02
    assert np.abs(np.sin(state[:, 2] - truth[:, 2])).max() < 0.02
    assert np.abs(np.diff(state[:, 2])).max() < 0.5


def test_a_stretch_that_is_sure_counts_against_the_whole_flight() -> None:
    pair = silent(pair_of(flown("in_view", "calibrated", 1000, 60.0)), 20.0, 40.0)
    key_s = np.arange(0.0, 60.0, 0.1) + pair.time_s[0]
    whole = standing(key_s, 1.0)
    early, late = (
        standing(part.time_s, x) for part, x in zip(stretches(pair), (1.0, -1.0), strict=True)
    )
    here, there = mended((whole, whole), [(early, early), (late, late)])
    after = key_s > 40.5
    assert (here.state[after, 0] == -1.0).all() and (here.state[key_s < 39.0, 0] == 1.0).all()
    assert (there.state[after, 0] == -1.0).all()


def test_who_is_not_sure_contradicts_nobody() -> None:
    time_s = np.arange(0.0, 20.0, 0.1)
    whole = standing(time_s, 1.0)
    assert contradicts(whole, standing(time_s, 2.0))
    assert not contradicts(whole, standing(time_s, 1.1))
    assert not contradicts(whole, standing(time_s, 2.0, UNCONVERGED))
