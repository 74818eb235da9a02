"""Where a flight's solve may end: what sticks is solved afresh."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.flight import multi_start
from dmrl.estimation.flight.initial_guesses import InitialGuesses
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.keyframes import GLOBALS, KeyframeProblem, NoiseModel, build_keyframes
from dmrl.estimation.solver.levenberg_marquardt import MapEstimate
from dmrl.estimation.solver.residuals import RANGE_BIAS, RANGE_ERROR, STATE_SIZE

from ..flights import flown, pair_of


def solution(x_m: float, cost: float, error_m: float = 0.0) -> MapEstimate:
    """A peer that stands ten metres and more in front for a second, ranges so much too long."""
    state = np.zeros((11, STATE_SIZE))
    state[:, 0], state[:, RANGE_ERROR] = 10.0 + x_m, error_m
    return MapEstimate(state, np.zeros(len(GLOBALS)), cost)


def smoothed(score: Array, tracks: Array) -> InitialGuesses:
    """Starts (S, K, 5) with their scores."""
    return InitialGuesses(score, tracks.swapaxes(0, 1), np.zeros(0))


def flight() -> KeyframeProblem:
    return build_keyframes(pair_of(flown("in_view", "ideal", 1000, 1.0)))


def test_solutions_are_told_apart_by_place_and_left_out_by_cost() -> None:
    found = [solution(1.0, 9.0), solution(0.0, 5.0), solution(0.01, 5.1), solution(2.0, 30.0)]
    assert [s.cost for s in multi_start.select_distinct(found, 10.0)] == [5.0, 9.0]
    assert [s.cost for s in multi_start.select_distinct(found, 1.0)] == [5.0]
    assert [s.cost for s in multi_start.select_distinct(found, 100.0)] == [5.0, 9.0, 30.0]


def test_what_sticks_above_the_best_is_solved_afresh(monkeypatch: pytest.MonkeyPatch) -> None:
    def stuck(
        _: KeyframeProblem, __: NoiseModel, state: Array, *given: object, **named: object
    ) -> MapEstimate:
        """Comes to the true one from x = 3 only, and only without constants and range errors."""
        begun, place = bool(given), round(float(state[0, 0]) - 10.0)
        if place == 3 and not begun and not state[:, RANGE_ERROR].any():
            return solution(4.0, 1.0)
        return solution(place, 50.0 - 10.0 * (place == 2), error_m=0.2)

    monkeypatch.setattr(multi_start, "solve", stuck)
    short = flight()
    level = replace(short, range_offset_guess_m=np.zeros(len(short.range_m)))
    tracks = np.stack([solution(x, 0.0).state[:, :5] for x in (2.0, 3.0)])
    best = multi_start.find_solutions(level, NoiseModel(), smoothed(np.zeros(2), tracks), [])[0]
    assert best.cost == 1.0


def test_of_a_flight_in_stretches_their_join_and_the_two_likeliest_starts_are_solved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begun: list[int] = []

    def solved(
        _: KeyframeProblem, __: NoiseModel, state: Array, *___: object, **____: object
    ) -> MapEstimate:
        begun.append(round(float(state[0, 0]) - 10.0))
        return solution(begun[-1], 10.0 * begun[-1])

    monkeypatch.setattr(multi_start, "solve", solved)
    tracks = np.stack([solution(x, 0.0).state[:, :5] for x in (5.0, 6.0, 7.0)])
    joined = [solution(1.0, 0.0).state]
    found = multi_start.find_solutions(
        flight(), NoiseModel(), smoothed(np.array([3.0, 1.0, 2.0]), tracks), joined
    )
    assert begun == [1, 5, 7, 1]  # and the best again, afresh
    assert (found[0].cost, round(float(found[0].state[0, 0]))) == (10.0, 11)


def test_other_sides_are_tried_six_times_and_from_the_best_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The third try is better: what passes there is tried next, three times more.

    The first is better by less than what counts: noise of a solve that ended early.
    """
    begun: list[float] = []

    def passes(state: Array, _: float) -> list[Array]:
        return [solution(10 * (state[0, 0] - 10.0) + step, 0.0).state for step in range(1, 10)]

    def solved(_: KeyframeProblem, __: NoiseModel, state: Array, *___: object) -> MapEstimate:
        begun.append(round(float(state[0, 0]) - 10.0))
        return solution(begun[-1], {1: 49.8, 3: 20.0}.get(len(begun), 60.0))

    monkeypatch.setattr(multi_start, "flip_pass", passes)
    monkeypatch.setattr(multi_start, "solve", solved)
    found = multi_start._flip_passes(
        flight(), NoiseModel(), [solution(0.0, 50.0), solution(30.0, 70.0)]
    )
    assert begun == [1, 2, 3, 31, 32, 33]
    assert len(found) == 2 + 6 and min(s.cost for s in found) == 20.0


def test_a_start_with_longer_ranges_is_solved_from_their_offset(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    offsets: list[float] = []

    def solved(
        _: KeyframeProblem, __: NoiseModel, state: Array, *given: Array, **____: object
    ) -> MapEstimate:
        offsets.append(float(given[0][RANGE_BIAS]) if given else 0.0)
        return solution(float(state[0, 0]) - 10.0, 1.0)

    monkeypatch.setattr(multi_start, "solve", solved)
    start = smoothed(np.zeros(1), solution(5.0, 0.0).state[None, :, :5])
    multi_start.find_solutions(flight(), NoiseModel(), replace(start, range_offset_m=-0.4), [])
    assert offsets[0] == -0.4
