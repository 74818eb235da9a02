"""Solves of whole flights with detections, where ranges determine the bearing or do not."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.flight.data_association import resolve_conflicts
from dmrl.estimation.flight.pairs import estimate_pairs
from dmrl.estimation.model.pair import Pair
from dmrl.estimation.model.status import AMBIGUOUS, OK
from dmrl.estimation.solver.estimate import REASONS, Estimate
from dmrl.flight import NOISE, Flight, Scenario, Trajectory, simulate

from .flights import build_pair, compute_truth, simulate_flight
from .sighted_flights import compute_rmse, simulate_bearings

pytestmark = pytest.mark.heavy


def add_both_cameras(flight: Flight, wrong: float = 0.07) -> Pair:
    """Return the pair of a flight with simulated detections of both cameras."""
    mine, theirs = (
        simulate_bearings(flight, own, (peer,), wrong=wrong)
        for own, peer in (("cf1", "cf2"), ("cf2", "cf1"))
    )
    return replace(build_pair(flight), own_bearings=mine, peer_bearings=theirs)


def compute_rmse_m(found: Estimate, flight: Flight, own: str = "cf1", peer: str = "cf2") -> float:
    """Return the RMSE of an estimate, metres."""
    return compute_rmse(found.state[:, :2], compute_truth(flight, found.time_s, own, peer))


@pytest.mark.parametrize("trajectory", ["observer_static", "both_static", "parallel"])
def test_detections_resolve_bearing_without_motion(trajectory: Trajectory) -> None:
    flight = simulate_flight(trajectory, "calibrated", 3, 30.0)
    ((blind, _),) = estimate_pairs([build_pair(flight)])
    ((here, there),) = estimate_pairs([add_both_cameras(flight)])
    assert (blind.status == AMBIGUOUS).all()
    assert compute_rmse_m(here, flight) < 0.2 < compute_rmse_m(blind, flight)
    assert (here.status == OK).mean() > 0.5
    if trajectory == "both_static":
        # No camera shows the bearing of the observer from its peer, so it stays ambiguous.
        assert (there.status == AMBIGUOUS).all()
        assert REASONS["still"] in {cause.name for cause in there.causes}
    else:
        kept = there.status == OK
        error = there.state[:, :2] - compute_truth(flight, there.time_s, "cf2", "cf1")
        assert not kept.any() or np.hypot(*error[kept].T).max() < 0.4


def test_false_detections_do_not_degrade_a_solved_flight() -> None:
    flight = simulate_flight("in_view", "calibrated", 3, 60.0)
    ((blind, _),) = estimate_pairs([build_pair(flight)])
    for wrong in (0.07, 0.5):
        ((here, _),) = estimate_pairs([add_both_cameras(flight, wrong)])
        assert compute_rmse_m(here, flight) < 0.7 * compute_rmse_m(blind, flight)
    lost = simulate_bearings(flight, "cf1", (), wrong=0.5)
    ((here, _),) = estimate_pairs([replace(build_pair(flight), own_bearings=lost)])
    assert compute_rmse_m(here, flight) == pytest.approx(compute_rmse_m(blind, flight), abs=0.02)


def test_robot_at_rest_with_false_detections_stays_ambiguous() -> None:
    flight = simulate_flight("both_static", "calibrated", 3, 30.0)
    lost = simulate_bearings(flight, "cf1", (), wrong=0.5)
    ((here, there),) = estimate_pairs([replace(build_pair(flight), own_bearings=lost)])
    assert (here.status == AMBIGUOUS).all() and (there.status == AMBIGUOUS).all()
    assert {REASONS["still"], REASONS["open"]} & {cause.name for cause in here.causes}


def test_two_peers_at_rest_get_their_own_detections() -> None:
    """One camera sees both without names; their ranges tell which is which."""
    flight = simulate(Scenario(3, 30.0, "both_static"), NOISE["calibrated"], 5)
    sees = simulate_bearings(flight, "cf1", ("cf2", "cf3"))
    names = [("cf1", "cf2"), ("cf1", "cf3")]
    pairs = {both: replace(build_pair(flight, *both), own_bearings=sees) for both in names}
    for _ in range(2):
        found = dict(zip(names, estimate_pairs([pairs[n] for n in names]), strict=True))
        ways = {k: v for n in names for k, v in ((n, found[n][0]), (n[::-1], found[n][1]))}
        pairs |= resolve_conflicts(pairs, ways)
    for one, other in names:
        assert compute_rmse_m(found[one, other][0], flight, one, other) < 0.25
        assert (found[one, other][0].status == OK).mean() > 0.5


def test_swapping_the_robots_gives_the_same_solution() -> None:
    pair = add_both_cameras(simulate_flight("in_view", "calibrated", 4, 20.0))
    ((here, there),) = estimate_pairs([pair])
    ((back, forth),) = estimate_pairs([pair.swap_robots()])
    assert np.abs(here.state[:, :2] - forth.state[:, :2]).max() < 0.05
    assert np.abs(there.state[:, :2] - back.state[:, :2]).max() < 0.05
