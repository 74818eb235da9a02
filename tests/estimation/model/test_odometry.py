"""Dead reckoning, and a pair cut into keyframes, of motions that are known."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.flight.pairs import clip_to_ranges
from dmrl.estimation.model.odometry import preintegrate, rotation_matrix
from dmrl.estimation.model.pair import Array, Pair, SensorTrack
from dmrl.estimation.solver.covariance import (
    MIN_ENERGY_RATIO,
    SMOOTHING_S,
    denoise_for_covariance,
    integrate_path,
    motion_energy,
    shrink_to_signal,
    velocity_noise_power,
)
from dmrl.estimation.solver.estimate import Estimate
from dmrl.estimation.solver.keyframes import (
    CLOCK_HALF_STEP_S,
    GLOBALS,
    MIN_RANGE_STEP_M,
    NoiseModel,
    build_keyframes,
    odometry_dropout,
    range_step_offsets,
)
from dmrl.estimation.solver.residuals import step_variance

TIME_S = 3 + np.arange(0, 20.001, 0.01)
VX, VY, TURN = 0.4, -0.2, 0.5


def arc(turn: float = TURN, vx: float = VX, vy: float = VY) -> SensorTrack:
    """A robot that flies a circle: constant velocity in its own frame, constant turning."""
    ones = np.ones(len(TIME_S))
    return SensorTrack(
        vx * ones, vy * ones, turn * ones, 1 + 0.1 * (TIME_S - 3), np.zeros(len(ones), bool)
    )


def along_arc(lasts_s: Array, turn: float = TURN) -> Array:
    """(N, 2) how far that brings a robot, in the frame of the start."""
    z = (VX + 1j * VY) * (np.exp(1j * turn * lasts_s) - 1) / (1j * turn)
    return np.column_stack([z.real, z.imag])


def test_increments_are_arcs_seen_from_their_start() -> None:
    from_s, to_s = np.array([3.0, 4.003, 10.0, 12.0]), np.array([3.5, 6.011, 10.0, 11.0])
    found = preintegrate(arc(), TIME_S).relative_motion(from_s, to_s)
    lasts = to_s - from_s
    assert found.turn_rad == pytest.approx(TURN * lasts)
    assert found.shift_m == pytest.approx(along_arc(lasts), abs=1e-4)
    for axis, step in ((0, {"vx": VX + 1e-3}), (1, {"vy": VY + 1e-3})):
        biased = preintegrate(arc(**step), TIME_S).relative_motion(from_s, to_s)
        slope = (biased.shift_m - found.shift_m) / 1e-3
        assert found.bias_jacobian_s[:, :, axis] == pytest.approx(slope, abs=1e-9)
    assert rotation_matrix(np.array([np.pi / 2]))[0] @ [1, 0] == pytest.approx([0, 1])


def pair(ranges_s: Array, range_m: Array | None = None) -> Pair:
    range_m = 2.0 + 0 * ranges_s if range_m is None else range_m
    peer = replace(arc(-0.3), height_m=2 + 0.3 * (TIME_S - 3))
    return Pair(TIME_S, arc(), peer, ranges_s, range_m)


def test_keyframes_hold_what_happened_between_them_and_up_to_each_range() -> None:
    ranges_s = np.array([3.0, 3.05, 7.77, 23.0])
    task = build_keyframes(pair(ranges_s), 10.0)
    assert task.keyframe_s == pytest.approx(3 + np.arange(201) / 10)
    assert task.steps_s == pytest.approx(0.1)
    step = along_arc(np.full(200, 0.1))
    assert task.own.shift_m == pytest.approx(step, abs=1e-5)
    assert task.peer.turn_rad == pytest.approx(-0.03)
    assert task.range_keyframe.tolist() == [0, 0, 47, 200]
    since = ranges_s - task.keyframe_s[task.range_keyframe]
    assert task.own_to_range.shift_m == pytest.approx(along_arc(since), abs=1e-5)
    assert task.peer_to_range.turn_rad == pytest.approx(-0.3 * since)
    assert task.height_m == pytest.approx(1 + 0.2 * (ranges_s - 3))
    # A peer whose clock is late did a moment ago what it seems to do now: no more, no less.
    assert task.peer_clock_derivative[1:-1] == pytest.approx(0.0, abs=1e-6)
    assert CLOCK_HALF_STEP_S < 0.1
    speeding = replace(arc(0.0), vx_mps=0.5 * (TIME_S - 3))
    later = build_keyframes(Pair(TIME_S, arc(), speeding, ranges_s, 2 + 0 * ranges_s), 10.0)
    assert later.peer_clock_derivative[1:-1] == pytest.approx(
        np.tile([0.05, 0.0], (198, 1)), abs=1e-6
    )


def test_silence_of_any_sensor_marks_its_keyframes() -> None:
    dense = np.arange(3.0, 23.0, 0.1)
    task = build_keyframes(pair(dense))
    assert not task.dropout[1:-1].any()  # before the first range and after the last it is
    assert not task.dropout_s.any()
    quiet = (TIME_S > 10) & (TIME_S < 11)
    for field, robot in (("dropout", "own"), ("dropout", "peer"), ("height_dropout", "own")):
        flight = pair(dense)
        flight = replace(flight, **{robot: replace(getattr(flight, robot), **{field: quiet})})
        found = build_keyframes(flight)
        inner = found.keyframe_s[found.dropout & (found.keyframe_s > 4) & (found.keyframe_s < 22)]
        assert inner[[0, -1]] == pytest.approx([10.0, 11.0], abs=0.11)
        assert found.dropout_s.sum() == pytest.approx(1.0 if field == "dropout" else 0.0, abs=0.02)
    task = build_keyframes(pair(dense[(dense < 10) | (dense > 10.65)]))
    inner = (task.keyframe_s > 4) & (task.keyframe_s < 22)
    assert not task.dropout.any()
    assert task.keyframe_s[task.range_dropout & inner][[0, -1]] == pytest.approx([10.0, 10.7])


def test_a_time_beside_a_silent_sample_is_silent() -> None:
    flight = pair(np.arange(3.0, 23.0, 0.1))
    alone = np.arange(len(TIME_S)) == 1000
    flight = replace(flight, peer=replace(flight.peer, dropout=alone))
    beside = TIME_S[1000] + np.array([-0.015, -0.005, 0.005, 0.015])
    assert odometry_dropout(flight, beside).tolist() == [False, True, True, False]


def test_a_shadow_is_guessed_by_its_jumps_and_small_ones_are_left_alone() -> None:
    dense = np.arange(3.0, 23.0, 0.02)
    shadow = (dense > 9) & (dense < 11)
    for height_m, found_m in (
        (MIN_RANGE_STEP_M + 0.3, MIN_RANGE_STEP_M + 0.3),
        (MIN_RANGE_STEP_M - 0.2, 0.0),
    ):
        levels = build_keyframes(pair(dense, 2 + height_m * shadow)).range_offset_guess_m
        assert np.median(levels[shadow]) == pytest.approx(found_m, abs=0.02)
        assert not levels[(dense < 8.5) | (dense > 11.5)].any()


def test_steps_vary_as_the_processes_do_that_make_them() -> None:
    noise, seconds = NoiseModel(), np.array([0.01, 0.1, 100.0])
    task = build_keyframes(pair(np.arange(3.0, 23.0, 0.1)))
    gap_s = np.array([0.0, 1.0, 0.0])
    task = replace(task, keyframe_s=np.concatenate([[0.0], np.cumsum(seconds)]), dropout_s=gap_s)
    shift, _, turn, error, _, longer = step_variance(task, noise).T
    white = 2 * noise.velocity_white_psd * seconds  # of two robots
    assert shift == pytest.approx(white + noise.dropout_speed_mps**2 * gap_s)
    assert turn == pytest.approx(
        2 * noise.yaw_rate_psd * seconds + noise.dropout_turn_radps**2 * gap_s
    )
    # Gauss-Markov: new noise at the rate of 2 std^2 / tau at first, all of it after long.
    assert error[0] == pytest.approx(4 * noise.velocity_std_mps**2 * 0.01 / 0.3, rel=0.05)
    assert error[2] == pytest.approx(2 * noise.velocity_std_mps**2)
    assert longer[0] == pytest.approx(2 * noise.range_error_std_m**2 * 0.01 / 200, rel=0.01)


def test_motion_is_shrunk_by_its_share_of_noise_and_nothing_is_left_of_noise_alone() -> None:
    energy = 0.01
    for speed in (0.05, 0.13, 0.2, 1.0):
        steady = np.tile([0.6 * speed, -0.8 * speed], (300, 1))
        share = np.sqrt(max(1 - MIN_ENERGY_RATIO * energy / speed**2, 0))
        assert shrink_to_signal(steady, energy, 0.1) == pytest.approx(share * steady)
    low = NoiseModel(velocity_std_mps=0.01)
    assert (
        velocity_noise_power(low)
        == velocity_noise_power(NoiseModel())
        == 2 * NoiseModel().velocity_psd / SMOOTHING_S
    )
    loud = NoiseModel(velocity_std_mps=0.2)
    assert velocity_noise_power(loud) == pytest.approx(2 * (2 * 0.3 * 0.04 + 2e-4) / SMOOTHING_S)


def test_paths_are_those_of_the_moves_and_their_energy_is_told() -> None:
    task = build_keyframes(pair(np.arange(3.0, 23.0, 0.1)))
    heading, place = integrate_path(task.own)
    assert heading == pytest.approx(TURN * (task.keyframe_s - 3))
    assert place == pytest.approx(along_arc(task.keyframe_s - 3), abs=1e-3)
    own, peer, relative = motion_energy(task, np.zeros((201, 6)))
    # The mean over a second and a half cuts the corner of a circle.
    cut = np.sinc(TURN * 1.5 / (2 * np.pi)) ** 2
    assert own == pytest.approx(cut * (VX**2 + VY**2), rel=0.03)
    assert peer == pytest.approx(np.sinc(0.3 * 1.5 / (2 * np.pi)) ** 2 * 0.2, rel=0.03)
    assert relative == 0.0


def test_a_calm_flight_is_the_same_but_for_what_may_be_noise() -> None:
    """Two robots that fly straight, each looking its own way: nothing is smoothed, all shrunk."""
    heights = np.ones(len(TIME_S))
    still = np.zeros(len(TIME_S), bool)

    def straight(vx: float, vy: float) -> SensorTrack:
        return SensorTrack(vx * heights, vy * heights, 0 * heights, heights, still)

    ranges_s = np.arange(3.0, 23.0, 0.1)
    own, peer = straight(0.3, 0.1), straight(-0.2, 0.4)
    task = build_keyframes(Pair(TIME_S, own, peer, ranges_s, 2 + 0 * ranges_s))
    psi = 0.7
    in_own = (-0.2 + 0.4j) * np.exp(1j * psi)  # the peer's velocity, in the observer's frame
    apart = (1 + 2j) + (in_own - (0.3 + 0.1j)) * (task.keyframe_s - 3)
    state = np.zeros((len(task.keyframe_s), 6))
    state[:, 0], state[:, 1], state[:, 2], state[:, 3:] = apart.real, apart.imag, psi, 9.0
    noise = NoiseModel(velocity_std_mps=0.1)
    single = velocity_noise_power(noise)
    keep = [
        np.sqrt(1 - MIN_ENERGY_RATIO * energy / abs(v) ** 2)
        for energy, v in ((single, 0.3 + 0.1j), (2 * single, in_own - (0.3 + 0.1j)))
    ]
    assert min(keep) > 0.3 and max(keep) < 0.95
    found, calm = denoise_for_covariance(task, noise, state)
    middle = apart.mean()
    shrunken = middle + keep[1] * (apart - middle)
    assert calm[:, 0] + 1j * calm[:, 1] == pytest.approx(shrunken, abs=1e-6)
    assert (calm[:, 2] == psi).all() and not calm[:, 3:].any()
    step = keep[0] * (0.3 + 0.1j) * 0.1
    assert found.own.shift_m[:, 0] + 1j * found.own.shift_m[:, 1] == pytest.approx(
        np.full(200, step), abs=1e-9
    )
    there = (step + keep[1] * (in_own - (0.3 + 0.1j)) * 0.1) * np.exp(-1j * psi)
    assert found.peer.shift_m[:, 0] + 1j * found.peer.shift_m[:, 1] == pytest.approx(
        np.full(200, there), abs=1e-9
    )
    assert (found.own.turn_rad == task.own.turn_rad).all()
    assert (found.range_m == task.range_m).all()


def test_velocities_are_averaged_over_the_calm_time() -> None:
    """A sample alone becomes a plateau; without noise nothing is shrunk."""
    lone = np.zeros((200, 2))
    lone[100] = 1.0
    found = shrink_to_signal(lone, 0.0, 0.1)
    count = round(SMOOTHING_S / 0.1)
    assert found[:, 0] == pytest.approx(found[:, 1])
    within = np.flatnonzero(found[:, 0] > 1e-9)
    assert len(within) == count and within.mean() == pytest.approx(100, abs=0.5)
    assert found[100] == pytest.approx([1 / count, 1 / count])


def test_a_calm_path_turns_with_the_robots_that_fly_it() -> None:
    """Of motion far above its noise, the poses that follow from it are those that were."""
    task = build_keyframes(pair(np.arange(3.0, 23.0, 0.1)))
    heading, place = integrate_path(task.own)
    turned, way = integrate_path(task.peer)
    psi = 0.4 + turned - heading
    world = (
        np.array([1.0, 2.0]) + np.einsum("ij,kj->ki", rotation_matrix(np.array(0.4)), way) - place
    )
    state = np.zeros((len(task.keyframe_s), 6))
    state[:, :2] = np.einsum("kij,kj->ki", rotation_matrix(-heading), world)
    state[:, 2] = psi
    found, calm = denoise_for_covariance(task, NoiseModel(velocity_std_mps=1e-9), state)
    own = np.diff(place, axis=0)
    seen = np.einsum("kij,kj->ki", rotation_matrix(heading[:-1]), found.own.shift_m)
    inner = slice(20, -20)  # at the ends the mean has nothing to mean over
    assert np.abs(seen - own)[inner].max() < 0.003
    steps = np.einsum("kij,kj->ki", rotation_matrix(heading[:-1] + psi[:-1]), found.peer.shift_m)
    other = np.diff(np.einsum("ij,kj->ki", rotation_matrix(np.array(0.4)), way), axis=0)
    assert np.abs(steps - other)[inner].max() < 0.006
    back = np.einsum("kij,kj->ki", rotation_matrix(heading), calm[:, :2])
    assert np.abs(back - world).max() < 0.35
    assert back.mean(axis=0) == pytest.approx(world.mean(axis=0))


def test_nobody_is_farther_than_the_ranges_around_allow() -> None:
    ranges_s = np.arange(3.0, 23.0, 0.05)
    range_m = np.where(ranges_s < 13, 2.0, 4.0)
    range_m[40:-40:9] = 30.0  # single outliers allow nothing
    task = build_keyframes(pair(ranges_s, range_m))
    count = len(task.keyframe_s)
    away = np.array([0.6, -0.8])
    for distance_m, allowed_m in ((1.9, 1.9), (2.49, 2.49), (3.5, 2.5), (9.0, 2.5)):
        state = np.column_stack([np.tile(distance_m * away, (count, 1)), np.full(count, 0.3)])
        made = Estimate(
            task.keyframe_s,
            state,
            np.tile(np.eye(3), (count, 1, 1)),
            np.zeros(count, np.int8),
            np.zeros(len(GLOBALS)),
            NoiseModel(),
        )
        found, far = clip_to_ranges(task, made)
        early = task.keyframe_s < 11
        assert found.state[early, :2] == pytest.approx(np.tile(allowed_m * away, (early.sum(), 1)))
        assert (far[early] == (allowed_m < distance_m)).all()
        late = task.keyframe_s > 15
        reach_m = min(distance_m, 4.5)
        assert found.state[late, :2] == pytest.approx(np.tile(reach_m * away, (late.sum(), 1)))
        assert (found.state[:, 2] == 0.3).all() and (made.state == state).all()


def test_ranges_are_levelled_in_blocks_from_the_start_of_a_flight() -> None:
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
