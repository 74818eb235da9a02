"""Trials of error models: their scores, and noise levels over time."""

from dataclasses import replace
from functools import cache
from unittest.mock import Mock

import numpy as np
import pytest

from dmrl.estimation.evidence import model_trials, noisy_stretch
from dmrl.estimation.evidence.error_models import MODELS, Candidate, list_candidates
from dmrl.estimation.evidence.model_trials import (
    MIN_STEP_GAIN,
    Member,
    score_steps,
    solve_under,
    try_model,
    try_models,
)
from dmrl.estimation.evidence.noisy_stretch import find_noisy_steps
from dmrl.estimation.flight.pair_solver import solve_pair
from dmrl.estimation.model.pair import Array, Pair
from dmrl.estimation.search.modes import convert_values
from dmrl.estimation.solver.keyframes import build_problem
from dmrl.estimation.solver.levenberg_marquardt import Solver
from dmrl.estimation.solver.residuals import Rows, Values

from ..flights import build_pair, simulate_flight

FOR_A_WHILE = next(model for model in MODELS if model.for_a_while)


def solve_plain(pair: Pair) -> Member:
    """Solve a flight without error models."""
    solution = solve_pair(build_problem({(0, 1): pair}), plain=True)
    found = solve_under(solution.solver, solution.values, ())
    assert found is not None
    return found


@cache
def solve_sound() -> Member:
    """Solve a simulated pair without faults."""
    return solve_plain(build_pair(simulate_flight("in_view", "calibrated", 1000, 20.0)))


def add_flow_noise(pair: Pair, where: Array, seed: int = 5) -> Pair:
    """Add velocity noise of 0.5 m/s with a time constant of 0.3 s to the first robot's flow."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(0.0, 1.0, (2, len(pair.time_s)))
    kept = np.exp(-0.01 / 0.3)
    noise = np.zeros_like(steps)
    for k in range(1, noise.shape[1]):
        noise[:, k] = kept * noise[:, k - 1] + np.sqrt(1 - kept**2) * steps[:, k]
    vx, vy = 0.5 * noise * where
    own = replace(pair.own, vx_mps=pair.own.vx_mps + vx, vy_mps=pair.own.vy_mps + vy)
    return replace(pair, own=own)


@pytest.mark.heavy
def test_scores_from_one_linearization_equal_those_of_each_model() -> None:
    base = solve_sound()
    candidates = [
        one for one in list_candidates() if not (one.model.for_a_while or one.model.sudden)
    ]
    gains = score_steps(base, candidates)
    assert min(gains.values()) < MIN_STEP_GAIN < max(gains.values())
    for one in candidates:
        solver = Solver(one.apply(base.solver.problem))
        start = convert_values(base.values, base.solver.layout, solver.layout)
        own = model_trials._step_score(solver, start, (one,)) - base.score
        assert gains[one] == pytest.approx(own, abs=1e-3), one


@pytest.mark.heavy
def test_all_models_are_tried_where_the_step_is_singular(monkeypatch: pytest.MonkeyPatch) -> None:
    base = solve_sound()
    candidates = [one for one in list_candidates() if one.model.rows]
    monkeypatch.setattr(model_trials, "eliminate_states", Mock(side_effect=np.linalg.LinAlgError))
    assert score_steps(base, candidates) == dict.fromkeys(candidates, np.inf)


def test_models_without_gain_are_not_solved_after_a_leading_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    lead, near, far = list(list_candidates())[:3]
    gains = {far: -4.0, near: -2.0, lead: 20.0}
    monkeypatch.setattr(model_trials, "score_steps", lambda _base, _some: gains)
    base = Member(Mock(), Mock(), 100.0)
    monkeypatch.setattr(
        model_trials,
        "try_model",
        lambda _base, one, _others: [replace(base, score=100.0 + gains[one], models=(one,))],
    )
    found = try_models(base, list(gains))
    assert [member.models[0] for member in found] == [lead, near]
    gains[lead] = 10.0
    assert len(try_models(base, list(gains))) == 3


@pytest.mark.heavy
def test_quiet_flight_has_no_noisy_stretch() -> None:
    base = solve_plain(build_pair(simulate_flight("in_view", "calibrated", 1000, 40.0)))
    assert [find_noisy_steps(base.solver, base.values, robot) for robot in (0, 1)] == [None, None]


def test_levels_are_decoded_to_the_ends_of_the_flight() -> None:
    level = np.ones(30)
    level[20:] = 20.0
    gain, noisy = noisy_stretch._decode_levels(level, 16.0)
    assert gain > 0 and noisy.tolist() == [False] * 20 + [True] * 10
    level[:] = 1.0
    level[7] = 3.0
    gain, noisy = noisy_stretch._decode_levels(level, 16.0)
    assert gain == 0 and not noisy.any()


@pytest.mark.heavy
def test_temporary_noise_is_found_and_widens_only_its_stretch() -> None:
    pair = build_pair(simulate_flight("room", "calibrated", 1003, 60.0))
    where = (pair.time_s > 20) & (pair.time_s < 35)
    base = solve_plain(add_flow_noise(pair, where))
    found = [try_model(base, Candidate(FOR_A_WHILE, robot)) for robot in (0, 1)]
    best = max((one for some in found for one in some), key=lambda one: one.score)
    assert best.score > base.score + 10
    robot = best.models[0].robot
    assert robot is not None
    problem = best.solver.problem
    noisy = np.asarray(problem.robots[robot].grade) > 1
    middle_s = (problem.keyframe_s[1:] + problem.keyframe_s[:-1]) / 2
    inside = (middle_s > 20) & (middle_s < 35)
    assert noisy[inside].mean() > 0.7 and noisy[~inside].mean() < 0.15
    assert problem.noise.grade < base.solver.problem.noise.grade


@pytest.mark.heavy
def test_a_stretch_of_another_log_is_not_noise() -> None:
    pair = build_pair(simulate_flight("room", "calibrated", 1003, 60.0))
    other = build_pair(simulate_flight("room", "calibrated", 1004, 60.0)).peer
    where = (pair.time_s > 20) & (pair.time_s < 35)
    vx, vy = (
        np.where(where, getattr(other, name), getattr(pair.peer, name))
        for name in ("vx_mps", "vy_mps")
    )
    base = solve_plain(replace(pair, peer=replace(pair.peer, vx_mps=vx, vy_mps=vy)))
    square = noisy_stretch.sum_velocity_squares(base.solver, base.values, 1)
    middle_s = base.solver.problem.keyframe_s[1:]
    inside = (middle_s > 20) & (middle_s < 35)
    assert square[inside].mean() > 3 * square[~inside].mean()  # the ranges contradict it
    for robot in (0, 1):
        assert not try_model(base, Candidate(FOR_A_WHILE, robot))


def test_velocity_errors_count_coloured_noise_of_their_robot_alone() -> None:
    problem = build_problem(
        {(0, 1): build_pair(simulate_flight("in_view", "calibrated", 1000, 20.0))}
    )
    solver, layout = Solver(problem), problem.layout
    state = np.zeros((len(problem.keyframe_s), layout.width))
    state[50, layout.state_column("velocity_error_x", 0)] = 0.5
    values = Values(state, np.zeros(len(layout.constants)))
    motions = [one for one in solver.linearize(values) if isinstance(one, Rows) and one.steps]
    for robot, steps in ((0, [49, 50]), (1, [])):
        coloured = noisy_stretch.sum_velocity_squares(solver, values, robot)
        coloured -= motions[robot].square[:, :2].sum(axis=1)
        assert np.flatnonzero(coloured > 1).tolist() == steps
