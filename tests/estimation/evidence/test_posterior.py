"""Error models added to a solution, such as scales, jumps and late ranges."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from dmrl.estimation.evidence import posterior
from dmrl.estimation.evidence.causes import find_dropouts, join_causes
from dmrl.estimation.evidence.error_models import MODELS, Candidate, list_candidates
from dmrl.estimation.evidence.model_trials import Member
from dmrl.estimation.flight.pairs import estimate_pairs
from dmrl.estimation.solver.estimate import Cause
from dmrl.estimation.solver.keyframes import build_problem
from dmrl.estimation.solver.unknowns import TABLE
from dmrl.flight import Trajectory
from dmrl.messages import STATUS_OK

from ..flights import build_pair, build_two_way_pair, compute_truth, simulate_flight


def test_names_of_models_and_of_their_unknowns_are_distinct() -> None:
    rows = [row.name for model in MODELS for row in model.rows]
    assert len(set(rows)) == len(rows) and not set(rows) & {row.name for row in TABLE}
    assert len({model.name for model in MODELS}) == len(MODELS)


@pytest.mark.parametrize(
    "candidate", list(list_candidates()), ids=lambda one: f"{one.model.name} {one.robot}"
)
def test_a_model_adds_unknowns_for_its_robot_only(candidate: Candidate) -> None:
    problem = build_problem(
        {(0, 1): build_pair(simulate_flight("in_view", "calibrated", 1000, 20.0))}
    )
    before, after = problem.layout, candidate.apply(problem).layout
    added = {s for s, _ in (*after.states, *after.constants)} - {
        s for s, _ in (*before.states, *before.constants)
    }
    assert {name for name, _ in added} == {row.name for row in candidate.model.rows}
    if candidate.robot is not None:
        assert {own for _, own in added} <= {(candidate.robot,)}


@pytest.mark.parametrize(
    ("trajectory", "shown"),
    [("in_view", {0, 1, None}), ("observer_static", {1, None}), ("both_static", set())],
)
def test_only_motion_shows_a_scale_of_the_flow(
    trajectory: Trajectory, shown: set[int | None]
) -> None:
    problem = build_problem(
        {(0, 1): build_pair(simulate_flight(trajectory, "calibrated", 1000, 20.0))}
    )
    listed = posterior.list_shown(problem)
    scales = {one.robot for one in listed if any(row.motion_scale for row in one.model.rows)}
    assert scales == shown
    assert Candidate(MODELS[0], 0) in listed


def test_rounded_ranges_do_not_show_jumps() -> None:
    pair = build_pair(simulate_flight("in_view", "calibrated", 1000, 20.0))
    for unit_m, shown in ((0.01, True), (0.4, False)):
        rounded = replace(pair, range_m=np.round(pair.range_m / unit_m).clip(1) * unit_m)
        listed = posterior.list_shown(build_problem({(0, 1): rounded}))
        assert any(one.model.sudden for one in listed) == shown


@pytest.mark.heavy
def test_gyroscope_step_is_identified_and_corrected() -> None:
    flight = simulate_flight("in_view", "calibrated", 1002, 60.0)
    pair = build_pair(flight)
    late = pair.time_s > 30.0
    jumped = replace(pair.own, yaw_rate_radps=pair.own.yaw_rate_radps + 0.06 * late)
    ((sound, _),) = estimate_pairs([pair])
    ((plain, _),) = estimate_pairs([replace(pair, own=jumped)], plain=True)
    ((found, _),) = estimate_pairs([replace(pair, own=jumped)])
    error, worse = (
        np.hypot(*(e.state[:, :2] - compute_truth(flight, e.time_s)).T).mean()
        for e in (found, plain)
    )
    assert not any(cause.probability > 0.5 and "yaw" in cause.name for cause in sound.causes)
    assert any(cause.probability > 0.5 and "yaw rate" in cause.name for cause in found.causes)
    assert error < worse


@pytest.mark.heavy
def test_a_scale_of_both_flows_is_no_scale_of_the_ranges() -> None:
    flight = simulate_flight("in_view", "calibrated", 1000, 60.0)
    pair = build_pair(flight)
    fast = [
        replace(one, vx_mps=1.3 * one.vx_mps, vy_mps=1.3 * one.vy_mps)
        for one in (pair.own, pair.peer)
    ]
    ((found, _),) = estimate_pairs([replace(pair, own=fast[0], peer=fast[1])])
    error = np.hypot(*(found.state[:, :2] - compute_truth(flight, found.time_s)).T)
    assert any(cause.name == "flow scale of both robots" for cause in found.causes)
    kept = found.status == STATUS_OK
    assert np.median(error) < 0.4  # it is 0.6 if the ranges get the scale
    assert not (error[kept] > 0.3).any()


@pytest.mark.heavy
def test_late_ranges_are_identified_and_corrected() -> None:
    flight = simulate_flight("in_view", "calibrated", 1001, 60.0)
    pair = build_pair(flight)
    kept = pair.range_time_s < pair.time_s[-1] - 0.2
    late = replace(pair, range_time_s=pair.range_time_s[kept] + 0.2, range_m=pair.range_m[kept])
    ((plain, _),) = estimate_pairs([late], plain=True)
    ((found, _),) = estimate_pairs([late])
    error, worse = (
        np.hypot(*(e.state[:, :2] - compute_truth(flight, e.time_s)).T).mean()
        for e in (found, plain)
    )
    assert [cause.name for cause in found.causes if cause.probability > 0.5] == ["range late"]
    assert error < 0.85 * worse


@pytest.mark.heavy
@pytest.mark.parametrize("bend", [0.04, -0.04])
def test_range_error_that_follows_distance_is_identified_and_corrected(bend: float) -> None:
    flight = simulate_flight("room", "calibrated", 1006, 60.0)
    pair = build_pair(flight)
    bent = replace(pair, range_m=pair.range_m + bend * pair.range_m**2)
    ((plain, _),) = estimate_pairs([bent], plain=True)
    ((found, _),) = estimate_pairs([bent])
    error, worse = (
        np.hypot(*(e.state[:, :2] - compute_truth(flight, e.time_s)).T).mean()
        for e in (found, plain)
    )
    assert [cause.name for cause in found.causes if cause.probability > 0.5] == [
        "range error follows distance"
    ]
    assert error < 0.75 * worse


@pytest.mark.heavy
def test_ranges_that_jump_in_one_place_are_identified_and_corrected() -> None:
    flight = simulate_flight("room", "calibrated", 1006, 60.0)
    pair = build_pair(flight)
    far = compute_truth(flight, pair.range_time_s)[:, 0] > 0.5
    assert 8 < np.abs(np.diff(far.astype(int))).sum() < 100 and 0.1 < far.mean() < 0.9
    jumping = replace(pair, range_m=pair.range_m + 0.5 * far)
    ((plain, _),) = estimate_pairs([jumping], plain=True)
    ((found, _),) = estimate_pairs([jumping])
    error, worse = (
        np.hypot(*(e.state[:, :2] - compute_truth(flight, e.time_s)).T).mean()
        for e in (found, plain)
    )
    assert [cause.name for cause in found.causes if cause.probability > 0.5] == [
        "range offset changes"
    ]
    assert error < 0.5 * worse


@pytest.mark.heavy
def test_ranges_that_fade_in_each_direction_are_identified_and_corrected() -> None:
    flight = simulate_flight("in_view", "calibrated", 1007, 60.0)
    pair, rng = build_two_way_pair(flight), np.random.default_rng(3)
    slow_s = np.arange(0.0, 61.0, 2.5)
    fading = [np.interp(pair.range_time_s, slow_s, rng.normal(0, 0.25, len(slow_s))) for _ in "12"]
    excess_m = np.where(pair.range_sender == 0, *fading)
    faded = replace(pair, range_m=np.maximum(pair.range_m + excess_m, 0.05))
    ((plain, _),) = estimate_pairs([faded], plain=True)
    ((found, _),) = estimate_pairs([faded])
    error, worse = (
        np.hypot(*(e.state[:, :2] - compute_truth(flight, e.time_s)).T).mean()
        for e in (found, plain)
    )
    names = [cause.name for cause in found.causes if cause.probability > 0.5]
    assert "range errors of each direction fade" in names
    assert error < 0.8 * worse


def test_rivals_of_a_round_get_the_models_of_later_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A rival of the first model is also extended by the second model."""
    first, rival, second = list(list_candidates())[:3]

    def extended(base: Member, candidate: Candidate) -> list[Member]:
        return [replace(base, models=(*base.models, candidate), score=base.score + 1.0)]

    monkeypatch.setattr(posterior, "try_model", extended)
    monkeypatch.setattr(posterior, "select_grade", lambda member: member)
    solver, values = Mock(), Mock()
    member = Member(solver, values, -3.0, (rival,))
    (found,) = posterior._extend_rivals([(first, [member]), (second, [member])])
    assert found.models == (rival, second) and found.score == -2.0


def test_dropouts_are_causes_and_windows_are_joined() -> None:
    pair = build_pair(simulate_flight("in_view", "calibrated", 1000, 20.0))
    assert find_dropouts(pair, pair) == ()
    gap = (pair.time_s > 5) & (pair.time_s < 8)
    quiet = replace(pair.peer, dropout=gap, turn_dropout=np.zeros_like(gap))
    (cause,) = find_dropouts(replace(pair, peer=quiet), replace(pair, peer=quiet))
    assert (cause.name, cause.robot) == ("flow silent, stuck or saturated", 1)
    assert (cause.from_s, cause.to_s) == pytest.approx((5, 8), abs=0.05)
    one, two = Cause("a", 0.4, 0.0, 5.0, 1), Cause("a", 0.9, 5.0, 9.0, 1)
    assert join_causes([one, two]) == (Cause("a", 0.9, 0.0, 9.0, 1),)
