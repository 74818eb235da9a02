"""Starts of a solve: with ranges as they are, or as they would be if they were too short."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.flight import initial_guesses
from dmrl.estimation.flight.initial_guesses import (
    CLOSE_RANGE_M,
    MIN_LIKELIHOOD_GAIN,
    SHORT_RANGE_M,
    InitialGuesses,
    find_initial_guesses,
)
from dmrl.estimation.flight.pairs import estimate_pairs
from dmrl.estimation.solver.keyframes import KeyframeProblem, NoiseModel, build_keyframes

from ..flights import flown, pair_of, truth_at


def ranging(*ranges_m: float) -> KeyframeProblem:
    """A flight whose ranges begin with these, and are long afterwards."""
    flight = build_keyframes(pair_of(flown("in_view", "ideal", 1000, 1.0)))
    range_m = np.full(len(flight.range_m), 3.0)
    range_m[: len(ranges_m)] = ranges_m
    return replace(flight, range_m=range_m)


def likelier_by(gain: float, asked: list[float]) -> object:
    """Starts that are so much likelier with longer ranges. Adds what was asked for first ranges."""

    def made(flights: Sequence[KeyframeProblem], _: NoiseModel) -> list[InitialGuesses]:
        firsts = [float(flight.range_m[0]) for flight in flights]
        asked.extend(firsts)
        return [
            InitialGuesses(
                np.array([0.0, gain * (first > SHORT_RANGE_M)]), np.zeros((1, 2, 5)), np.zeros(0)
            )
            for first in firsts
        ]

    return made


@pytest.mark.parametrize(
    ("gain", "offset_m"),
    [(MIN_LIKELIHOOD_GAIN - 1, 0.0), (MIN_LIKELIHOOD_GAIN + 1, -SHORT_RANGE_M)],
)
def test_longer_ranges_are_believed_if_the_flight_is_clearly_likelier(
    monkeypatch: pytest.MonkeyPatch, gain: float, offset_m: float
) -> None:
    monkeypatch.setattr(initial_guesses, "_smooth_guesses", likelier_by(gain, []))
    (found,) = find_initial_guesses([ranging(*[0.1] * 20)], NoiseModel())
    assert found.range_offset_m == offset_m
    assert found.score.max() == (gain if offset_m else 0.0)


def test_they_are_tried_where_robots_come_close_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []
    monkeypatch.setattr(initial_guesses, "_smooth_guesses", likelier_by(0.0, asked))
    far, near = ranging(*[CLOSE_RANGE_M + 0.1] * 20), ranging(*[CLOSE_RANGE_M - 0.1] * 20)
    none = replace(far, range_m=far.range_m[:0] + 0.0)
    find_initial_guesses([far, near], NoiseModel())
    assert asked == pytest.approx(
        [CLOSE_RANGE_M + 0.1, CLOSE_RANGE_M - 0.1, CLOSE_RANGE_M - 0.1 + SHORT_RANGE_M]
    )
    assert not initial_guesses._has_close_pass(none)


@pytest.mark.heavy
def test_ranges_that_are_too_short_lead_no_solve_round_the_observer() -> None:
    """Its ranges are 0.38 m too short; without longer ones the peer goes round twice."""
    flight = flown("in_view", "harsh", 12012, 100.0)
    ((found, _),) = estimate_pairs([pair_of(flight)])
    true = truth_at(flight, found.time_s)
    bearings = [np.unwrap(np.arctan2(xy[:, 1], xy[:, 0])) for xy in (found.state, true)]
    turned = bearings[0] - bearings[1]
    assert abs(turned - turned[0]).max() < np.pi
