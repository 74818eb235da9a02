"""Tracks get the names of peers by their ranges, unless that is ambiguous."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from dmrl.estimation.tracking.identity import AVERAGING_S, RANGE_STD_M, TrackIdentity


@dataclass
class Track:
    """A track straight ahead, with only the fields that `TrackIdentity` uses."""

    number: int
    distance_m: float
    std_m: float = 0.0
    position_m: np.ndarray = field(init=False)
    covariance: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.position_m = np.array([self.distance_m, 0.0, 0.0])
        self.covariance = np.diag([self.std_m**2, 9.0, 9.0])  # only the first axis matters


def assign_names(tracks: list[Track], times: int = 1, **range_m: float) -> dict[int, str]:
    """Assign names to tracks by ranges that are measured a number of times."""
    identity = TrackIdentity()
    for _ in range(times):
        found = identity.assign(tracks, range_m, 0.1)  # type: ignore[arg-type]
    return found


@pytest.mark.parametrize(("sigmas", "named"), [(1.9, True), (2.1, False)])
def test_a_range_fits_within_two_sigmas_of_itself_and_the_track(sigmas: float, named: bool) -> None:
    std_m = 0.3
    apart = sigmas * np.hypot(RANGE_STD_M, std_m)
    assert bool(assign_names([Track(1, 2.0, std_m)], cf2=2.0 + apart)) == named
    assert bool(assign_names([Track(1, 2.0, std_m)], cf2=2.0 - apart)) == named


@pytest.mark.parametrize(
    ("best", "misfit", "named"),
    [(0.0, 1.4, False), (0.0, 1.6, True), (1.0, 2.4, False), (1.0, 2.6, True)],
)
def test_name_needs_a_clear_margin_over_others(best: float, misfit: float, named: bool) -> None:
    one, other = 2.0 - RANGE_STD_M * np.sqrt([best, misfit])
    assert bool(assign_names([Track(1, 2.0)], cf2=one, cf3=other)) == named


def test_names_are_assigned_jointly_to_two_tracks() -> None:
    assert assign_names([Track(1, 1.0), Track(2, 3.0)], cf2=3.0, cf3=1.0) == {1: "cf3", 2: "cf2"}


def test_a_track_is_named_although_another_one_fits_no_peer() -> None:
    assert assign_names([Track(1, 1.0), Track(2, 3.0)], cf2=5.0, cf3=1.0) == {1: "cf3"}


def test_single_range_outlier_is_bounded_and_forgotten() -> None:
    identity = TrackIdentity()
    track: list[Track] = [Track(1, 2.0)]
    steps = round(3 * AVERAGING_S / 0.1)
    for k in range(steps):
        ranges = {"cf2": 2.0 if k else 60.0, "cf3": 9.0}
        found = identity.assign(track, ranges, 0.1)  # type: ignore[arg-type]
        if k == round(0.5 * AVERAGING_S / 0.1):
            assert not found  # the averaged misfit, 9 e^-0.5, is still above 4
    assert found == {1: "cf2"}


def test_ended_and_unranged_tracks_have_no_name() -> None:
    identity = TrackIdentity()
    assert identity.assign([Track(1, 2.0)], {"cf2": 2.0}, 0.1) == {1: "cf2"}  # type: ignore[list-item]
    assert identity.assign([], {}, 0.1) == {}
    assert identity.assign([Track(1, 9.0)], {}, 0.1) == {}  # type: ignore[list-item]
