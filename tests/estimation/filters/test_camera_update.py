"""What cameras saw, in the filters that tell starts apart."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.filters import keyframe_ekf
from dmrl.estimation.filters.camera_update import (
    KEYFRAME_OFFSET_STD,
    CameraUpdate,
    camera_updates,
    repeat_updates,
    update_with_camera,
)
from dmrl.estimation.filters.keyframe_ekf import STATE_SIZE, build_inputs
from dmrl.estimation.flight.hypotheses import select_guesses
from dmrl.estimation.model.pair import Array, BearingMeasurements
from dmrl.estimation.solver.keyframes import NoiseModel, build_keyframes

from ..sighted_flights import STD, still_pair

BEARING_RAD = 0.7


def glance(side: float, *bearings_rad: float) -> CameraUpdate:
    polar = np.array([[bearing, 0.0, np.log(2.0)] for bearing in bearings_rad])
    return CameraUpdate(0, side, polar, np.tile(STD, (len(polar), 1)), 0)


def filters(*poses: tuple[float, float]) -> tuple[Array, Array]:
    """States two metres away by bearing and heading, and their covariances."""
    state = np.zeros((len(poses), STATE_SIZE))
    for k, (bearing, heading) in enumerate(poses):
        state[k, :3] = 2 * np.cos(bearing), 2 * np.sin(bearing), heading
    return state, np.tile(np.diag([0.04, 0.04, 0.04, 1e-4, 1e-4]), (len(poses), 1, 1))


def test_a_near_candidate_moves_a_filter_and_a_far_one_only_its_likelihood() -> None:
    state, covariance = filters((0.1, 0.0), (2.5, 0.0), (0.0, 0.0))
    before, likely = state.copy(), np.zeros(3)
    update_with_camera(state, covariance, np.zeros(3), glance(1.0, 0.0, -1.2), likely)
    bearing = np.arctan2(state[:, 1], state[:, 0])
    assert abs(bearing[0]) < 0.1 * 0.1
    assert (state[1] == before[1]).all()
    assert covariance[1] == pytest.approx(np.diag([0.04, 0.04, 0.04, 1e-4, 1e-4]))
    assert covariance[0, 1, 1] < 0.1 * 0.04
    assert likely[2] > likely[0] > likely[1] + 2


def test_the_peer_s_camera_tells_its_heading() -> None:
    # From the peer, which looks back at the observer: a heading of pi.
    state, covariance = filters((0.0, np.pi - 0.1))
    update_with_camera(state, covariance, np.zeros(1), glance(-1.0, 0.0), np.zeros(1))
    seen_at = np.angle(np.exp(1j * (np.arctan2(-state[0, 1], -state[0, 0]) - state[0, 2])))
    assert abs(seen_at) < 0.03
    assert abs(state[0, 2] - np.pi) < 0.06


def test_few_images_are_looked_at_each_at_the_keyframe_next_to_it() -> None:
    pair, _ = still_pair()
    times_s = np.arange(0.08, 10, 0.25)
    polar = np.tile([0.2, 0.0, 0.0], (len(times_s), 1, 1))
    sees = BearingMeasurements(times_s, polar, np.tile(STD, (len(times_s), 1, 1)))
    looks = build_keyframes(replace(pair, own_bearings=sees)).camera
    found = [one for here in camera_updates([None, looks]).values() for one in here]
    assert len(found) == 20
    assert all(one.first_filter == 1 and one.bearing[0, 0] == pytest.approx(0.2) for one in found)
    assert [one.keyframe for one in found[:3]] == [1, 6, 11]
    # Heights are known to 4 cm, and the robots are a metre apart.
    assert found[0].std[0] == pytest.approx(np.hypot([0.02, 0.05, 0.1], KEYFRAME_OFFSET_STD))
    many = repeat_updates(camera_updates([None, looks]), 6)
    assert all((one.first_filter, one.copies) == (6, 6) for here in many.values() for one in here)


def test_starts_are_where_something_was_seen() -> None:
    pair, where = still_pair(BEARING_RAD)
    times_s = np.arange(0.5, 9.5, 0.5)
    polar = np.tile([BEARING_RAD, 0.0, np.log(2.0)], (len(times_s), 1, 1))
    sees = BearingMeasurements(times_s, polar, np.tile(STD, (len(times_s), 1, 1)))
    # A second pair, blind, stands before it, so that filters must find theirs.
    flights = [build_keyframes(pair), build_keyframes(replace(pair, own_bearings=sees))]
    inputs = build_inputs(flights, NoiseModel())
    glances = camera_updates([flight.camera for flight in flights])
    blind, seeing = select_guesses(inputs, 10.0, glances)
    assert np.hypot(*(seeing[0, :2] - where)) < 0.6
    plain = select_guesses(inputs, 10.0)
    assert (plain[0] == blind).all() and (plain[1] == blind).all()
    run = keyframe_ekf.run_filters(
        inputs.repeat(6, 100),
        np.concatenate([blind, seeing]),
        np.full(STATE_SIZE, 0.3),
        repeat_updates(glances, 6),
    )
    assert np.hypot(*(run.state[-1, 6, :2] - where)) < 0.1
