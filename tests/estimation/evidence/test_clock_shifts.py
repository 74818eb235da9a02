"""Offsets and jumps of a clock, found from two-way ranges or from the motion."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.evidence.clock_shifts import (
    ClockShift,
    find_clock_shift,
    with_known_clock,
)
from dmrl.estimation.evidence.mistakes import compute_misfit
from dmrl.estimation.evidence.posterior import list_shown
from dmrl.estimation.flight.pair_output import to_peer_clock
from dmrl.estimation.flight.pairs import estimate_pairs
from dmrl.estimation.model.pair import Pair
from dmrl.estimation.model.status import OK
from dmrl.estimation.solver.estimate import PAIR_LAYOUT, Estimate
from dmrl.estimation.solver.keyframes import build_problem
from dmrl.estimation.solver.problem import NoiseModel
from dmrl.estimation.solver.robust_loss import Gaussian

from ..flights import build_pair, build_two_way_pair, compute_truth, simulate_flight


def test_a_shifted_clock_moves_all_of_its_measurements() -> None:
    pair = build_two_way_pair(simulate_flight("in_view", "calibrated", 1000, 20.0))
    moved = ClockShift(2.0).move(pair)
    at = slice(300, 1500)
    assert moved.peer.vx_mps[500:1700] == pytest.approx(pair.peer.vx_mps[at])
    assert moved.peer.dropout[:190].all() and moved.own is pair.own
    assert moved.range_sender is not None and pair.range_sender is not None
    for robot, shift_s in ((0, 0.0), (1, 2.0)):
        before = pair.range_m[pair.range_sender == robot]
        after = moved.range_m[moved.range_sender == robot]
        assert after.tolist() == before[: len(after)].tolist()
        first = moved.range_time_s[moved.range_sender == robot][0]
        assert first - pair.range_time_s[pair.range_sender == robot][0] == pytest.approx(shift_s)


def test_a_jump_of_a_clock_moves_only_later_measurements() -> None:
    pair = build_two_way_pair(simulate_flight("in_view", "calibrated", 1000, 20.0))
    moved = ClockShift(-0.4, 10.0).move(pair)
    assert moved.peer.vx_mps[:950] == pytest.approx(pair.peer.vx_mps[:950])
    assert moved.peer.vx_mps[970:1900] == pytest.approx(pair.peer.vx_mps[1010:1940])
    assert moved.range_sender is not None
    mine = moved.range_time_s[moved.range_sender == 1]
    assert not ((mine > 8.5) & (mine < 11.1)).any()


@pytest.mark.parametrize("shift", [ClockShift(0.3), ClockShift(-0.4, 10.0), ClockShift(0.4, 10.0)])
def test_shifted_times_are_converted_back_to_log_times(shift: ClockShift) -> None:
    log_s = np.array([1.0, 9.0, 9.9, 12.0, 15.0])
    assert shift.to_log_times(log_s + shift.shift_s * (log_s >= shift.from_s))[[0, 1, 3, 4]] == (
        pytest.approx(log_s[[0, 1, 3, 4]])
    )
    assert (np.diff(shift.to_log_times(np.linspace(0.0, 20.0, 401))) >= 0).all()


@pytest.mark.heavy
def test_two_way_ranges_constrain_the_clock_of_the_solve() -> None:
    flight = simulate_flight("in_view", "calibrated", 1000, 60.0)
    known, off = (
        with_known_clock(ClockShift(shift_s).move(build_two_way_pair(flight)))
        for shift_s in (0.0, 0.045)
    )
    assert known.known_std["clock", (1,)] < 0.02 < off.known_std["clock", (1,)]
    problem = build_problem({(0, 1): known})
    (row,) = (row for (name, _), row in problem.layout.constants if name == "clock")
    assert isinstance(row.loss, Gaussian)
    assert "clock offset" not in {one.model.name for one in list_shown(problem)}
    one_way = build_pair(flight)
    assert with_known_clock(one_way) is one_way
    alone = list_shown(build_problem({(0, 1): one_way}))
    assert "clock offset" in {one.model.name for one in alone}


@pytest.mark.parametrize("shift_s", [0.07, 0.12, -0.3, 3.2])
@pytest.mark.heavy
def test_the_ranges_of_both_robots_show_an_offset_of_the_clock(shift_s: float) -> None:
    sound = build_two_way_pair(simulate_flight("in_view", "calibrated", 1000, 60.0))
    late = ClockShift(shift_s).move(sound)
    found = find_clock_shift(late)
    assert found is not None
    assert found.name == f"clock fits if it is moved by {found.shift_s:+.2f} s"
    assert found.shift_s == pytest.approx(-shift_s, abs=0.03)
    assert find_clock_shift(sound) is None
    assert find_clock_shift(found.move(late)) is None
    here = late.range_sender == 0
    single = replace(late, range_time_s=late.range_time_s[here], range_m=late.range_m[here])
    assert find_clock_shift(replace(single, range_sender=np.zeros(here.sum(), np.int8))) is None


@pytest.mark.heavy
def test_a_clock_that_is_seconds_off_is_found() -> None:
    late = ClockShift(3.2).move(
        build_two_way_pair(simulate_flight("in_view", "calibrated", 1000, 60.0))
    )
    found = find_clock_shift(late)
    assert found is not None
    assert compute_misfit(found.move(late)) < 0.6


@pytest.mark.heavy
@pytest.mark.parametrize("shift_s", [-0.4, 0.5])
def test_a_jump_of_a_clock_is_found_and_corrected(shift_s: float) -> None:
    flight = simulate_flight("in_view", "realistic", 1000, 100.0)
    sound = build_pair(flight)
    jumping = ClockShift(shift_s, 40.0).move(build_two_way_pair(flight))
    ((own, peer),) = estimate_pairs([jumping])
    cause = own.causes[0]
    assert cause.name.startswith(f"clock fits if it is moved by {-shift_s:+.1f}"[:-1])
    assert cause.from_s == pytest.approx(40.0, abs=2.0) and cause.to_s == sound.time_s[-1]
    assert cause.probability == 1.0 and peer.causes[0].name == cause.name
    error = np.hypot(*(own.state[:, :2] - compute_truth(flight, own.time_s)).T)
    assert np.sqrt((error**2).mean()) < 0.2
    assert (np.diff(peer.time_s) >= 0).all()
    assert own.time_s[-1] == pytest.approx(sound.time_s[-1], abs=0.1)


def keep_ranges_of(pair: Pair, robot: int) -> Pair:
    """Return a pair without the ranges of the other robot."""
    kept = pair.range_sender == robot
    assert pair.range_sender is not None
    return replace(
        pair, range_time_s=pair.range_time_s[kept], range_m=pair.range_m[kept],
        range_sender=pair.range_sender[kept],
    )  # fmt: skip


@pytest.mark.heavy
@pytest.mark.parametrize(("shift_s", "robot"), [(0.15, 0), (0.6, 0), (-0.3, 1), (0.0, 0)])
def test_motion_shows_the_clock_of_a_robot_that_does_not_range(shift_s: float, robot: int) -> None:
    flight = simulate_flight("in_view", "calibrated", 1000, 60.0)
    shift = ClockShift(shift_s)
    ((own, peer),) = estimate_pairs([keep_ranges_of(shift.move(build_two_way_pair(flight)), robot)])
    named = [cause.name for cause in own.causes if cause.name.startswith("clock fits")]
    assert len(named) == (shift_s != 0.0)
    for one, (observer, seen), offset_s in (
        (own, ("cf1", "cf2"), 0.0),
        (peer, ("cf2", "cf1"), shift_s),
    ):
        kept = (one.status == OK) & (one.time_s > 20.0)
        truth = compute_truth(flight, one.time_s[kept] - offset_s, observer, seen)
        error = np.hypot(*(one.state[kept, :2] - truth).T)
        assert kept.mean() > 0.5 and np.sqrt((error**2).mean()) < 0.2


def test_an_uncertain_clock_widens_positions_along_the_motion() -> None:
    time_s = np.arange(4.0)
    state = np.column_stack([2.0 * time_s, np.zeros(4), np.zeros(4)])
    spread = np.tile(np.eye(3), (4, 1, 1))
    at = Estimate(
        time_s, state, spread, np.zeros(4, np.int8), np.zeros(len(PAIR_LAYOUT.constants)),
        NoiseModel(), clock_s=np.full(4, 0.5), clock_variance=np.full(4, 0.25),
    )  # fmt: skip
    moved = to_peer_clock(at)
    assert moved.time_s.tolist() == [0.5, 1.5, 2.5, 3.5]
    assert moved.covariance[0].tolist() == [[2.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    assert to_peer_clock(replace(at, clock_s=None)).time_s is time_s


@pytest.mark.heavy
@pytest.mark.parametrize("robot", [0, 1])
def test_calibration_pools_constants_whichever_robot_ranges(robot: int) -> None:
    pair = keep_ranges_of(
        build_two_way_pair(simulate_flight("in_view", "calibrated", 1000, 20.0)), robot
    )
    ((own, _),) = estimate_pairs([pair], plain=True)
    assert own.constants_covariance is not None
