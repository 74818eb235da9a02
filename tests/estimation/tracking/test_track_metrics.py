"""Figures of tracks, compared with values computed by hand."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.tracking.track_metrics import (
    MAX_MATCH_M,
    EvaluatedTracks,
    compute_figures,
    match_positions,
)

NOTHING = [np.nan] * 3
ERRORS = np.array([[0.3, 0.0, 0.0], [0.0, 0.4, 0.0], [0.0, 0.0, 1.2], NOTHING])
SINGLES = np.array([[0.6, 0.0, 0.0], [0.0, 0.8, 0.0], NOTHING, [2.0, 0.0, 0.0]])


def build_tracks() -> EvaluatedTracks:
    """Return four peers in view, one per second.

    The third has no single detection, and the fourth has no track.
    """
    return EvaluatedTracks(
        "cf1",
        np.arange(4.0),
        ["cf2", "cf2", "cf3", "cf3"],
        ["cf2", "cf3", "", ""],
        ERRORS,
        SINGLES,
        np.tile(np.diag([0.01, 0.04, 0.16]), (4, 1, 1)),
        false_tracks=3,
        length_s=90.0,
    )


def test_track_figures_equal_hand_computed_values() -> None:
    found = compute_figures(build_tracks(), 0.0)
    assert found["in_view"] == 4
    assert found["rmse_m"] == pytest.approx(np.sqrt((0.09 + 0.16) / 2))  # peers with both errors
    assert found["single_rmse_m"] == pytest.approx(np.sqrt((0.36 + 0.64) / 2))
    assert found["reduction"] == pytest.approx(0.5)
    assert (found["median_m"], found["single_median_m"]) == pytest.approx((0.35, 0.7))
    assert found["nees"] == pytest.approx((9 + 4 + 9) / 3)
    assert found["coverage_95"] == pytest.approx(1 / 3)  # the limit is 7.8; the values 9, 4, 9
    assert (found["followed"], found["detected"]) == (0.5, 0.5)  # an error of 1.2 m is too large
    assert found["false_tracks_per_min"] == pytest.approx(2.0)
    assert found["named_right"] == 0.5


def test_only_false_tracks_count_before_settling() -> None:
    found = compute_figures(build_tracks(), 1.0)
    assert (found["in_view"], found["rmse_m"]) == (3, pytest.approx(0.4))
    assert (found["named_right"], found["false_tracks_per_min"]) == (0.0, pytest.approx(2.0))
    nothing = compute_figures(build_tracks(), 9.0)
    assert {name: value for name, value in nothing.items() if value is not None} == {
        "in_view": 0.0,
        "false_tracks_per_min": pytest.approx(2.0),
    }
    assert (
        compute_figures(replace(build_tracks(), length_s=0.0), 0.0)["false_tracks_per_min"] is None
    )


def test_coverage_uses_the_95_percent_ellipsoid_in_three_dimensions() -> None:
    rng = np.random.default_rng(0)
    shape = np.array([[0.04, 0.01, 0.0], [0.01, 0.02, -0.01], [0.0, -0.01, 0.03]])
    errors = rng.multivariate_normal(np.zeros(3), shape, 4000)
    covariance, names = np.tile(shape, (4000, 1, 1)), [""] * 4000
    many = EvaluatedTracks("a", np.zeros(4000), names, names, errors, errors, covariance, 0, 1.0)
    found = compute_figures(many, 0.0)
    assert found["coverage_95"] == pytest.approx(0.95, abs=0.01)
    assert found["nees"] == pytest.approx(3.0, rel=0.05)


def test_positions_are_matched_one_to_one_within_a_radius() -> None:
    truth = np.array([[0.0, 0, 0], [2.0, 0, 0], [np.nan] * 3])
    found = np.array([[1.1, 0, 0], [0.2, 0, 0]])
    assert match_positions(truth, found).tolist() == [1, 0, -1]
    assert match_positions(truth, found, MAX_MATCH_M).tolist() == [1, 0, -1]
    assert match_positions(truth, found, 0.9).tolist() == [1, 0, -1]
    assert match_positions(truth, found, 0.89).tolist() == [1, -1, -1]
    assert match_positions(truth, np.zeros((0, 3))).tolist() == [-1, -1, -1]
