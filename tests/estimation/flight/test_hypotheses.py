import numpy as np
import pytest

from dmrl.estimation.flight.hypotheses import (
    BEARING_COUNT,
    COST_SCALE,
    HEADING_COUNT,
    between_solution_covariance,
    flip_pass,
    is_same_state,
    mirror_guesses,
    range_circle_guesses,
    select_distinct_states,
)

HERE = np.zeros((4, 3))
THERE = np.tile([1.0, 0.0, 0.0], (4, 1))


def test_solutions_of_equal_cost_spread_by_half_their_distance_squared() -> None:
    found = between_solution_covariance(np.zeros(2), np.stack([HERE, THERE]))
    assert found[:, 0, 0] == pytest.approx(0.5)
    assert found[:, 1:, 1:] == pytest.approx(0.0)


def test_a_solution_counts_once_however_many_starts_lead_to_it() -> None:
    alike = np.stack([HERE, THERE, THERE + 0.01, HERE + 0.01])
    assert between_solution_covariance(np.zeros(4), alike)[0, 0, 0] == pytest.approx(0.5)


def test_a_costly_solution_hardly_counts() -> None:
    found = between_solution_covariance(np.array([0.0, 10 * COST_SCALE]), np.stack([HERE, THERE]))
    assert found.max() < 1e-3


def test_headings_differ_by_less_than_half_a_turn() -> None:
    turn = np.array([0.0, 0.0, 2 * np.pi])
    around, far = HERE + turn, THERE + turn
    assert between_solution_covariance(np.zeros(2), np.stack([HERE, far]))[
        :, 2, 2
    ] == pytest.approx(0.0)
    assert between_solution_covariance(
        np.zeros(2), np.stack([HERE, around])
    ).max() == pytest.approx(0.0)


def test_between_two_close_passes_the_peer_is_put_on_the_other_side() -> None:
    time_s = np.arange(0, 20, 0.1)
    state = np.zeros((len(time_s), 5))
    # Passes at 5 s and 15 s, 0.1 m off.
    state[:, 0], state[:, 1] = np.cos(np.pi * time_s / 10), 0.1
    (copy,) = mirror_guesses(state, 10.0)
    turned = np.flatnonzero((copy != state).any(axis=1))
    assert time_s[turned].min() == pytest.approx(5.0, abs=1.5)
    assert time_s[turned].max() == pytest.approx(15.0, abs=1.5)
    assert np.hypot(*copy[:, :2].T) == pytest.approx(np.hypot(*state[:, :2].T))


def test_the_shortest_ways_between_passes_are_mirrored_first() -> None:
    """A mirrored way that is long adds up more that odometry denies."""
    at_s = np.array([5.0, 15.0, 21.0, 29.0, 32.0, 40.0, 50.0])
    bends_s = np.sort([0.0, *at_s, *(at_s[1:] + at_s[:-1]) / 2, 55.0])
    time_s = np.arange(0, 55, 0.1)
    state = np.zeros((len(time_s), 6))
    state[:, 0] = np.interp(time_s, bends_s, np.resize([1.0, 0.0, -1.0, 0.0], len(bends_s)))
    state[:, 1] = 0.1
    changed = [time_s[(copy != state).any(axis=1)].min() for copy in mirror_guesses(state, 10.0)]
    assert changed == pytest.approx([29.0, 15.0, 21.0, 32.0], abs=1.0)


def test_without_close_passes_nothing_is_mirrored() -> None:
    far = np.tile([2.0, 0.0, 0.0, 0.0, 0.0], (200, 1))
    assert mirror_guesses(far, 10.0) == []


def test_a_pass_is_tried_on_the_other_side_and_the_rest_of_the_flight_stays() -> None:
    time_s = np.arange(0, 20, 0.1)
    state = np.zeros((len(time_s), 6))
    state[:, 0], state[:, 1] = 0.5 * (time_s - 10), 0.2  # straight past, 0.2 m to the left
    (copy,) = flip_pass(state, 10.0)
    nearest = int(np.argmin(np.abs(time_s - 10)))
    assert copy[nearest, :2] == pytest.approx([0.0, -0.2], abs=1e-9)
    moved = time_s[(copy != state).any(axis=1)]
    assert 8.5 < moved.min() < 9.5 and 10.5 < moved.max() < 11.5
    assert np.abs(np.diff(copy[:, 1])).max() < 0.1  # a way that can be flown


@pytest.mark.parametrize("at_s", [0.1, 0.0, 19.8, 19.9])
def test_a_pass_where_a_flight_begins_or_ends_is_tried_too(at_s: float) -> None:
    time_s = np.arange(0, 20, 0.1)
    state = np.zeros((len(time_s), 6))
    state[:, 0], state[:, 1] = 0.5 * (time_s - at_s), 0.2
    (copy,) = flip_pass(state, 10.0)
    nearest = int(np.argmin(np.abs(time_s - at_s)))
    assert copy[nearest, :2] == pytest.approx([0.0, -0.2], abs=1e-9)
    assert copy[:, 0] == pytest.approx(state[:, 0])  # aside of a way that is straight


def test_a_pass_half_a_second_before_the_end_is_mirrored() -> None:
    time_s = np.arange(0, 15.4, 0.1)
    state = np.zeros((len(time_s), 6))
    state[:, 0], state[:, 1] = np.cos(np.pi * time_s / 10), 0.1  # passes at 5 and 15 s
    (copy,) = mirror_guesses(state, 10.0)
    between = (time_s > 5.5) & (time_s < 14.5)
    assert copy[between, :2] == pytest.approx(state[between, :2] * [1.0, -1.0], abs=0.02)


def test_the_nearest_pass_is_tried_first_and_a_far_one_not_at_all() -> None:
    time_s = np.arange(0, 30, 0.1)
    state = np.zeros((len(time_s), 6))
    state[:, 0], state[:, 1] = 2 * np.cos(np.pi * time_s / 10), np.interp(time_s, [0, 30], [0.6, 0])
    copies = flip_pass(state, 10.0)  # passes at 5, 15 and 25 s, 0.5, 0.3 and 0.1 m off
    changed = [float(time_s[(copy != state).any(axis=1)].mean()) for copy in copies]
    assert [round(at / 5) * 5 for at in changed][:2] == [25, 15]
    assert flip_pass(np.tile([2.0, 0.0, 0.0, 0.0, 0.0, 0.0], (200, 1)), 10.0) == []


def test_starts_fill_the_circle_of_the_first_range() -> None:
    found = range_circle_guesses(2.0, 1.2)
    assert found.shape == (BEARING_COUNT * HEADING_COUNT, 3)
    assert np.hypot(*found[:, :2].T) == pytest.approx(1.6)
    bearing = np.arctan2(found[::HEADING_COUNT, 1], found[::HEADING_COUNT, 0])
    assert np.diff(np.unwrap(bearing)) == pytest.approx(2 * np.pi / BEARING_COUNT)
    for k in range(BEARING_COUNT):
        mine = found[k * HEADING_COUNT : (k + 1) * HEADING_COUNT, 2]
        first = np.pi / HEADING_COUNT * (k % 2)  # neighbours fill the space between
        assert mine == pytest.approx(first + 2 * np.pi / HEADING_COUNT * np.arange(HEADING_COUNT))
    assert np.hypot(*range_circle_guesses(1.0, 1.5)[0, :2]) == pytest.approx(0.05)


def test_states_are_alike_by_what_lies_between_them() -> None:
    far = np.array([5.0, -4.0, 2.0])
    assert is_same_state(far, far + np.array([0.3, 0.2, 0.4]))
    assert not is_same_state(far, -far)


def test_starts_that_differ_are_kept_best_first() -> None:
    near, turned, far = [0.3, 0.2, 0.4], [0.0, 0.0, 0.6], [0.41, 0.0, 0.0]
    states = np.array([[0.0, 0.0, 0.0], near, turned, far, [0.0, 0.0, 2 * np.pi - 0.1]])
    assert [is_same_state(states[0], other) for other in states[1:]] == [True, False, False, True]
    assert select_distinct_states(states, np.array([0, 1, 2, 3, 4]), 3) == [0, 2, 3]
    assert select_distinct_states(states, np.array([3, 2, 1, 0, 4]), 2) == [3, 2]
    assert select_distinct_states(states, np.array([0, 4]), 3) == [0, 0, 0]
