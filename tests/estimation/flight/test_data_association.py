"""Conflicts between two peers over the detections of one camera."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.flight.data_association import resolve_conflicts
from dmrl.estimation.model.bearings import (
    associate,
    bearing_variance,
    drop_candidates,
    to_bearing,
)
from dmrl.estimation.model.pair import Array, BearingMeasurements, Pair
from dmrl.estimation.model.status import OK
from dmrl.estimation.solver.estimate import PAIR_LAYOUT, Estimate, seen_from_peer
from dmrl.estimation.solver.problem import NoiseModel

from ..sighted_flights import STD, build_still_pair

TIMES_S = np.arange(0.5, 9.5, 0.5)
LEFT, RIGHT = 0.5, -0.5
Names = tuple[str, str]


def build_candidates(*bearings_rad: float) -> BearingMeasurements:
    """Return images that all show candidates at these bearings, two metres away."""
    polar = [[bearing, 0.0, np.log(2.0)] for bearing in bearings_rad]
    shape = len(TIMES_S), 1, 1
    return BearingMeasurements(
        TIMES_S, np.tile(polar, shape), np.tile(STD, (len(TIMES_S), len(polar), 1))
    )


def build_estimate(bearing_rad: float, sigma_m: float = 0.1) -> Estimate:
    """Return an estimate of a peer at rest, two metres away at this bearing."""
    pair, where = build_still_pair(bearing_rad)
    state = np.zeros((101, 3))
    state[:, :2] = where
    covariance = np.tile(sigma_m**2 * np.eye(3), (101, 1, 1))
    status = np.full(101, OK, np.int8)
    time_s = np.linspace(pair.time_s[0], pair.time_s[-1], 101)
    constants = np.zeros(len(PAIR_LAYOUT.constants))
    return Estimate(time_s, state, covariance, status, constants, NoiseModel())


def add_reversed(found: dict[Names, Estimate]) -> dict[Names, Estimate]:
    """Add the estimates seen from the peers."""
    return found | {names[::-1]: seen_from_peer(one) for names, one in found.items()}


def build_pairs(sees: BearingMeasurements) -> dict[Names, Pair]:
    """Return two pairs of robot a at rest, which share the images of its camera."""
    pair, _ = build_still_pair()
    return {
        ("a", "b"): replace(pair, own_bearings=sees),
        ("a", "c"): replace(pair, own_bearings=sees),
    }


def list_bearings(sees: BearingMeasurements | None) -> Array:
    """Return the distinct bearings of all candidates, radians."""
    assert sees is not None
    return np.unique(sees.bearing[np.isfinite(sees.bearing[..., 0]), 0])


def test_conflicting_pair_is_resolved_without_shared_candidates() -> None:
    pairs = build_pairs(build_candidates(LEFT, RIGHT))
    found = add_reversed(
        {("a", "b"): build_estimate(LEFT), ("a", "c"): build_estimate(LEFT - 0.08)}
    )
    (again,) = resolve_conflicts(pairs, found).items()
    assert again[0] == ("a", "c")
    assert list_bearings(again[1].own_bearings) == pytest.approx([RIGHT])
    assert list_bearings(pairs["a", "c"].own_bearings) == pytest.approx([RIGHT, LEFT])


def test_less_certain_pair_loses_the_conflict() -> None:
    pairs = build_pairs(build_candidates(LEFT, RIGHT))
    found = add_reversed(
        {("a", "b"): build_estimate(LEFT, 0.5), ("a", "c"): build_estimate(LEFT, 0.1)}
    )
    assert list(resolve_conflicts(pairs, found)) == [("a", "b")]


def test_pairs_without_conflict_are_unchanged() -> None:
    pairs = build_pairs(build_candidates(LEFT, RIGHT))
    assert not resolve_conflicts(
        pairs, add_reversed({("a", "b"): build_estimate(LEFT), ("a", "c"): build_estimate(RIGHT)})
    )
    blind = {names: replace(pair, own_bearings=None) for names, pair in pairs.items()}
    assert not resolve_conflicts(
        blind, add_reversed({("a", "b"): build_estimate(LEFT), ("a", "c"): build_estimate(LEFT)})
    )


def test_conflicts_in_the_camera_of_the_second_robot_are_resolved() -> None:
    pair, _ = build_still_pair()
    sees = build_candidates(LEFT, RIGHT)
    pairs = {
        ("a", "c"): replace(pair, peer_bearings=sees),
        ("b", "c"): replace(pair, peer_bearings=sees),
    }
    ways = {("c", "a"): build_estimate(LEFT), ("c", "b"): build_estimate(LEFT + 0.08)}
    (again,) = resolve_conflicts(pairs, add_reversed(ways)).items()
    assert again[0] == ("b", "c")
    assert list_bearings(again[1].peer_bearings) == pytest.approx([RIGHT])
    assert again[1].own_bearings is None


def test_images_without_candidates_are_dropped() -> None:
    sees = build_candidates(LEFT)
    gone = np.arange(len(TIMES_S)) < 3
    left = drop_candidates(sees, gone, np.zeros(len(TIMES_S), np.intp))
    assert left.time_s.tolist() == TIMES_S[3:].tolist()
    assert sees.crop(1.0, 2.0).time_s.tolist() == [1.0, 1.5, 2.0]


def test_bearing_variance_follows_position_covariance() -> None:
    rng, place = np.random.default_rng(0), np.array([[1.5, -0.8, 0.4]])
    spread = np.diag([0.02, 0.01, 0.015]) ** 2
    drawn = to_bearing(place + rng.multivariate_normal(np.zeros(3), spread, 50_000))
    assert bearing_variance(place, spread[None])[0] == pytest.approx(drawn.var(axis=0), rel=0.05)


def test_association_likelihood_is_the_gaussian_density() -> None:
    place, spread = np.array([[2.0, 0.0, 0.0]]), 0.1**2 * np.eye(3)[None]
    sees = build_candidates(0.1, 0.3)
    one = BearingMeasurements(sees.time_s[:1], sees.bearing[:1], sees.std[:1])
    found = associate(one, place, spread)
    variance = STD**2 + 0.05**2
    assert found.nearest.tolist() == [0]
    assert found.squared_distance == pytest.approx([0.1**2 / variance[0]])
    assert found.log_likelihood == pytest.approx(
        -(found.squared_distance + np.log(variance).sum()) / 2
    )
