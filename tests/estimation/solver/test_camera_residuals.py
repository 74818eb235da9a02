"""What cameras saw in the solve: slopes, choice, weights, and what becomes of a solution."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.model.bearings import to_bearing
from dmrl.estimation.model.pair import Array, BearingMeasurements, Pair
from dmrl.estimation.solver.camera_residuals import (
    MIN_CONSISTENT_IMAGES,
    CameraMeasurements,
    keep_consistent_cameras,
    keyframes_with_agreement,
    linearize_camera,
    predict_bearings,
    select_associated,
)
from dmrl.estimation.solver.covariance import compute_covariance
from dmrl.estimation.solver.keyframes import GLOBALS, KeyframeProblem, NoiseModel, build_keyframes
from dmrl.estimation.solver.levenberg_marquardt import build_equations, solve
from dmrl.estimation.solver.residuals import STATE_SIZE, linearize
from dmrl.estimation.solver.robust_loss import total_cost

from ..flights import flown, pair_of
from ..sighted_flights import STD, sightings, still_pair

NOISE = NoiseModel()
NONE = np.zeros(len(GLOBALS))


@pytest.fixture(scope="module")
def flight() -> KeyframeProblem:
    """Ten seconds in which each sees the other, one of its images with two candidates."""
    made = flown("in_view", "calibrated", 1000, 10.0)
    pair = pair_of(made)
    mine, theirs = sightings(made, "cf1", ("cf2",)), sightings(made, "cf2", ("cf1",), wrong=0.5)
    return build_keyframes(replace(pair, own_bearings=mine, peer_bearings=theirs))


def looks(flight: KeyframeProblem) -> CameraMeasurements:
    assert flight.camera is not None
    return flight.camera


def beside(flight: KeyframeProblem, seed: int = 0) -> Array:
    """(K, 6) states that are no solution."""
    state = np.random.default_rng(seed).normal(0, 0.3, (len(flight.keyframe_s), STATE_SIZE))
    state[:, 0] += 2.0
    return state


def seen_at(bearing_rad: float, times_s: Array, distance_m: float = 2.0) -> BearingMeasurements:
    """One candidate in every image, always the same."""
    polar = np.tile([bearing_rad, 0.0, np.log(distance_m)], (len(times_s), 1, 1))
    return BearingMeasurements(times_s, polar, np.tile(STD, (len(times_s), 1, 1)))


def straight(pair: Pair, bearing_rad: float) -> Array:
    """(K, 6) states of a peer that stays where it is, two metres away."""
    state = np.zeros((len(build_keyframes(pair).keyframe_s), STATE_SIZE))
    state[:, :2] = 2 * np.cos(bearing_rad), 2 * np.sin(bearing_rad)
    return state


def test_both_cameras_are_there_and_each_sees_from_its_own_side(flight: KeyframeProblem) -> None:
    found = looks(flight)
    assert set(found.observer_sign) == {1.0, -1.0}
    assert (np.diff(found.time_s) >= 0).all()
    ahead_s = found.fraction * flight.steps_s[found.keyframe]
    assert flight.keyframe_s[found.keyframe] + ahead_s == pytest.approx(found.time_s)


def test_a_peer_ahead_sees_its_observer_behind_it() -> None:
    pair, _ = still_pair()
    both = replace(
        pair,
        own_bearings=seen_at(0.0, np.array([1.0])),
        peer_bearings=seen_at(0.0, np.array([2.0])),
    )
    state = straight(pair, 0.3)
    state[:, 2] = 0.5
    polar, _ = predict_bearings(looks(build_keyframes(both)), state)
    assert polar[0] == pytest.approx([0.3, 0.0, np.log(2)])
    # Seen from the peer, whose heading is 0.5, the observer lies back along the line.
    assert np.exp(1j * polar[1, 0]) == pytest.approx(np.exp(1j * (0.3 + np.pi - 0.5)))


def test_expectations_are_the_truth_where_the_states_are() -> None:
    made = flown("in_view", "ideal", 1001, 10.0)
    pair = replace(pair_of(made), own_bearings=sightings(made, "cf1", ("cf2",), wrong=0.0))
    task = build_keyframes(pair)
    state = np.zeros((len(task.keyframe_s), STATE_SIZE))
    state[:, :2] = made.peer_in_horizontal("cf1", "cf2", task.keyframe_s)[:, :2]
    yaws = [made.truth[name].yaw_at(task.keyframe_s) for name in ("cf1", "cf2")]
    state[:, 2] = yaws[1] - yaws[0]
    polar, _ = predict_bearings(looks(task), state)
    true = to_bearing(made.peer_in_horizontal("cf1", "cf2", looks(task).time_s))
    assert np.abs(polar - true).max() < 0.01
    assert (linearize_camera(looks(task), state).squared_distance < 25).all()


def test_slopes_are_those_of_finite_differences(flight: KeyframeProblem) -> None:
    state, step = beside(flight), 1e-6
    _, slope = predict_bearings(looks(flight), state)
    for column in range(3):
        change = np.zeros_like(state)
        change[:, column] = step
        ahead, behind = (predict_bearings(looks(flight), state + s * change)[0] for s in (1, -1))
        assert slope[:, :, column] == pytest.approx((ahead - behind) / (2 * step), abs=1e-5)


def test_the_normal_equations_have_the_slope_of_the_cost(flight: KeyframeProblem) -> None:
    state = beside(flight)
    # Beyond three sigmas elevations and distances have no slope, so they are given wide ones.
    one_each = select_associated(looks(flight), state)
    task = replace(flight, camera=replace(one_each, std=one_each.std * [1, 100, 100]))
    equations = build_equations(task, NOISE, linearize(task, NOISE, state, NONE), NONE)
    without = replace(task, camera=None)
    plain = build_equations(without, NOISE, linearize(without, NOISE, state, NONE), NONE)
    way = np.random.default_rng(1).normal(size=state.shape) * [1, 1, 1, 0, 0, 0]
    ends = [
        total_cost(linearize(t, NOISE, state + s * 1e-6 * way, NONE), NOISE, NONE)
        for t in (task, without)
        for s in (1, -1)
    ]
    slope = (ends[0] - ends[1] - ends[2] + ends[3]) / 2e-6
    found = ((equations.gradient - plain.gradient) * way).sum()
    assert abs(slope) > 1.0
    assert found == pytest.approx(slope, rel=1e-3)


def test_the_nearest_candidate_of_an_image_counts() -> None:
    pair, _ = still_pair()
    one, other = seen_at(0.05, np.array([4.0])), seen_at(-0.6, np.array([4.0]))
    both = BearingMeasurements(
        one.time_s,
        np.concatenate([other.bearing, one.bearing], axis=1),
        np.concatenate([other.std, one.std], axis=1),
    )
    found = looks(build_keyframes(replace(pair, own_bearings=both)))
    for bearing_rad, off in ((0.0, 0.05 / STD[0]), (-0.6, 0.0)):
        rows = linearize_camera(found, straight(pair, bearing_rad)).rows
        assert rows[0, 0, 3] == pytest.approx(off)


def test_what_is_far_off_pulls_no_more_and_costs_the_same_wherever_it_is() -> None:
    pair, _ = still_pair()
    found = looks(build_keyframes(replace(pair, own_bearings=seen_at(0.0, np.array([4.0])))))
    far, farther, near = (
        linearize_camera(found, straight(pair, angle)) for angle in (0.5, 1.5, 0.2)
    )
    assert not far.rows.any() and near.rows.any()
    assert far.squared_distance == pytest.approx(farther.squared_distance)
    assert near.squared_distance < far.squared_distance
    task = build_keyframes(replace(pair, own_bearings=seen_at(0.0, np.arange(1, 9, 0.2))))
    kept = keep_consistent_cameras(looks(task), straight(pair, 0.0))
    assert kept is not None and len(kept.time_s) == 40
    mixed = np.where(np.arange(40) % 2 == 0, 0.0, 1.0)
    sees = seen_at(0.0, np.arange(1, 9, 0.2))
    sees.bearing[:, 0, 0] = mixed
    kept = keep_consistent_cameras(
        looks(build_keyframes(replace(pair, own_bearings=sees))), straight(pair, 0.0)
    )
    assert kept is not None and (kept.bearing[..., 0] == 0.0).all() and len(kept.time_s) == 20


def test_azimuths_are_compared_the_short_way() -> None:
    pair, _ = still_pair()
    found = looks(build_keyframes(replace(pair, own_bearings=seen_at(3.1, np.array([4.0])))))
    off = linearize_camera(found, straight(pair, -3.1)).rows[0, 0, 3]
    assert off == pytest.approx((6.2 - 2 * np.pi) / STD[0])


def test_images_at_once_count_as_one_and_lasting_errors_once_a_flight() -> None:
    pair, _ = still_pair()
    dense = looks(build_keyframes(replace(pair, own_bearings=seen_at(0.0, np.arange(1, 9, 0.01)))))
    rare = looks(build_keyframes(replace(pair, own_bearings=seen_at(0.0, np.arange(1, 9, 1.0)))))
    assert rare.weight == pytest.approx(1.0)
    assert dense.weight[400] == pytest.approx(1 / 30, rel=0.1)
    for found in (dense, rare):
        assert (found.weight * found.correlated_weight).sum() == pytest.approx(1.0)


def test_images_outside_the_flight_are_left_out() -> None:
    pair, _ = still_pair()
    found = looks(
        build_keyframes(replace(pair, own_bearings=seen_at(0.0, np.array([-1.0, 5.0, 11.0]))))
    )
    assert found.time_s.tolist() == [5.0]
    assert (
        build_keyframes(replace(pair, own_bearings=seen_at(0.0, np.array([-1.0])))).camera is None
    )


def test_a_bearing_that_was_seen_is_the_solution_s_and_its_error_its_sigma() -> None:
    """Nothing moves, so ranges leave the bearing open."""
    pair, where = still_pair(0.4)
    start = straight(pair, 0.2)
    times_s = np.arange(0.5, 9.5, 0.5)
    task = build_keyframes(replace(pair, own_bearings=seen_at(0.4, times_s)))
    found = solve(task, NOISE, start)
    assert np.abs(found.state[:, :2] - where).max() < 0.02
    spread = compute_covariance(task, NOISE, found)[0][50, :2, :2]
    across = np.array([-np.sin(0.4), np.cos(0.4)])
    sigma_rad = np.sqrt(across @ spread @ across) / 2
    # All images may share an error of one, so eighteen tell hardly more than one does.
    assert STD[0] < sigma_rad < 1.4 * STD[0]
    blind = build_keyframes(pair)
    alone = compute_covariance(blind, NOISE, solve(blind, NOISE, start))[0][50, :2, :2]
    assert across @ alone @ across > 100 * across @ spread @ across


def test_wrong_ones_hardly_pull() -> None:
    pair, where = still_pair(0.4)
    right, wrong = seen_at(0.4, np.arange(0.5, 9.5, 1.0)), seen_at(-0.3, np.arange(0.9, 9.5, 1.0))
    order = np.argsort(np.concatenate([right.time_s, wrong.time_s]))
    half = BearingMeasurements(
        *(
            np.concatenate([getattr(right, name), getattr(wrong, name)])[order]
            for name in ("time_s", "bearing", "std")
        )
    )
    found = solve(build_keyframes(replace(pair, own_bearings=half)), NOISE, straight(pair, 0.35))
    off_m = np.hypot(*(found.state[:, :2] - where).T)
    assert np.median(off_m) < 0.25 * STD[0] * 2 and off_m.max() < 1.5 * STD[0] * 2


def test_a_camera_that_mostly_disagrees_is_not_trusted() -> None:
    pair, _ = still_pair()
    times_s = np.arange(1, 9, 0.2)
    task = build_keyframes(
        replace(pair, own_bearings=seen_at(0.0, times_s), peer_bearings=seen_at(1.0, times_s))
    )
    kept = keep_consistent_cameras(looks(task), straight(pair, 0.0))
    assert kept is not None
    assert (kept.observer_sign == 1).all() and len(kept.time_s) == len(times_s)
    assert keep_consistent_cameras(looks(task), straight(pair, 2.0)) is None
    few = build_keyframes(
        replace(pair, own_bearings=seen_at(0.0, times_s[: MIN_CONSISTENT_IMAGES - 1]))
    )
    assert keep_consistent_cameras(looks(few), straight(pair, 0.0)) is None
    assert keep_consistent_cameras(None, straight(pair, 0.0)) is None


def test_keyframes_near_an_image_that_agrees_are_told_by_camera() -> None:
    pair, _ = still_pair()
    sees = seen_at(0.0, np.array([2.0, 6.0]))
    task = build_keyframes(replace(pair, own_bearings=sees))
    at = keyframes_with_agreement(task.camera, straight(pair, 0.0), 1, task.keyframe_s, 0.5)
    assert task.keyframe_s[at] == pytest.approx(
        [*np.arange(1.5, 2.55, 0.1), *np.arange(5.5, 6.55, 0.1)]
    )
    assert not keyframes_with_agreement(
        task.camera, straight(pair, 0.0), -1, task.keyframe_s, 0.5
    ).any()
    assert not keyframes_with_agreement(
        task.camera, straight(pair, 1.0), 1, task.keyframe_s, 0.5
    ).any()
    assert not keyframes_with_agreement(None, straight(pair, 0.0), 1, task.keyframe_s, 0.5).any()
