"""Hypotheses on the range circle, from several starts."""

import numpy as np
import pytest

from dmrl.estimation.search.hypotheses import (
    KEPT_HYPOTHESES,
    choose_starts,
    follow_hypotheses,
    range_circle,
    select_distinct_states,
)
from dmrl.estimation.search.pair_filter import HYPOTHESIS_STD
from dmrl.estimation.solver.keyframes import build_problem

from ..flights import build_pair, compute_truth, simulate_flight


def test_hypotheses_cover_the_range_circle() -> None:
    found = range_circle(2.0, 1.0)
    assert found.shape == (96, 3)
    assert np.hypot(*found.T[:2]) == pytest.approx(np.sqrt(3))
    rng = np.random.default_rng(0)
    for bearing, heading in rng.uniform(0, 2 * np.pi, (200, 2)):
        turn = np.angle(np.exp(1j * (found[:, 2] - heading))) / HYPOTHESIS_STD[2]
        around = np.angle(np.exp(1j * (np.arctan2(found[:, 1], found[:, 0]) - bearing))) / 0.35
        assert np.hypot(turn, around).min() < 1.3
    assert np.hypot(*range_circle(0.3, 1.0)[0, :2]) == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("length_s", "starts_s"),
    [(10, [0]), (24.8, [0]), (50, [0, 25]), (100, [0, 25, 50, 75]), (200, [0, 50, 100, 150])],
)
def test_starts_include_times_in_mid_flight(length_s: float, starts_s: list[float]) -> None:
    key_s = 7 + np.arange(0, length_s + 0.01, 0.2)
    assert key_s[choose_starts(key_s)] - 7 == pytest.approx(starts_s, abs=0.21)


def test_states_are_compared_at_both_ends_modulo_full_turns() -> None:
    states = np.zeros((2, 4, 3))
    states[0, 1], states[1, 2] = [0.5, 0, 0], [0, 0, 0.6]
    order = np.array([0, 3, 1, 2])
    assert select_distinct_states(states, order, 3) == [0, 1, 2]
    assert select_distinct_states(states, order, 4) == [0, 1, 2, 2]
    turned = np.zeros((1, 2, 3))
    turned[0, 1, 2] = 2 * np.pi
    assert select_distinct_states(turned, np.arange(2), 2) == [0, 0]


@pytest.mark.heavy
def test_most_likely_track_is_near_the_truth() -> None:
    flight = simulate_flight("random", "calibrated", 1001, 60.0)
    problem = build_problem({(0, 1): build_pair(flight)})
    tracks = follow_hypotheses(problem)
    assert len(tracks) == 2 * KEPT_HYPOTHESES
    true = compute_truth(flight, problem.keyframe_s)
    assert [t.score for t in tracks] == sorted((t.score for t in tracks), reverse=True)
    error = np.hypot(*(tracks[0].pose[:, :2] - true).T)
    assert np.median(error) < 0.3
    assert len(tracks[0].log_likelihood) == len(true)
    longer = follow_hypotheses(problem, -0.4)
    assert longer[0].range_excess_m == -0.4
    assert np.hypot(*longer[0].pose[0, :2]) > np.hypot(*tracks[0].pose[0, :2])
