"""Statuses of positions: which are within the stated error, and which are ambiguous."""

import numpy as np
import pytest

from dmrl.estimation.model.gate import Gate
from dmrl.estimation.model.pair import Array
from dmrl.estimation.model.status import (
    AMBIGUOUS,
    OK,
    UNCONVERGED,
    classify_positions,
    probability_beyond,
    select_within_budget,
)


def build_covariances(*sigmas_m: float) -> Array:
    """Return (K, 3, 3) covariances with equal stds along x and y."""
    return np.stack([np.diag([sigma**2, sigma**2, 0.01]) for sigma in sigmas_m])


def test_the_probability_of_a_round_error_is_rayleighs() -> None:
    found = probability_beyond(build_covariances(0.1, 0.3)[:, :2, :2], 0.3)
    assert found == pytest.approx(np.exp([-4.5, -0.5]))


def test_probability_of_an_elongated_error_matches_samples() -> None:
    covariance = np.array([[0.04, 0.015], [0.015, 0.01]])
    errors = np.random.default_rng(0).multivariate_normal([0, 0], covariance, 200_000)
    share = (np.hypot(*errors.T) > 0.3).mean()
    assert probability_beyond(covariance[None], 0.3)[0] == pytest.approx(share, rel=0.02)


def test_best_positions_are_kept_within_the_error_budget() -> None:
    probability = np.array([0.1, 0.0, 0.06, 0.05, 0.0])
    for share, count in ((0.01, 2), (0.02, 3)):
        kept = select_within_budget(probability, share)
        assert kept.sum() == count
        assert probability[kept].mean() <= share
        worse = np.sort(probability[~kept])[:1]
        assert np.append(probability[kept], worse).mean() > share


def test_open_bearing_is_ambiguous_and_uncertain_position_unconverged() -> None:
    far = np.tile([4.0, 0.0, 0.0], (5, 1))
    assert (classify_positions(far, build_covariances(*[0.08] * 5)) == OK).all()
    assert (classify_positions(far, build_covariances(*[0.5] * 5)) == UNCONVERGED).all()
    assert (classify_positions(far / 4, build_covariances(*[0.5] * 5)) == AMBIGUOUS).all()


def test_flight_is_ambiguous_if_median_bearing_is_open() -> None:
    near = np.tile([1.0, 0.0, 0.0], (5, 1))
    # The median is 0.3 rad, which is below the limit of a single position.
    vague = build_covariances(0.3, 0.3, 0.3, 0.02, 0.02)
    assert (classify_positions(near, vague) == AMBIGUOUS).all()
    mostly = build_covariances(0.3, 0.3, 0.02, 0.02, 0.02)
    assert (classify_positions(near, mostly) != AMBIGUOUS).all()
    assert (classify_positions(near, mostly)[2:] == OK).all()


def test_ok_positions_meet_the_stated_error_rate() -> None:
    """The expected share of bad positions is just within the budget of the gate."""
    std_m = np.linspace(0.02, 0.2, 400)
    far = np.tile([4.0, 0.0, 0.0], (400, 1))
    bad = probability_beyond(build_covariances(*std_m)[:, :2, :2], 0.3)
    ok = classify_positions(far, build_covariances(*std_m)) == OK
    assert bad[ok].mean() <= 0.02 < np.append(bad[ok], bad[~ok].min()).mean()
    more = classify_positions(far, build_covariances(*std_m), Gate(bad_share=0.1)) == OK
    assert bad[ok].max() < bad[more].max() and bad[more].mean() <= 0.1


def test_bearing_is_open_by_its_largest_axis_over_the_distance() -> None:
    along = np.diag([0.5**2, 0.02**2, 0.01])
    for distance_m, open_ in ((1.4, True), (1.5, False)):  # 0.5 m at 1.43 m is the limit, 0.35 rad
        at = np.tile([distance_m, 0.0, 0.0], (5, 1))
        covariance = np.stack([along, *[np.eye(3) * 1e-4] * 4])
        assert (classify_positions(at, covariance)[0] == AMBIGUOUS) == open_
