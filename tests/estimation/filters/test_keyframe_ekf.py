"""The filter over keyframes, against one that is written out for a single pair."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.estimation.filters.keyframe_ekf import (
    MAX_INNOVATION_SIGMAS,
    SHADOWED_RANGE_STD_M,
    FilterInputs,
    _medians_by_keyframe,
    _propagate,
    _update_ranges,
    build_inputs,
    run_filters,
    smooth_rts,
)
from dmrl.estimation.model.odometry import rotation_matrix
from dmrl.estimation.model.pair import Array, Pair, SensorTrack
from dmrl.estimation.solver.keyframes import NoiseModel, build_keyframes

KEYS, FILTERS = 5, 3


def anything(seed: int = 0) -> FilterInputs:
    """Inputs of three filters; the second has no range at keyframe 2, and one that is far off."""
    rng = np.random.default_rng(seed)

    def some(*shape: int) -> Array:
        return rng.normal(size=(KEYS, FILTERS, *shape)) * 0.3

    range_m = 2 + some()
    range_m[2, 1], range_m[3, 1] = np.nan, 9.0
    steps_s = np.full((KEYS, FILTERS), 0.1)
    variances = np.abs(some(5)) * 0.01, np.abs(some()) * 0.02 + 0.01
    turns, shifts, later = (some(), some()), (some(2), some(2)), (some(2), some(2))
    return FilterInputs(
        steps_s, *turns, *shifts, variances[0], range_m, variances[1], *later, some()
    )


def seen_m(state: Array, inputs: FilterInputs, k: int, b: int) -> float:
    """The range that a state says."""
    peer = rotation_matrix(state[2]) @ inputs.peer_to_range_m[k, b]
    xy = state[:2] + peer - inputs.own_to_range_m[k, b]
    return float(np.sqrt(xy @ xy + inputs.height_m[k, b] ** 2))


def next_state(state: Array, inputs: FilterInputs, k: int, b: int) -> Array:
    """Where a state goes: the peer moves, the observer moves, and the observer turns."""
    seconds = inputs.step_s[k, b]
    own = inputs.own_turn_rad[k, b] - seconds * state[3]
    peer = inputs.peer_turn_rad[k, b] - seconds * state[4]
    xy = (
        state[:2] + rotation_matrix(state[2]) @ inputs.peer_shift_m[k, b] - inputs.own_shift_m[k, b]
    )
    return np.array([*(rotation_matrix(-own) @ xy), state[2] + peer - own, state[3], state[4]])


def slope(of: object, state: Array) -> Array:
    """Derivatives of a function by the state, as differences."""
    steps = 1e-6 * np.eye(5)
    return np.stack([(of(state + s) - of(state - s)) / 2e-6 for s in steps], axis=-1)  # type: ignore[operator]


def test_a_filter_is_the_textbook_s_with_far_ranges_softened() -> None:
    inputs = anything()
    start = np.array([[1.0, 0.5, 0.2], [-1.5, 0.3, 1.0], [0.4, -1.8, -2.0]])
    std = np.array([0.5, 0.4, 0.3, 0.01, 0.02])
    found = run_filters(inputs, start, std)
    back, spread = smooth_rts(found)
    for b in range(FILTERS):
        state, covariance = np.array([*start[b], 0.0, 0.0]), np.diag(std**2)
        likely, kept = 0.0, []
        for k in range(KEYS):
            assert found.prior[k, b] == pytest.approx(state, abs=2e-5)
            assert found.prior_covariance[k, b] == pytest.approx(covariance, abs=1e-5)
            before = state, covariance
            if np.isfinite(inputs.range_m[k, b]):
                row = slope(lambda s: seen_m(s, inputs, k, b), state)  # noqa: B023
                noise = inputs.range_var[k, b]
                off = inputs.range_m[k, b] - seen_m(state, inputs, k, b)
                variance = row @ covariance @ row + noise
                size = abs(off) / np.sqrt(variance)
                likely -= 0.5 * np.log(variance) + np.log1p(0.5 * size**2)
                softer = noise * max(1.0, size / MAX_INNOVATION_SIGMAS) ** 2
                gain = covariance @ row / (row @ covariance @ row + softer)
                state = state + gain * off
                covariance = covariance - np.outer(gain, row @ covariance)
            assert found.state[k, b] == pytest.approx(state, abs=2e-5)
            assert found.covariance[k, b] == pytest.approx(covariance, abs=1e-5)
            step = slope(lambda s: next_state(s, inputs, k, b), state)  # noqa: B023
            assert found.step[k, b] == pytest.approx(step, abs=1e-6)
            kept.append((before, (state, covariance), step))
            state = next_state(state, inputs, k, b)
            covariance = step @ covariance @ step.T + np.diag(inputs.step_var[k, b])
        assert found.log_likelihood[b] == pytest.approx(likely, abs=1e-4)
        state, covariance = kept[-1][1]
        for k in range(KEYS - 2, -1, -1):
            (ahead, ahead_spread), (own, own_spread), step = kept[k + 1][0], *kept[k][1:]
            gain = own_spread @ step.T @ np.linalg.inv(ahead_spread)
            covariance = own_spread + gain @ (covariance - ahead_spread) @ gain.T
            state = own + gain @ (state - ahead)
            assert back[k, b] == pytest.approx(state, abs=1e-4)
            assert spread[k, b] == pytest.approx(covariance, abs=1e-5)


def test_a_step_and_an_update_leave_what_they_were_given() -> None:
    inputs, state = anything(1), np.ones((FILTERS, 5))
    after, _ = _propagate(state, inputs, 0)
    assert (state == 1).all() and not (after == 1).all()
    covariance, likely = np.tile(np.eye(5), (FILTERS, 1, 1)), np.zeros(FILTERS)
    _update_ranges(state, covariance, inputs, 2, likely)  # in place, but where nothing was heard
    assert (state[1] == 1).all() and (covariance[1] == np.eye(5)).all() and likely[1] == 0
    assert not (state[[0, 2]] == 1).all(axis=1).any() and (likely[[0, 2]] != 0).all()


@given(st.lists(st.tuples(st.integers(0, 4), st.floats(-9, 9)), max_size=12))
def test_medians_are_those_of_each_key(rows: list[tuple[int, float]]) -> None:
    key = np.array([k for k, _ in rows], np.intp)
    values = np.array([v for _, v in rows])
    found = _medians_by_keyframe(key, values, np.bincount(key, minlength=5))
    for k in range(5):
        mine = [v for at, v in rows if at == k]
        if mine:
            assert found[k] == pytest.approx(np.median(mine))
        else:
            assert np.isnan(found[k])


def test_inputs_are_the_means_of_what_stands_between_keyframes() -> None:
    time_s = np.arange(0, 6.001, 0.01)
    ones = np.ones(len(time_s))
    gap = np.zeros(len(time_s), bool)
    own = SensorTrack(0.3 * ones, -0.1 * ones, 0.4 * ones, 1 + 0.1 * time_s, gap)
    peer = SensorTrack(-0.2 * ones, 0.5 * ones, -0.3 * ones, 2 + 0.3 * time_s, gap)
    rng = np.random.default_rng(3)
    ranges_s = np.sort(rng.uniform(0, 6, 90))
    ranges_s = ranges_s[(ranges_s < 2) | (ranges_s > 2.35)]
    range_m = 2 + rng.normal(0, 0.1, len(ranges_s))
    shadow = (ranges_s > 3) & (ranges_s < 5)
    task = build_keyframes(Pair(time_s, own, peer, ranges_s, range_m + 1.0 * shadow), 10.0)
    assert task.range_offset_guess_m.any() and not task.range_offset_guess_m.all()
    noise = NoiseModel(range_std_m=0.2, yaw_rate_psd=1e-4)
    found = build_inputs([task, task], noise)
    count = len(task.keyframe_s)
    assert all(getattr(found, f.name).shape[:2] == (count, 2) for f in fields(FilterInputs))
    for k in range(count):
        mine = task.range_keyframe == k
        many = max(mine.sum(), 1)
        level = task.range_offset_guess_m[mine].sum() / many
        variance = SHADOWED_RANGE_STD_M**2 if level else 1.5 * 0.04 / many + 0.0025
        assert found.range_var[k] == pytest.approx(variance)
        if mine.any():
            left = task.range_m[mine] - task.range_offset_guess_m[mine]
            assert found.range_m[k] == pytest.approx(np.median(left))
            assert found.height_m[k] == pytest.approx(task.height_m[mine].mean())
            shift = task.own_to_range.shift_m[mine].mean(axis=0)
            assert found.own_to_range_m[k, 1] == pytest.approx(shift)
            shift = task.peer_to_range.shift_m[mine].mean(axis=0)
            assert found.peer_to_range_m[k, 0] == pytest.approx(shift)
        else:
            assert np.isnan(found.range_m[k]).all()
        if k < count - 1:
            assert found.step_s[k] == pytest.approx(task.steps_s[k])
            assert found.own_turn_rad[k] == pytest.approx(task.own.turn_rad[k])
            assert found.peer_turn_rad[k] == pytest.approx(task.peer.turn_rad[k])
            assert found.own_shift_m[k, 0] == pytest.approx(task.own.shift_m[k])
            assert found.peer_shift_m[k, 0] == pytest.approx(task.peer.shift_m[k])
            place = 2 * noise.velocity_psd * 0.1
            wanted = [place, place, 2 * 1e-4 * 0.1, 0, 0]
            assert found.step_var[k, 0] == pytest.approx(wanted)
    for last in (found.step_s, found.own_turn_rad, found.own_shift_m, found.step_var):
        assert not last[-1].any()
    twice = found.repeat(2, 7)
    assert twice.range_var.shape == (7, 4)
    assert (twice.own_shift_m[:, [0, 2]] == found.own_shift_m[:7, [0, 1]]).all()
