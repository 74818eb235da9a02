"""Tests of whether the measurements of a flight fit its solution."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.linalg import block_diag

from dmrl.estimation.evidence.causes import join_causes, join_innovations
from dmrl.estimation.evidence.goodness_of_fit import (
    WINDOW_S,
    SignalScores,
    _sum_scores,
    check_fit,
    compute_scores,
)
from dmrl.estimation.flight.pair_output import with_status
from dmrl.estimation.flight.pair_solver import solve_pair
from dmrl.estimation.model.gate import DEFAULT_GATE
from dmrl.estimation.model.pair import Array, Pair
from dmrl.estimation.model.status import OK, UNCONVERGED
from dmrl.estimation.search.modes import convert_values
from dmrl.estimation.solver.block_tridiagonal import NormalEquations
from dmrl.estimation.solver.estimate import Cause, Estimate, Innovation
from dmrl.estimation.solver.keyframes import build_problem
from dmrl.estimation.solver.levenberg_marquardt import Solver
from dmrl.estimation.solver.problem import NoiseModel, RangeLink, Sight
from dmrl.estimation.solver.residuals import Rows, Values
from dmrl.estimation.solver.robust_loss import Gaussian
from dmrl.estimation.solver.unknowns import Unknown, with_rows

from ..flights import build_pair, simulate_flight

LENGTH_S = 30.0


def simulate_pair() -> Pair:
    """Simulate a pair that sees each other, with calibrated sensors."""
    return build_pair(simulate_flight("in_view", "calibrated", 1003, LENGTH_S))


def solve(given: Pair) -> tuple[Solver, Values]:
    """Solve a pair without error models; return the solver and its solution."""
    found = solve_pair(build_problem({(0, 1): given}), NoiseModel(), plain=True)
    return found.solver, found.values


@cache
def solve_sound() -> tuple[Solver, Values]:
    """Solve the simulated pair, which has no fault."""
    return solve(simulate_pair())


@pytest.mark.heavy
def test_a_sound_flight_fits() -> None:
    innovations, causes = check_fit(*solve_sound(), (0.0, LENGTH_S))
    assert causes == ()
    assert {(one.signal, one.robot) for one in innovations} == {
        ("flow", 0), ("flow", 1), ("yaw rate", 0), ("yaw rate", 1), ("range", None),
    }  # fmt: skip
    sizes = np.concatenate([one.size for one in innovations])
    assert 0.3 < np.sqrt(np.nanmean(sizes**2)) < 1.2


@pytest.mark.heavy
def test_a_stretch_of_swapped_axes_does_not_fit() -> None:
    sound = simulate_pair()
    at = (sound.time_s > 10) & (sound.time_s < 20)
    y = np.where(at, sound.own.vx_mps, sound.own.vy_mps)
    x = np.where(at, sound.own.vy_mps, sound.own.vx_mps)
    wrong = replace(sound, own=replace(sound.own, vx_mps=x, vy_mps=y))
    _, causes = check_fit(*solve(wrong), (0.0, LENGTH_S))
    assert causes and all(cause.refuses and cause.probability > 0.98 for cause in causes)
    assert any(cause.from_s < 20 and cause.to_s > 10 for cause in causes)


@pytest.mark.heavy
def test_a_statistic_is_the_fall_of_the_cost_if_the_error_were_estimated() -> None:
    """The score test agrees with a solve that has the error as a further unknown."""
    problem = build_problem({(0, 1): simulate_pair()})
    square = Gaussian()
    noise = NoiseModel(range_loss=square, motion_loss=square)
    rows = [replace(row, loss=square, pull_weight=0.0) for row in problem.table]
    problem = replace(problem, noise=noise, table=tuple(rows))
    start = solve_sound()[1]
    solver = Solver(problem)
    found = solver.solve(start, tolerance=1e-12)
    scores = {one.signal: one for one in compute_scores(solver, found.values)}["range"]
    window = 5
    keyframes = (problem.keyframe_s - problem.keyframe_s[0]) // WINDOW_S == window

    def bump(link: RangeLink, _sight: Sight) -> Array:
        return problem.noise.range_std_m * link.std_share * keyframes[link.keyframe]

    freed = Unknown("bump", "1", 1e3, "pair", range=bump)
    wider = Solver(replace(problem, table=with_rows(problem.table, freed)))
    again = convert_values(found.values, solver.layout, wider.layout)
    fall = found.cost - wider.solve(again, tolerance=1e-12).cost
    statistic, freedom = (each[window] for each in scores.chi_squares(1))
    assert freedom == 1
    assert statistic == pytest.approx(2 * fall, rel=0.05)


def test_scores_are_extrapolated_to_the_optimum_of_an_early_ended_solve() -> None:
    solver, values = solve_sound()
    optimum = solver.solve(values, tolerance=1e-12).values
    before = Values(optimum.state.copy(), optimum.constants.copy())
    before.state[:, solver.layout.pose(0)[2]] += 2e-4 * np.arange(len(before.state))
    for there, here in zip(
        compute_scores(solver, optimum), compute_scores(solver, before), strict=True
    ):
        assert here.score == pytest.approx(there.score, abs=0.03)


@pytest.mark.heavy
def test_score_covariance_excludes_what_the_unknowns_explain() -> None:
    """It equals the Schur complement of the dense matrix of keyframes and constants."""
    solver, values = solve_sound()
    equations, factors = solver.equations(values)
    found = compute_scores(solver, values)[0]
    window = ((solver.problem.keyframe_s - solver.problem.keyframe_s[0]) / WINDOW_S).astype(int)
    window[-1] = window[-2]
    (factor, *_) = (one for one in factors if isinstance(one, Rows))
    scores = _sum_scores(factor, window, equations)
    constants = scores.by_constant.reshape(len(equations.globals_block), -1)
    effect = np.vstack([scores.by_state.toarray(), constants])
    border = equations.coupling.reshape(-1, len(constants))
    states = block_diag(*equations.diagonal)
    size = equations.diagonal.shape[1]
    for k, block in enumerate(equations.off_diagonal):
        states[k * size : (k + 1) * size, (k + 1) * size : (k + 2) * size] = block
        states[(k + 1) * size : (k + 2) * size, k * size : (k + 1) * size] = block.T
    whole = np.block([[states, border], [border.T, equations.globals_block]])
    left = np.diag(scores.information.ravel()) - effect.T @ np.linalg.solve(whole, effect)
    scale = 1 / np.sqrt(np.maximum(scores.information, 1e-9).ravel())
    shape = (*scores.information.shape, *scores.information.shape)
    expected = (left * scale * scale[:, None]).reshape(shape)[:, :2, :, :2]
    assert found.covariance == pytest.approx(expected, abs=1e-9)


def test_directions_explained_by_the_unknowns_are_not_tested() -> None:
    covariance = np.diag([1.0, 0.25, 0.0]).reshape(3, 1, 3, 1)
    one = SignalScores("flow", 0, np.arange(3.0), np.array([[2.0], [1.0], [5.0]]), covariance)
    square, freedom = one.chi_squares(2)
    assert (square[0], freedom[0]) == (pytest.approx(4 + 4), 2)
    square, freedom = one.chi_squares(1)
    assert (square[2], freedom[2]) == (0.0, 0)
    assert np.isnan(one.to_innovation().size[2])


def test_a_lost_image_has_no_score() -> None:
    rows = np.zeros((2, 1, 3, 3))
    rows[:, 0, 0, -1] = 5.0
    rows[1, 0, 0, 0] = 1.0
    factor = Rows(rows, [0, 1], [], Gaussian(), np.ones((2, 1)))
    scores = _sum_scores(factor, np.array([0, 1]), NormalEquations.zeros(2, 2, 0))
    assert not scores.score[0].any() and not scores.information[0].any()
    assert scores.score[1].tolist() == [5.0, 0.0, 0.0]


def test_no_position_of_a_stretch_that_does_not_fit_is_ok() -> None:
    time_s = np.arange(0.0, 100.0)
    state = np.tile([2.0, 0.0, 0.0], (100, 1))
    spread = np.tile(np.diag([1e-4, 1e-4, 1e-4]), (100, 1, 1))
    cause = Cause("range does not fit", 1.0, 40.0, 50.0)
    none = np.zeros(100, np.int8)
    given = Estimate(time_s, state, spread, none, np.zeros(0), NoiseModel(), causes=(cause,))
    out = with_status(given, none.astype(bool), (9.0, 9.0), DEFAULT_GATE)
    assert (out.status[10:81] == UNCONVERGED).all()
    assert (out.status[[0, 9, 81, 99]] == OK).all()
    everything = replace(given, causes=(replace(cause, from_s=0.0, to_s=99.0),))
    refused = with_status(everything, none.astype(bool), (9.0, 9.0), DEFAULT_GATE)
    assert (refused.status == UNCONVERGED).all() and refused.causes == everything.causes


@pytest.mark.parametrize(("precise", "kept"), [(9, 0), (10, 10)])
def test_a_flight_with_few_precise_positions_is_refused(precise: int, kept: int) -> None:
    state = np.tile([2.0, 0.0, 0.0], (100, 1))
    spread = np.tile(np.diag([0.04, 0.04, 1e-4]), (100, 1, 1))
    spread[50 : 50 + precise] *= 0.01
    none = np.zeros(100, np.int8)
    given = Estimate(np.arange(0.0, 100.0), state, spread, none, np.zeros(0), NoiseModel())
    out = with_status(given, none.astype(bool), (9.0, 9.0), DEFAULT_GATE)
    assert (out.status == OK).sum() == kept
    assert [cause.name for cause in out.causes] == ["positions are imprecise"] * (not kept)


@pytest.mark.parametrize(
    ("signal", "refused"), [("yaw rate", range(38, 53)), ("bearing", range(10, 81))]
)
def test_consistent_images_shorten_the_stretch_of_a_misfit(signal: str, refused: range) -> None:
    time_s = np.arange(0.0, 100.0)
    state = np.tile([2.0, 0.0, 0.0], (100, 1))
    spread = np.tile(np.diag([1e-4, 1e-4, 1e-4]), (100, 1, 1))
    cause = Cause(f"{signal} does not fit", 1.0, 40.0, 50.0)
    none = np.zeros(100, np.int8)
    given = Estimate(time_s, state, spread, none, np.zeros(0), NoiseModel(), causes=(cause,))
    # Only images before and after the stretch shorten it; one inside does not.
    for placed, expected in (
        (np.isin(time_s, [5, 38, 45, 52, 90]), refused),
        (np.isin(time_s, [45]), range(10, 81)),
    ):
        out = with_status(given, none.astype(bool), (9.0, 9.0), DEFAULT_GATE, placed=placed)
        assert np.flatnonzero(out.status == UNCONVERGED).tolist() == list(expected)


def test_stretches_apart_stay_apart_and_windows_of_a_flight_are_joined() -> None:
    one, two = Cause("range does not fit", 1.0, 0.0, 5.0), Cause("range does not fit", 1.0, 40, 50)
    assert join_causes([two, one]) == (one, two)
    listed = [replace(cause, name="range offset") for cause in (one, two)]
    assert join_causes(listed) == (replace(listed[0], to_s=50),)
    first = Innovation("flow", np.array([1.0]), np.array([2.0]), 1)
    (joined,) = join_innovations([[first], [replace(first, time_s=np.array([3.0]))]])
    assert joined.time_s.tolist() == [1.0, 3.0] and joined.robot == 1
    assert joined.seen_from_peer().robot == 0
