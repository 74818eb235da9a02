"""Keyframes of flights with known motion."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.flight.pair_output import clip_to_ranges
from dmrl.estimation.model.pair import Array, BearingMeasurements, Pair, SensorTrack
from dmrl.estimation.solver.estimate import PAIR_LAYOUT, Estimate
from dmrl.estimation.solver.keyframes import (
    MIN_RANGE_STEP_M,
    average_ranges,
    build_problem,
    odometry_dropout,
    range_dropout,
    range_step_offsets,
    select_measurements,
)
from dmrl.estimation.solver.problem import NoiseModel

from ..model.test_odometry import TIME_S, build_arc, compute_arc


def build_arc_pair(ranges_s: Array, range_m: Array | None = None) -> Pair:
    """Return a pair that flies arcs while the peer climbs; ranges are 2 m by default."""
    range_m = 2.0 + 0 * ranges_s if range_m is None else range_m
    peer = replace(build_arc(-0.3), height_m=2 + 0.3 * (TIME_S - 3))
    return Pair(TIME_S, build_arc(), peer, ranges_s, range_m)


def test_keyframes_hold_motion_between_them_and_around_each_range() -> None:
    ranges_s = np.array([3.0, 3.05, 7.77, 23.0])
    task = build_problem({(0, 1): build_arc_pair(ranges_s)}, 10.0)
    own, peer = task.robots
    (link,) = task.links
    assert task.keyframe_s == pytest.approx(3 + np.arange(201) / 10)
    assert own.steps_s == pytest.approx(0.1)
    assert own.motion.shift_m == pytest.approx(compute_arc(np.full(200, 0.1)), abs=1e-5)
    assert peer.motion.turn_rad == pytest.approx(-0.03)
    assert link.keyframe.tolist() == [0, 0, 48, 200]
    since = ranges_s - task.keyframe_s[link.keyframe]
    assert link.own_shift_m == pytest.approx(compute_arc(since), abs=1e-5)
    assert link.height_m == pytest.approx(1 + 0.2 * (ranges_s - 3))
    assert own.height_m == pytest.approx(1 + 0.1 * (task.keyframe_s - 3))
    # With constant velocities, a shift of the peer's clock does not change the motion of a step.
    assert peer.clock_derivative[1:-1] == pytest.approx(0.0, abs=1e-6)
    speeding = replace(build_arc(0.0), vx_mps=0.5 * (TIME_S - 3))
    later = build_problem(
        {(0, 1): Pair(TIME_S, build_arc(), speeding, ranges_s, 2 + 0 * ranges_s)}, 10.0
    )
    assert later.robots[1].clock_derivative[1:-1, :2] == pytest.approx(
        np.tile([0.05, 0.0], (198, 1)), abs=1e-6
    )


def test_odometry_dropout_affects_its_own_robot_only() -> None:
    dense, quiet = np.arange(3.0, 23.0, 0.1), (TIME_S > 10) & (TIME_S < 11)
    flight = build_arc_pair(dense)
    flight = replace(flight, peer=replace(flight.peer, dropout=quiet))
    own, peer = build_problem({(0, 1): flight}).robots
    assert not own.dropout_s.any()
    assert peer.dropout_s.sum() == pytest.approx(1.0, abs=0.02)


def test_log_with_most_dropouts_is_used_for_a_robot() -> None:
    dense, quiet = np.arange(3.0, 23.0, 0.1), (TIME_S > 10) & (TIME_S < 11)
    flight = build_arc_pair(dense)
    gone = replace(flight, own=replace(flight.own, dropout=quiet))
    for flights in ((gone, flight), (flight, gone)):
        first, *_ = build_problem({(0, 1): flights[0], (0, 2): flights[1]}).robots
        assert first.dropout_s.sum() == pytest.approx(1.0, abs=0.02)


def test_range_dropout_lasts_over_half_a_second() -> None:
    dense = np.arange(3.0, 23.0, 0.1)
    times = np.arange(4.0, 22.0, 0.1)
    assert not range_dropout(build_arc_pair(dense), times).any()
    gap = range_dropout(build_arc_pair(dense[(dense < 10) | (dense > 10.65)]), times)
    assert times[gap][[0, -1]] == pytest.approx([10.0, 10.7], abs=0.06)


@pytest.mark.parametrize("first_s", [[3.0], [3.0, 3.3]])
def test_ranges_once_a_second_are_no_dropout(first_s: list[float]) -> None:
    """The ranges come from one robot, or from two robots in turns."""
    slow = np.sort(np.concatenate([np.arange(one, 22.99, 1.0) for one in first_s]))
    times = np.arange(4.0, 21.0, 0.1)
    assert not range_dropout(build_arc_pair(slow), times).any()
    assert range_dropout(build_arc_pair(slow[(slow < 10) | (slow > 13)]), times).any()


def test_dropout_extends_to_neighbouring_times() -> None:
    flight = build_arc_pair(np.arange(3.0, 23.0, 0.1))
    alone = np.arange(len(TIME_S)) == 1000
    flight = replace(flight, peer=replace(flight.peer, dropout=alone))
    beside = TIME_S[1000] + np.array([-0.015, -0.005, 0.005, 0.015])
    assert odometry_dropout(flight, beside).tolist() == [False, True, True, False]


def test_range_step_offset_is_detected_above_the_minimum() -> None:
    dense = np.arange(3.0, 23.0, 0.02)
    shadow = (dense > 9) & (dense < 11)
    for height_m, found_m in (
        (MIN_RANGE_STEP_M + 0.3, MIN_RANGE_STEP_M + 0.3),
        (MIN_RANGE_STEP_M - 0.2, 0.0),
    ):
        levels = range_step_offsets(build_arc_pair(dense, 2 + height_m * shadow))
        assert np.median(levels[shadow]) == pytest.approx(found_m, abs=0.02)
        assert not levels[(dense < 8.5) | (dense > 11.5)].any()


def test_fast_relative_motion_is_no_range_step() -> None:
    """The odometry shows that both robots fly apart at 3 m/s."""
    speed = 1.5 * ((TIME_S > 9) & (TIME_S < 9.4))
    own = replace(build_arc(0.0, 0.0, 0.0), vx_mps=-speed)
    peer = replace(build_arc(0.0, 0.0, 0.0), vx_mps=speed)
    ranges_s = np.arange(3.0, 23.0, 0.02)
    range_m = 2 + np.interp(ranges_s, [9.0, 9.4], [0.0, 1.2])
    assert not range_step_offsets(Pair(TIME_S, own, peer, ranges_s, range_m)).any()
    still = replace(own, vx_mps=0 * speed)
    assert range_step_offsets(Pair(TIME_S, still, still, ranges_s, range_m)).any()


def build_shuttle_pair(ranges_s: Array) -> Pair:
    """Return a pair whose peer oscillates at up to 1.5 m/s along the line between both robots."""
    peer = replace(build_arc(0.0, 0.0, 0.0), vx_mps=1.5 * np.cos(TIME_S), height_m=0 * TIME_S)
    own = replace(build_arc(0.0, 0.0, 0.0), height_m=0 * TIME_S)
    return Pair(TIME_S, own, peer, ranges_s, 3 + 1.5 * np.sin(ranges_s))


@pytest.mark.parametrize("period_s", [0.2, 0.5, 1.0])
def test_motion_between_slow_ranges_is_no_step(period_s: float) -> None:
    assert not range_step_offsets(build_shuttle_pair(np.arange(3.0, 22.9, period_s))).any()


def test_motion_while_ranges_are_silent_is_no_step() -> None:
    ranges_s = np.arange(3.0, 22.9, 0.02)
    ranges_s = ranges_s[(ranges_s < 11) | (ranges_s > 14)]
    assert not range_step_offsets(build_shuttle_pair(ranges_s)).any()


@pytest.mark.parametrize("period_s", [0.2, 0.5, 1.0])
def test_positions_between_slow_ranges_are_not_clipped(period_s: float) -> None:
    flight, count = build_shuttle_pair(np.arange(3.0, 22.9, period_s)), len(TIME_S)
    state = np.column_stack([3 + 1.5 * np.sin(TIME_S), np.zeros((count, 2))])
    spread, constants = np.tile(np.eye(3), (count, 1, 1)), np.zeros(len(PAIR_LAYOUT.constants))
    made = Estimate(TIME_S, state, spread, np.zeros(count, np.int8), constants, NoiseModel())
    assert not clip_to_ranges(flight, made)[1].any()


def test_averaged_range_is_the_median_per_keyframe() -> None:
    ranges_s = np.arange(3.0, 22.99, 0.02)
    range_m = 2 + 0.5 * (ranges_s - 3)
    range_m[::11] += 3.0
    task = build_problem({(0, 1): build_arc_pair(ranges_s, range_m)})
    found = average_ranges(task.links[0], task.keyframe_s)
    inner = slice(2, -2)
    wanted = 2 + 0.5 * (task.keyframe_s[found.keyframe] - 3)
    assert found.range_m[inner] == pytest.approx(wanted[inner], abs=0.02)
    # Each keyframe has ten ranges. A median has pi/2 times the variance of a mean.
    assert found.std_share[inner] == pytest.approx(np.sqrt(np.pi / 2 / 10), rel=0.06)
    assert not found.own_shift_m.any() and not found.peer_shift_m.any()
    some = select_measurements(task.links[0], task.links[0].keyframe < 3)
    assert len(some.range_m) == len(some.own_shift_m) == (task.links[0].keyframe < 3).sum()
    assert some.robots == (0, 1)


def test_positions_are_clipped_to_surrounding_ranges() -> None:
    ranges_s = np.arange(3.0, 23.0, 0.05)
    range_m = np.where(ranges_s < 13, 2.0, 4.0)
    range_m[40:-40:9] = 30.0  # single outliers must not widen the limit
    flight, key_s = build_arc_pair(ranges_s, range_m), np.arange(3.0, 23.0, 0.1)
    count = len(key_s)
    away = np.array([0.6, -0.8])
    for distance_m, allowed_m in ((1.9, 1.9), (2.49, 2.49), (3.5, 2.5), (9.0, 2.5)):
        state = np.column_stack([np.tile(distance_m * away, (count, 1)), np.full(count, 0.3)])
        made = Estimate(
            key_s,
            state,
            np.tile(np.eye(3), (count, 1, 1)),
            np.zeros(count, np.int8),
            np.zeros(len(PAIR_LAYOUT.constants)),
            NoiseModel(),
        )
        found, far = clip_to_ranges(flight, made)
        early = key_s < 11
        assert found.state[early, :2] == pytest.approx(np.tile(allowed_m * away, (early.sum(), 1)))
        assert (far[early] == (allowed_m < distance_m)).all()
        late = key_s > 15
        reach_m = min(distance_m, 4.5)
        assert found.state[late, :2] == pytest.approx(np.tile(reach_m * away, (late.sum(), 1)))
        assert (found.state[:, 2] == 0.3).all() and (made.state == state).all()


def test_range_steps_are_found_in_blocks_from_flight_start() -> None:
    time_s = 5.03 + np.arange(2001) / 100
    still = SensorTrack(*np.zeros((4, 2001)), np.zeros(2001, bool))
    ranges_s = time_s[:-1]
    shadow = (ranges_s >= 5.03 + 4 - 1e-6) & (ranges_s < 5.03 + 8 - 1e-6)
    flight = Pair(time_s, still, still, ranges_s + 1e-4, 2.0 + 1.0 * shadow)
    assert range_step_offsets(flight) == pytest.approx(1.0 * shadow)
    assert (
        range_step_offsets(replace(flight, range_time_s=ranges_s[:0], range_m=ranges_s[:0])).size
        == 0
    )


def build_detections(*times_s: float) -> BearingMeasurements:
    """Return images at these times with one equal candidate each."""
    polar = np.tile([0.1, 0.0, 0.7], (len(times_s), 1, 1))
    return BearingMeasurements(np.array(times_s), polar, np.full_like(polar, 0.05))


def test_keyframes_move_to_the_images() -> None:
    images_s = np.arange(3.04, 23.0, 0.1)
    flight = replace(build_arc_pair(np.array([4.0])), own_bearings=build_detections(*images_s))
    task = build_problem({(0, 1): flight})
    (view,) = task.views
    gap_s = view.time_s - task.keyframe_s[view.keyframe]
    assert np.abs(gap_s).max() < 1e-9
    assert len(view.time_s) > 90
    assert np.diff(task.keyframe_s).min() > 0.1
    # These keyframes stay, because windows of long flights start there.
    assert task.keyframe_s[[0, 50, 100]] == pytest.approx([3.0, 13.0, 23.0])


def test_infrequent_images_are_all_used() -> None:
    times_s = (4.31, 7.7, 8.9, 14.05, 19.99)
    flight = replace(build_arc_pair(np.array([4.0])), own_bearings=build_detections(*times_s))
    (view,) = build_problem({(0, 1): flight}).views
    assert view.time_s.tolist() == list(times_s)


def test_two_cameras_share_the_keyframes() -> None:
    own, peer = (build_detections(*np.arange(first_s, 23.0, 0.1)) for first_s in (3.0, 3.05))
    flight = replace(build_arc_pair(np.array([4.0])), own_bearings=own, peer_bearings=peer)
    one, other = build_problem({(0, 1): flight}).views
    assert min(len(one.time_s), len(other.time_s)) > 40
