"""Solves of whole flights with detections, with and without enough information in the ranges."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.flight.data_association import resolve_conflicts
from dmrl.estimation.flight.pairs import estimate_pairs
from dmrl.estimation.model.pair import Pair
from dmrl.estimation.model.status import AMBIGUOUS, OK
from dmrl.estimation.solver.estimate import REASONS, Estimate
from dmrl.flight import NOISE, Flight, Scenario, Trajectory, simulate

from .flights import flown, pair_of, truth_at
from .sighted_flights import rmse, sightings

pytestmark = pytest.mark.heavy


def looking(flight: Flight, wrong: float = 0.07) -> Pair:
    """A pair whose cameras both see."""
    mine, theirs = (
        sightings(flight, own, (peer,), wrong=wrong)
        for own, peer in (("cf1", "cf2"), ("cf2", "cf1"))
    )
    return replace(pair_of(flight), own_bearings=mine, peer_bearings=theirs)


def off_m(found: Estimate, flight: Flight, own: str = "cf1", peer: str = "cf2") -> float:
    return rmse(found.state[:, :2], truth_at(flight, found.time_s, own, peer))


@pytest.mark.parametrize("trajectory", ["observer_static", "both_static", "parallel"])
def test_detections_resolve_bearing_without_motion(trajectory: Trajectory) -> None:
    flight = flown(trajectory, "calibrated", 3, 30.0)
    ((blind, _),) = estimate_pairs([pair_of(flight)])
    ((here, there),) = estimate_pairs([looking(flight)])
    assert (blind.status == AMBIGUOUS).all()
    assert off_m(here, flight) < 0.2 < off_m(blind, flight)
    assert (here.status == OK).mean() > 0.5
    if trajectory == "both_static":
        # Nobody sees how the observer stands before its peer, so that stays open.
        assert (there.status == AMBIGUOUS).all()
        assert REASONS["still"] in {cause.name for cause in there.causes}
    else:
        kept = there.status == OK
        error = there.state[:, :2] - truth_at(flight, there.time_s, "cf2", "cf1")
        assert not kept.any() or np.hypot(*error[kept].T).max() < 0.4


def test_false_detections_do_not_degrade_a_solved_flight() -> None:
    flight = flown("in_view", "calibrated", 3, 60.0)
    ((blind, _),) = estimate_pairs([pair_of(flight)])
    for wrong in (0.07, 0.5):
        ((here, _),) = estimate_pairs([looking(flight, wrong)])
        assert off_m(here, flight) < 0.7 * off_m(blind, flight)
    lost = sightings(flight, "cf1", (), wrong=0.5)
    ((here, _),) = estimate_pairs([replace(pair_of(flight), own_bearings=lost)])
    assert off_m(here, flight) == pytest.approx(off_m(blind, flight), abs=0.02)


def test_robot_at_rest_with_false_detections_stays_ambiguous() -> None:
    flight = flown("both_static", "calibrated", 3, 30.0)
    lost = sightings(flight, "cf1", (), wrong=0.5)
    ((here, there),) = estimate_pairs([replace(pair_of(flight), own_bearings=lost)])
    assert (here.status == AMBIGUOUS).all() and (there.status == AMBIGUOUS).all()
    assert {REASONS["still"], REASONS["open"]} & {cause.name for cause in here.causes}


def test_two_peers_at_rest_get_their_own_detections() -> None:
    """One camera sees both, nobody says who is who; the ranges do."""
    flight = simulate(Scenario(3, 30.0, "both_static"), NOISE["calibrated"], 5)
    sees = sightings(flight, "cf1", ("cf2", "cf3"))
    names = [("cf1", "cf2"), ("cf1", "cf3")]
    pairs = {both: replace(pair_of(flight, *both), own_bearings=sees) for both in names}
    for _ in range(2):
        found = dict(zip(names, estimate_pairs([pairs[n] for n in names]), strict=True))
        ways = {k: v for n in names for k, v in ((n, found[n][0]), (n[::-1], found[n][1]))}
        pairs |= resolve_conflicts(pairs, ways)
    for one, other in names:
        assert off_m(found[one, other][0], flight, one, other) < 0.25
        assert (found[one, other][0].status == OK).mean() > 0.5


def test_swapping_the_robots_gives_the_same_solution() -> None:
    pair = looking(flown("in_view", "calibrated", 4, 20.0))
    ((here, there),) = estimate_pairs([pair])
    ((back, forth),) = estimate_pairs([pair.swap_robots()])
    assert np.abs(here.state[:, :2] - forth.state[:, :2]).max() < 0.05
    assert np.abs(there.state[:, :2] - back.state[:, :2]).max() < 0.05
