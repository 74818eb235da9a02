from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from dmrl.estimation.flight.segments import (
    is_inconsistent,
    join_segments,
    prefer_confident_segments,
    split_at_dropouts,
)
from dmrl.estimation.model.pair import Pair, SensorTrack
from dmrl.estimation.model.status import OK, UNCONVERGED
from dmrl.estimation.solver.estimate import Estimate
from dmrl.estimation.solver.keyframes import GLOBALS, NoiseModel, build_keyframes

from ..flights import flown, pair_of, truth_at


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
    return Estimate(time_s, state, spread, statuses, constants, NoiseModel())


def test_long_silences_of_the_ranges_part_a_flight() -> None:
    pair = pair_of(flown("in_view", "calibrated", 1000, 60.0))
    assert split_at_dropouts(pair) == []
    early, late = split_at_dropouts(silent(pair, 20.0, 40.0))
    assert early.time_s[-1] <= 20.1 and late.time_s[0] >= 39.9
    lost = len(silent(pair, 20.0, 40.0).range_m) - len(early.range_m) - len(late.range_m)
    assert 0 <= lost <= 2  # between two samples of the grid
    assert len(split_at_dropouts(silent(pair, 5.0, 20.0))) == 1  # five seconds tell nothing


def test_silent_odometry_parts_a_flight_too() -> None:
    pair = pair_of(flown("in_view", "calibrated", 1000, 60.0))
    gap = (pair.time_s > 20.0) & (pair.time_s < 25.0)
    early, late = split_at_dropouts(replace(pair, peer=replace(pair.peer, dropout=gap)))
    assert early.time_s[-1] <= 20.1 and late.time_s[0] >= 24.9
    short = (pair.time_s > 20.0) & (pair.time_s < 22.0)
    assert split_at_dropouts(replace(pair, peer=replace(pair.peer, dropout=short))) == []


def test_stretches_are_joined_by_dead_reckoning() -> None:
    flight = flown("in_view", "ideal", 1000, 60.0)
    pair = pair_of(flight)
    whole, cut = build_keyframes(pair), silent(pair, 20.0, 40.0)
    yaw = [flight.truth[name].yaw_at(whole.keyframe_s) for name in ("cf1", "cf2")]
    truth = np.column_stack([truth_at(flight, whole.keyframe_s), yaw[1] - yaw[0]])
    parts = []
    for number, part in enumerate(split_at_dropouts(cut)):
        at = (whole.keyframe_s >= part.time_s[0]) & (whole.keyframe_s <= part.time_s[-1])
        turned = truth[at] + [0.0, 0.0, 2 * np.pi * number]  # which turn of the circle is nobody's
        parts.append(replace(standing(whole.keyframe_s[at], 0.0), state=turned))
    state = join_segments(whole, parts)
    assert np.abs(state[:, :2] - truth[:, :2]).max() < 0.02
    assert np.abs(np.sin(state[:, 2] - truth[:, 2])).max() < 0.02
    assert np.abs(np.diff(state[:, 2])).max() < 0.5


def test_a_stretch_that_is_sure_counts_against_the_whole_flight() -> None:
    pair = silent(pair_of(flown("in_view", "calibrated", 1000, 60.0)), 20.0, 40.0)
    key_s = np.arange(0.0, 60.0, 0.1) + pair.time_s[0]
    whole = standing(key_s, 1.0)
    early, late = (
        standing(part.time_s, x)
        for part, x in zip(split_at_dropouts(pair), (1.0, -1.0), strict=True)
    )
    here, there = prefer_confident_segments((whole, whole), [(early, early), (late, late)])
    after = key_s > 40.5
    assert (here.state[after, 0] == -1.0).all() and (here.state[key_s < 39.0, 0] == 1.0).all()
    assert (there.state[after, 0] == -1.0).all()


def test_who_is_not_sure_contradicts_nobody() -> None:
    time_s = np.arange(0.0, 20.0, 0.1)
    whole = standing(time_s, 1.0)
    assert is_inconsistent(whole, standing(time_s, 2.0))
    assert not is_inconsistent(whole, standing(time_s, 1.1))
    assert not is_inconsistent(whole, standing(time_s, 2.0, UNCONVERGED))


def heard(ranges_s: np.ndarray, lasts_s: float = 60.0, gap: np.ndarray | None = None) -> Pair:
    """Two robots that stand still, and range to each other at these times."""
    time_s = 5 + np.arange(round(100 * lasts_s) + 1) / 100
    still = SensorTrack(*np.zeros((4, len(time_s))), np.zeros(len(time_s), bool))
    own = still if gap is None else replace(still, dropout=gap)
    return Pair(time_s, own, still, 5 + ranges_s, np.ones(len(ranges_s)))


@pytest.mark.parametrize(("silent_s", "count"), [(2.95, 0), (3.05, 2)])
def test_a_silence_is_longer_than_three_seconds(silent_s: float, count: int) -> None:
    ranges_s = np.concatenate([np.arange(0, 20, 0.1), np.arange(19.9 + silent_s, 60, 0.1)])
    found = split_at_dropouts(heard(ranges_s))
    assert len(found) == count
    if count:
        early, late = found
        assert (early.time_s[-1], late.time_s[0]) == pytest.approx(
            (24.9, 24.9 + silent_s), abs=0.011
        )
        assert len(early.range_m) + len(late.range_m) == pytest.approx(len(ranges_s), abs=2)
    steady = np.arange(0, 60, 0.1)
    gap = np.zeros(6001, bool)
    gap[2000 : 2000 + round(100 * silent_s)] = True
    assert len(split_at_dropouts(heard(steady, gap=gap))) == count


@pytest.mark.parametrize(("lasts_s", "count"), [(9.9, 1), (10.1, 2)])
def test_a_stretch_lasts_ten_seconds_at_least(lasts_s: float, count: int) -> None:
    ranges_s = np.concatenate([np.arange(0, lasts_s, 0.1), np.arange(20, 60, 0.1)])
    assert len(split_at_dropouts(heard(ranges_s))) == count


@pytest.mark.parametrize(("ranges", "count"), [(19, 1), (20, 2)])
def test_a_stretch_has_twenty_ranges_at_least(ranges: int, count: int) -> None:
    ranges_s = np.concatenate([np.linspace(0, 15, ranges), np.arange(30, 60, 0.1)])
    assert len(split_at_dropouts(heard(ranges_s))) == count


@pytest.mark.parametrize(
    ("share", "sigmas", "wrong"),
    [
        (0.19, 9.0, False),
        (0.20, 9.0, False),
        (0.21, 9.0, True),
        (1.0, 0.99 * np.sqrt(chi2.ppf(0.99, 2)), False),
        (1.0, 1.01 * np.sqrt(chi2.ppf(0.99, 2)), True),
    ],
)
def test_a_solution_is_contradicted_by_a_fifth_outside_the_ellipse_of_99_percent(
    share: float, sigmas: float, wrong: bool
) -> None:
    time_s = np.arange(100.0)
    sure = standing(time_s, 1.0)
    state = sure.state.copy()
    state[: round(share * 100), 1] += 0.1 * sigmas
    assert is_inconsistent(replace(sure, state=state), sure) == wrong


def test_between_stretches_of_two_the_peer_goes_over_evenly() -> None:
    flight = build_keyframes(heard(np.arange(0, 60, 0.1)))
    key_s = flight.keyframe_s

    def part(start_s: float, end_s: float, from_m: float, to_m: float) -> Estimate:
        """The peer moves, other than its log says; at times of its own."""
        time_s = np.arange(start_s, end_s, 0.07)
        made = standing(time_s, 0.0)
        made.state[:, 0] = from_m + (to_m - from_m) * (time_s - start_s) / (end_s - start_s)
        return made

    found = join_segments(flight, [part(5, 20, 0.0, 1.5), part(45, 60, 3.0, 4.5)])
    wanted = np.interp(key_s, [5, 20, 45, 60, 65], [0, 1.5, 3, 4.5, 4.5])
    assert found[:, 0] == pytest.approx(wanted, abs=0.021)
    assert not found[:, 1:].any()
    alone = join_segments(flight, [part(10, 20, 1.0, 2.0)])
    assert alone[:, 0] == pytest.approx(np.interp(key_s, [10, 20], [1, 2]), abs=0.021)


def circling(
    vx: float, vy: float, turn: float, count: int
) -> tuple[SensorTrack, np.ndarray, np.ndarray]:
    """A robot that flies a circle, as it measures it; its heading and where it is, as x + iy."""
    time_s = np.arange(count) / 100
    ones = np.ones(count)
    height_m = 1 + 0.1 * vx * time_s
    track = SensorTrack(vx * ones, vy * ones, turn * ones, height_m, np.zeros(count, bool))
    place = (vx + 1j * vy) * (np.exp(1j * turn * time_s) - 1) / (1j * turn)
    return track, turn * time_s, place


def test_a_part_of_a_flight_is_what_was_measured_then() -> None:
    rng = np.random.default_rng(2)
    count = 6001
    time_s = 5 + np.arange(count) / 100

    def anything() -> SensorTrack:
        return SensorTrack(
            *rng.normal(size=(4, count)), np.zeros(count, bool), rng.random(count) < 0.5
        )

    ranges_s = np.concatenate([np.arange(5, 25, 0.1), np.arange(45, 65, 0.1)])
    pair = Pair(time_s, anything(), anything(), ranges_s, rng.uniform(1, 2, len(ranges_s)))
    found = split_at_dropouts(pair)
    assert len(found) == 2
    for part in found:
        at = (time_s >= part.time_s[0]) & (time_s <= part.time_s[-1])
        assert (part.time_s == time_s[at]).all()
        for cut, whole in ((part.own, pair.own), (part.peer, pair.peer)):
            for one, other in zip(cut.signals(), whole.signals(), strict=True):
                assert (one == other[at]).all()
            assert whole.height_dropout is not None and cut.height_dropout is not None
            assert (cut.dropout == whole.dropout[at]).all()
            assert (cut.height_dropout == whole.height_dropout[at]).all()
        heard_then = (ranges_s >= part.time_s[0]) & (ranges_s <= part.time_s[-1])
        assert (part.range_time_s == ranges_s[heard_then]).all()
        assert (part.range_m == pair.range_m[heard_then]).all()
    assert sum(len(part.range_m) for part in found) >= len(ranges_s) - 2


def test_joined_stretches_of_two_that_circle_are_the_way_they_flew() -> None:
    own, turned, here = circling(0.3, -0.1, 0.2, 6001)
    peer, there_turned, there = circling(-0.2, 0.4, -0.35, 6001)
    time_s = 5 + np.arange(6001) / 100
    flight = build_keyframes(Pair(time_s, own, peer, np.array([6.0]), np.array([1.0])))
    apart = ((1.5 + 0.5j) + np.exp(0.7j) * there - here) * np.exp(-1j * turned)
    truth = np.column_stack([apart.real, apart.imag, 0.7 + there_turned - turned])
    key_s = flight.keyframe_s
    truth = np.column_stack([np.interp(key_s, time_s, column) for column in truth.T])

    def part(start_s: float, end_s: float, turns: int, error_m: float) -> Estimate:
        at = (key_s > start_s - 0.01) & (key_s < end_s + 0.01)
        made = standing(key_s[at], 0.0)
        state = truth[at] + [0.0, 0.0, 2 * np.pi * turns]  # which turn it is is nobody's
        return replace(made, state=state, range_error_m=np.full(at.sum(), error_m))

    for parts in (
        [part(8, 20, 0, 0.1), part(30, 40, 1, 0.2), part(50, 60, -1, 0.3)],
        [part(25, 35, 0, 0.4)],
        [part(8, 20, 0, 0.1), replace(part(30, 40, 0, 0.0), range_error_m=None)],
    ):
        state = join_segments(flight, parts)
        assert state.shape == (len(key_s), 6)
        assert state[:, :3] == pytest.approx(truth, abs=0.01)
        assert not state[:, 3:5].any()
        wanted = np.zeros(len(key_s))
        for one in parts:
            if one.range_error_m is not None:
                wanted[np.isin(key_s, one.time_s)] = one.range_error_m[0]
        assert state[:, 5] == pytest.approx(wanted)


def test_in_a_stretch_its_solution_counts_whatever_the_logs_say() -> None:
    """A peer that comes closer, while both logs say that nobody moves."""
    time_s = np.arange(3001) / 100
    still = SensorTrack(*np.zeros((4, 3001)), np.zeros(3001, bool))
    flight = build_keyframes(Pair(time_s, still, still, np.array([1.0]), np.array([1.0])))
    inner = (flight.keyframe_s > 9.99) & (flight.keyframe_s < 20.01)
    part = standing(flight.keyframe_s[inner], 0.0)
    part.state[:, 0] = np.linspace(5.0, 1.0, inner.sum())
    wanted = np.interp(flight.keyframe_s, part.time_s, part.state[:, 0])  # beyond it, nobody moves
    assert join_segments(flight, [part])[:, 0] == pytest.approx(wanted)


@pytest.mark.parametrize("doubted", ["here", "there", "neither"])
def test_a_surer_stretch_counts_whichever_robot_it_contradicts(doubted: str) -> None:
    time_s = np.arange(0.0, 20.0, 0.1)
    inner = time_s[50:101]
    whole = standing(time_s, 1.0, UNCONVERGED)
    part = standing(inner, 1.0)
    part.covariance[...] *= np.linspace(1, 2, len(inner))[:, None, None]
    part.status[3] = UNCONVERGED
    part.state[:, 2] = np.linspace(3.0, 3.5, len(inner))
    own, peer = replace(part), replace(part)
    if doubted != "neither":
        side = own if doubted == "here" else peer
        object.__setattr__(side, "state", part.state * [-1.0, 1.0, 1.0])
    found = prefer_confident_segments((whole, whole), [(own, peer)])
    if doubted == "neither":
        assert found == (whole, whole)
        return
    at = np.zeros(len(time_s), bool)
    at[50:101] = True
    for got, alone in zip(found, (own, peer), strict=True):
        assert got.state[at] == pytest.approx(alone.state)
        assert got.covariance[at] == pytest.approx(alone.covariance)
        assert (got.status[at] == alone.status).all()
        assert (got.state[~at] == whole.state[~at]).all()
        assert (got.covariance[~at] == whole.covariance[~at]).all()
        assert (got.status[~at] == whole.status[~at]).all()
    assert (whole.state[:, 0] == 1.0).all()
