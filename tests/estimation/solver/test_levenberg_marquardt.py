from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver import block_tridiagonal
from dmrl.estimation.solver import covariance as confidence
from dmrl.estimation.solver.covariance import (
    CONSTANT_INFLATION,
    RANGE_CONSTANT_INFLATION,
    _inflate_marginals,
)
from dmrl.estimation.solver.keyframes import GLOBALS, KeyframeProblem, NoiseModel, build_keyframes
from dmrl.estimation.solver.levenberg_marquardt import (
    SAME_SOLUTION_M,
    WEAK_INFORMATION,
    MapEstimate,
    add_damping,
    build_equations,
    is_same_solution,
    laplace_log_evidence,
    solve,
)
from dmrl.estimation.solver.residuals import (
    OWN_SCALE,
    PEER_SCALE,
    RANGE_BIAS,
    RANGE_ERROR,
    RANGE_STATES,
    STATE_SIZE,
    linearize,
    step_variance,
)
from dmrl.estimation.solver.robust_loss import irls_weights, total_cost

from ..flights import flown, pair_of, truth_at

NOISE = NoiseModel()


@pytest.fixture(scope="module")
def flight() -> KeyframeProblem:
    return build_keyframes(pair_of(flown("in_view", "realistic", 1000, 10.0)))


@pytest.fixture(scope="module")
def anywhere(flight: KeyframeProblem) -> tuple[Array, Array]:
    """A state and globals that are nowhere near the solution."""
    rng = np.random.default_rng(0)
    return rng.normal(size=(len(flight.keyframe_s), STATE_SIZE)), 0.05 * rng.normal(
        size=len(GLOBALS)
    )


def test_the_jacobian_by_the_globals_is_that_of_finite_differences(
    flight: KeyframeProblem, anywhere: tuple[Array, Array]
) -> None:
    state, constants = anywhere
    linear, step = linearize(flight, NOISE, state, constants), 1e-6
    for column in range(len(GLOBALS)):
        change = step * np.eye(len(GLOBALS))[column]
        ahead, behind = (linearize(flight, NOISE, state, constants + s * change) for s in (1, -1))
        slope = (ahead.step - behind.step) / (2 * step)
        scale = max(1.0, np.abs(slope).max())
        assert np.abs(slope - linear.steps[..., 2 * STATE_SIZE + column]).max() < 1e-6 * scale
        slope = (ahead.range - behind.range) / (2 * step)
        expected = linear.ranges[:, 4 + column] if column < 2 else 0.0
        assert np.abs(slope - expected).max() < 1e-5


def test_the_jacobian_by_the_keyframes_is_that_of_finite_differences(
    flight: KeyframeProblem, anywhere: tuple[Array, Array]
) -> None:
    state, constants = anywhere
    linear, step = linearize(flight, NOISE, state, constants), 1e-6
    even = np.arange(len(state)) % 2 == 0
    for column in range(STATE_SIZE):
        change = np.zeros_like(state)
        change[even, column] = step
        ahead, behind = (linearize(flight, NOISE, state + s * change, constants) for s in (1, -1))
        slope = (ahead.step - behind.step) / (2 * step)
        own = np.where(even[:-1, None], linear.steps[..., column], 0.0)
        own += np.where(even[1:, None], linear.steps[..., STATE_SIZE + column], 0.0)
        assert np.abs(slope - own).max() < 1e-6 * max(1.0, np.abs(slope).max())
        slope = (ahead.range - behind.range) / (2 * step)
        by_state = linear.ranges[:, RANGE_STATES.index(column)] if column in RANGE_STATES else 0.0
        expected = np.where(even[flight.range_keyframe], by_state, 0.0)
        assert np.abs(slope - expected).max() < 1e-2  # ranges near zero bend sharply


def dense(equations: block_tridiagonal.NormalEquations) -> Array:
    keyframes, size = equations.gradient.shape
    full = np.zeros((keyframes * size,) * 2)
    for k in range(keyframes):
        here = slice(k * size, (k + 1) * size)
        full[here, here] = equations.diagonal[k]
        if k + 1 < keyframes:
            after = slice((k + 1) * size, (k + 2) * size)
            full[here, after], full[after, here] = (
                equations.off_diagonal[k],
                equations.off_diagonal[k].T,
            )
    border = equations.coupling.reshape(-1, len(equations.globals_block))
    return np.block([[full, border], [border.T, equations.globals_block]])


def test_the_banded_solve_is_the_dense_one(
    flight: KeyframeProblem, anywhere: tuple[Array, Array]
) -> None:
    state, constants = anywhere
    equations = build_equations(
        flight, NOISE, linearize(flight, NOISE, state, constants), constants
    )
    full = dense(equations)
    right = np.concatenate([equations.gradient.ravel(), equations.globals_gradient])
    expected = -np.linalg.solve(full, right)
    change, change_constants, response, covariance = block_tridiagonal.solve_step(equations)
    assert np.allclose(np.concatenate([change.ravel(), change_constants]), expected, rtol=1e-6)

    inverse = np.linalg.inv(full)
    assert np.allclose(covariance, inverse[change.size :, change.size :], rtol=1e-6)
    blocks = block_tridiagonal.marginal_covariances(equations.diagonal, equations.off_diagonal)
    blocks += response @ covariance @ response.swapaxes(1, 2)
    for k in (0, 50, len(blocks) - 1):
        here = slice(k * STATE_SIZE, (k + 1) * STATE_SIZE)
        assert np.allclose(blocks[k], inverse[here, here], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("constant", [RANGE_BIAS, OWN_SCALE])
def test_what_is_constant_counts_for_more_in_a_keyframe_s_spread(constant: int) -> None:
    """Two keyframes are a constant, known to 0.5, with an error of 0.1 each."""
    border = np.zeros((2, 1, len(GLOBALS)))
    border[:, 0, constant] = -100.0
    corner = np.eye(len(GLOBALS))
    corner[constant, constant] = 200.0 + 0.5**-2
    blocks = np.full((2, 1, 1), 100.0)
    nothing = np.zeros((2, 1)), np.zeros(len(GLOBALS))
    equations = block_tridiagonal.NormalEquations(
        blocks, np.zeros((1, 1, 1)), border, corner, *nothing
    )
    spread, constants = _inflate_marginals(equations)
    wider = RANGE_CONSTANT_INFLATION if constant == RANGE_BIAS else CONSTANT_INFLATION
    wanted = (confidence.NOISE_INFLATION * 0.1) ** 2 + (wider * 0.5) ** 2
    assert spread == pytest.approx(np.full((2, 1, 1), wanted))
    assert constants[constant, constant] == pytest.approx(0.5**2)


def test_without_noise_the_solution_is_the_truth_and_the_constants_vanish() -> None:
    flight = flown("in_view", "ideal", 1000, 30.0)
    task = build_keyframes(pair_of(flight))
    truth = truth_at(flight, task.keyframe_s)
    heading = flight.truth["cf2"].yaw_at(task.keyframe_s) - flight.truth["cf1"].yaw_at(
        task.keyframe_s
    )
    start = np.column_stack([truth + 0.1, heading - 0.1])
    solution = solve(task, NOISE, start)
    assert np.abs(solution.state[:, :2] - truth).max() < 0.01
    assert np.abs(solution.constants[:6]).max() < 0.01


def test_a_range_bias_is_found_where_it_may_be_large() -> None:
    flight = flown("random", "ideal", 1003, 30.0)
    pair = pair_of(flight)
    task = build_keyframes(replace(pair, range_m=pair.range_m + 0.2))
    truth = truth_at(flight, task.keyframe_s)
    heading = flight.truth["cf2"].yaw_at(task.keyframe_s) - flight.truth["cf1"].yaw_at(
        task.keyframe_s
    )
    noise = NoiseModel(bias_std_m=0.5, velocity_std_mps=0.02)
    solution = solve(task, noise, np.column_stack([truth, heading]))
    assert solution.constants[0] == pytest.approx(0.2, abs=0.03)


@pytest.fixture(scope="module")
def solved() -> tuple[KeyframeProblem, Array, MapEstimate]:
    """A flight, a guess that is some decimetres off, and the solution."""
    flight = flown("in_view", "calibrated", 1000, 30.0)
    task = build_keyframes(pair_of(flight))
    heading = flight.truth["cf2"].yaw_at(task.keyframe_s) - flight.truth["cf1"].yaw_at(
        task.keyframe_s
    )
    start = np.column_stack([truth_at(flight, task.keyframe_s) + 0.2, heading])
    return task, start, solve(task, NOISE, start)


def test_an_iteration_ends_where_it_comes_to_a_known_solution(
    solved: tuple[KeyframeProblem, Array, MapEstimate],
) -> None:
    task, start, solution = solved
    again = solve(task, NOISE, start, previous=[solution])
    assert is_same_solution(again.state, solution.state)
    assert again.cost > solution.cost


def test_a_solve_that_starts_at_the_solution_stays_there(
    solved: tuple[KeyframeProblem, Array, MapEstimate],
) -> None:
    task, _, solution = solved
    again = solve(task, NOISE, solution.state, solution.constants)
    assert again.cost <= solution.cost
    assert np.abs(again.state - solution.state).max() < 1e-2
    assert np.abs(again.constants - solution.constants).max() < 1e-3


def test_after_bursts_the_ranges_are_as_long_as_before() -> None:
    flight = flown("in_view", "calibrated", 1000, 60.0)
    pair, begins_s = pair_of(flight), np.arange(5.0, 55.0, 9.0)
    late_s = pair.range_time_s[:, None] - begins_s
    bursts = ((late_s > 0.0) & (late_s < 3.0)).any(axis=1)
    whole = build_keyframes(replace(pair, range_m=pair.range_m + bursts))
    state = np.zeros((len(whole.keyframe_s), STATE_SIZE))
    state[:, :2] = truth_at(flight, whole.keyframe_s)
    state[:, 2] = np.subtract(
        *(flight.truth[who].yaw_at(whole.keyframe_s) for who in ("cf2", "cf1"))
    )
    state[whole.range_keyframe, RANGE_ERROR] = bursts
    found = solve(whole, NoiseModel(), state)
    since_s = whole.keyframe_s[:, None] - begins_s
    free = ~((since_s > -1.0) & (since_s < 4.0)).any(axis=1)
    assert np.abs(found.state[free, RANGE_ERROR]).max() < 0.03  # a jump by anything left 0.06 m


def test_residuals_are_none_where_all_goes_as_the_processes_say(flight: KeyframeProblem) -> None:
    """A velocity error and a range error that fade, and nothing else."""
    count = len(flight.keyframe_s)
    still = replace(
        flight.own,
        turn_rad=0 * flight.own.turn_rad,
        shift_m=0 * flight.own.shift_m,
    )
    quiet = replace(flight, own=still, peer=still)
    faded = np.exp(-(flight.keyframe_s - flight.keyframe_s[0]) / NOISE.velocity_tau_s)
    longer = np.exp(-(flight.keyframe_s - flight.keyframe_s[0]) / NOISE.range_tau_s)
    state = np.zeros((count, STATE_SIZE))
    error = np.array([0.4, -0.3])
    state[:, 3:5], state[:, RANGE_ERROR] = faded[:, None] * error, 0.2 * longer
    steps_s = np.diff(flight.keyframe_s)[:, None]
    moved = np.cumsum(steps_s * (state[1:, 3:5] + state[:-1, 3:5]) / 2, axis=0)
    state[1:, :2] = moved  # a measured velocity that is too low by its error
    found = linearize(quiet, NOISE, state, np.zeros(len(GLOBALS))).step
    assert np.abs(found).max() < 1e-9
    for column in range(STATE_SIZE):
        other = state.copy()
        other[5, column] += 1e-3
        off = np.abs(linearize(quiet, NOISE, other, np.zeros(len(GLOBALS))).step)
        assert off[[4, 5]].max() > 1e-4 and np.delete(off, [4, 5], axis=0).max() < 1e-9


def test_evidence_is_laplace_s_and_says_nothing_of_what_is_no_density(
    flight: KeyframeProblem, anywhere: tuple[Array, Array]
) -> None:
    state, constants = anywhere
    noise = replace(NOISE, range_std_m=0.2)
    solution = MapEstimate(state, constants, 0.0)
    plain = replace(noise, range_error_weight=0.0)
    linear = linearize(flight, plain, state, constants)
    full = dense(build_equations(flight, plain, linear, constants))
    gains = 1 / (1 + constants[[OWN_SCALE, PEER_SCALE]])
    share = np.log((gains**2).mean()) / 2  # of each of four residuals of a step
    spread = np.log(step_variance(flight, noise)).sum() / 2 + 4 * len(flight.steps_s) * share
    spread += len(flight.range_m) * np.log(0.2) + np.log(noise.prior_std()).sum()
    wanted = -total_cost(linear, plain, constants) - spread - np.linalg.slogdet(full)[1] / 2
    assert laplace_log_evidence(flight, noise, solution) == pytest.approx(wanted, rel=1e-6)


def test_two_flights_are_near_that_are_nowhere_apart() -> None:
    here = np.zeros((5, 6))
    for off, same in ((0.99 * SAME_SOLUTION_M, True), (1.01 * SAME_SOLUTION_M, False)):
        there = here.copy()
        there[3, :2], there[:, 2:] = np.array([0.6, -0.8]) * off, 9.0
        assert is_same_solution(here, there) == same


def test_a_solve_finds_the_lowest_cost_from_either_side(
    solved: tuple[KeyframeProblem, Array, MapEstimate],
) -> None:
    task, _, solution = solved
    linear = linearize(task, NOISE, solution.state, solution.constants)
    assert solution.cost == pytest.approx(total_cost(linear, NOISE, solution.constants))
    equations = build_equations(task, NOISE, linear, solution.constants)
    assert np.abs(equations.globals_gradient * np.sqrt(NOISE.prior_std())).max() < 5.0
    rng = np.random.default_rng(1)
    for _ in range(3):
        off = 1e-3 * rng.normal(size=solution.state.shape)
        more = 0.05 * NOISE.prior_std() * rng.normal(size=len(GLOBALS))
        beside = linearize(task, NOISE, solution.state + off, solution.constants + more)
        assert total_cost(beside, NOISE, solution.constants + more) > solution.cost


def test_equations_are_squares_of_the_slopes_of_every_row(
    flight: KeyframeProblem, anywhere: tuple[Array, Array]
) -> None:
    state, constants = anywhere
    linear = linearize(flight, NOISE, state, constants)
    weights = irls_weights(linear, NOISE, constants)
    keys, globals_ = len(state), len(GLOBALS)
    rows = np.zeros((6 * (keys - 1) + len(flight.range_m), keys * STATE_SIZE + globals_ + 1))
    for k in range(keys - 1):
        mine = slice(6 * k, 6 * k + 6)
        rows[mine, k * STATE_SIZE : (k + 2) * STATE_SIZE] = linear.steps[k, :, : 2 * STATE_SIZE]
        rows[mine, keys * STATE_SIZE :] = linear.steps[k, :, 2 * STATE_SIZE :]
    for n, k in enumerate(flight.range_keyframe):
        row = rows[6 * (keys - 1) + n]
        row[k * STATE_SIZE + np.array(RANGE_STATES)] = linear.ranges[n, :4]
        row[keys * STATE_SIZE : keys * STATE_SIZE + 2], row[-1] = (
            linear.ranges[n, 4:6],
            linear.ranges[n, 6],
        )
    counts = np.concatenate([weights.step.ravel(), weights.range])
    products = rows.T @ (counts[:, None] * rows)
    errors = np.arange(keys) * STATE_SIZE + RANGE_ERROR
    held = weights.free.copy()
    held[0] += weights.first
    prior = weights.prior * NOISE.prior_std() ** -2
    right = products[:-1, -1].copy()
    right[errors] += held * state[:, RANGE_ERROR]
    right[keys * STATE_SIZE :] += prior * constants
    wanted = products[:-1, :-1] + np.diag(np.concatenate([np.tile(WEAK_INFORMATION, keys), prior]))
    wanted[errors, errors] += held
    found = build_equations(flight, NOISE, linear, constants)
    np.testing.assert_allclose(dense(found), wanted, rtol=1e-9, atol=1e-7)
    gradient = np.concatenate([found.gradient.ravel(), found.globals_gradient])
    np.testing.assert_allclose(gradient, right, rtol=1e-9, atol=1e-7)
    steeper = add_damping(found, 0.5).diagonal
    np.testing.assert_allclose(steeper, found.diagonal * (1 + 0.5 * np.eye(STATE_SIZE)))
    assert add_damping(found, 0.0) is found
