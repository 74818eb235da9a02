"""The equations of a swarm are those of its cost, by finite differences."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.model.odometry import RelativeMotion
from dmrl.estimation.solver.block_tridiagonal import NormalEquations
from dmrl.estimation.solver.keyframes import NoiseModel
from dmrl.estimation.solver.multi_robot import (
    ANCHOR_INFORMATION,
    CONSTANTS_PER_LINK,
    CONSTANTS_PER_ROBOT,
    STATES_PER_ROBOT,
    WEAK_INFORMATION,
    RangeLink,
    SwarmEstimate,
    SwarmProblem,
    _assemble_equations,
    _range_weights,
    _total_cost,
    _whiten_rows,
    marginals,
    solve,
)

NOISE = NoiseModel()
ROBOTS, KEYS, RANGES = 3, 5, 12
PAIRS = ((0, 1), (0, 2), (1, 2))


@pytest.fixture(scope="module")
def flight() -> SwarmProblem:
    """Measurements that belong to no motion: no residual is small by chance."""
    rng = np.random.default_rng(0)
    steps = KEYS - 1
    return SwarmProblem(
        names=["cf1", "cf2", "cf3"],
        keyframe_s=np.cumsum(rng.uniform(0.1, 0.4, KEYS)),
        motions=[
            RelativeMotion(*(rng.normal(size=s) for s in (steps, (steps, 2), (steps, 2, 2))))
            for _ in range(ROBOTS)
        ],
        paths=[(np.zeros(KEYS), np.zeros((KEYS, 2)))] * ROBOTS,
        dropout_s=rng.uniform(0, 0.1, (ROBOTS, steps)),
        links=[
            RangeLink(
                pair,
                np.sort(rng.integers(0, KEYS, RANGES)),
                rng.uniform(1, 3, RANGES),
                *rng.normal(size=(2, RANGES, 2)),
                rng.normal(size=RANGES),
            )
            for pair in PAIRS
        ],
    )


def test_the_gradient_is_the_slope_of_the_cost(flight: SwarmProblem) -> None:
    rng = np.random.default_rng(1)
    state = rng.normal(size=(KEYS, ROBOTS, STATES_PER_ROBOT))
    constants = 0.1 * rng.normal(
        size=ROBOTS * CONSTANTS_PER_ROBOT + len(PAIRS) * CONSTANTS_PER_LINK
    )

    def cost(at: np.ndarray, with_constants: np.ndarray) -> float:
        return _total_cost(
            flight, NOISE, _whiten_rows(flight, NOISE, at, with_constants), with_constants
        )

    rows = _whiten_rows(flight, NOISE, state, constants)
    found = _assemble_equations(flight, NOISE, rows, constants, _range_weights(NOISE, rows))
    step = 1e-5
    slopes = np.empty(state.size)
    for k in range(state.size):
        change = step * (np.arange(state.size) == k).reshape(state.shape)
        slopes[k] = (cost(state + change, constants) - cost(state - change, constants)) / (2 * step)
    scale = np.abs(slopes).max()
    assert found.gradient.ravel() == pytest.approx(slopes, rel=1e-4, abs=1e-7 * scale)
    for k in range(len(constants)):
        change = step * (np.arange(len(constants)) == k)
        slope = (cost(state, constants + change) - cost(state, constants - change)) / (2 * step)
        assert found.globals_gradient[k] == pytest.approx(slope, rel=1e-4, abs=1e-7 * scale)


def anywhere() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    state = rng.normal(size=(KEYS, ROBOTS, STATES_PER_ROBOT))
    return state, 0.1 * rng.normal(
        size=ROBOTS * CONSTANTS_PER_ROBOT + len(PAIRS) * CONSTANTS_PER_LINK
    )


def dense(flight: SwarmProblem, state: np.ndarray, constants: np.ndarray) -> np.ndarray:
    """Every row's derivatives by all states and constants, and its residual, by differences."""

    def residuals(at: np.ndarray) -> np.ndarray:
        rows = _whiten_rows(flight, NOISE, at[: state.size].reshape(state.shape), at[state.size :])
        parts = [*rows.steps, *rows.ranges]
        return np.concatenate([part[..., -1].ravel() for part in parts])

    at = np.concatenate([state.ravel(), constants])
    slopes = [
        (residuals(at + step) - residuals(at - step)) / 2e-6 for step in 1e-6 * np.eye(len(at))
    ]
    return np.column_stack([*slopes, residuals(at)])


def full(equations: NormalEquations) -> np.ndarray:
    size = ROBOTS * STATES_PER_ROBOT
    out = np.zeros((KEYS * size,) * 2)
    for k in range(KEYS):
        here = slice(k * size, (k + 1) * size)
        out[here, here] = equations.diagonal[k]
        if k + 1 < KEYS:
            after = slice((k + 1) * size, (k + 2) * size)
            out[here, after], out[after, here] = (
                equations.off_diagonal[k],
                equations.off_diagonal[k].T,
            )
    border = equations.coupling.reshape(KEYS * size, -1)
    return np.block([[out, border], [border.T, equations.globals_block]])


def test_equations_are_squares_of_the_slopes_of_every_row(flight: SwarmProblem) -> None:
    state, constants = anywhere()
    rows = _whiten_rows(flight, NOISE, state, constants)
    weights = _range_weights(NOISE, rows)
    slopes = dense(flight, state, constants)[:, :-1]
    counts = np.ones(len(slopes))
    counts[-len(PAIRS) * RANGES :] = np.concatenate(weights)
    wanted = slopes.T @ (counts[:, None] * slopes)
    std = [NOISE.gyro_std_radps, NOISE.velocity_scale_std, *[NOISE.velocity_bias_std_mps] * 2]
    prior = np.array(std * ROBOTS + [NOISE.bias_std_m, NOISE.scale_std] * len(PAIRS)) ** -2.0
    held = np.concatenate([np.tile(WEAK_INFORMATION, KEYS * ROBOTS), prior])
    held[:3] += ANCHOR_INFORMATION  # the first robot stands where the frame is
    wanted += np.diag(held)
    found = full(_assemble_equations(flight, NOISE, rows, constants, weights))
    scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    assert (np.abs(found - wanted) / scale).max() < 1e-5
    for ranges, weight in zip(rows.ranges, weights, strict=True):
        limit = (NOISE.range_loss_scale_m / NOISE.range_std_m) ** 2
        assert weight == pytest.approx(1 / (1 + ranges[:, -1] ** 2 / limit))


def test_the_spread_of_a_solution_is_the_inverse_of_all_equations(flight: SwarmProblem) -> None:
    state, constants = anywhere()
    rows = _whiten_rows(flight, NOISE, state, constants)
    equations = _assemble_equations(flight, NOISE, rows, constants, _range_weights(NOISE, rows))
    wanted = np.linalg.inv(full(equations))
    found = marginals(flight, NOISE, SwarmEstimate(state, constants, 0.0), state)
    size = ROBOTS * STATES_PER_ROBOT
    for k in range(KEYS):
        here = slice(k * size, (k + 1) * size)
        assert found[k] == pytest.approx(wanted[here, here], rel=1e-4, abs=1e-9)


def consistent(flight: SwarmProblem, state: np.ndarray, constants: np.ndarray) -> SwarmProblem:
    """The same flight, had its robots moved as a state and constants say."""
    own, shared = np.split(constants, [ROBOTS * CONSTANTS_PER_ROBOT])
    step_s, moves, links = np.diff(flight.keyframe_s), [], []
    for robot in range(ROBOTS):
        gyro, scale, *bias = own[robot * CONSTANTS_PER_ROBOT : (robot + 1) * CONSTANTS_PER_ROBOT]
        shift, turn = [], []
        for k, seconds in enumerate(step_s):
            (x, y, heading, *error), (x2, y2, heading2, *later) = state[k : k + 2, robot]
            c, s = np.cos(heading), np.sin(heading)
            way = np.array([c * (x2 - x) + s * (y2 - y), c * (y2 - y) - s * (x2 - x)])
            wrong = seconds / 2 * (np.array(error) + np.array(later))
            shift.append(
                (1 + scale) * way + flight.motions[robot].bias_jacobian_s[k] @ bias + wrong
            )
            turn.append(heading2 - heading + gyro * seconds)
        drift_s = flight.motions[robot].bias_jacobian_s
        moves.append(RelativeMotion(np.array(turn), np.array(shift), drift_s))
    for number, link in enumerate(flight.links):
        offset_m, scale = shared[number * CONSTANTS_PER_LINK : (number + 1) * CONSTANTS_PER_LINK]
        range_m = []
        for k, own_m, peer_m, up_m in zip(
            link.keyframe, link.own_shift_m, link.peer_shift_m, link.height_m, strict=True
        ):
            here, there = (state[k, robot] for robot in link.robots)
            at = [
                complex(*one[:2]) + complex(*shift) * np.exp(1j * one[2])
                for one, shift in ((here, own_m), (there, peer_m))
            ]
            range_m.append((1 + scale) * np.hypot(abs(at[1] - at[0]), up_m) + offset_m)
        links.append(replace(link, range_m=np.array(range_m)))
    return replace(flight, motions=moves, links=links)


def test_what_moved_as_was_measured_leaves_nothing_but_errors_that_fade(
    flight: SwarmProblem,
) -> None:
    state, constants = anywhere()
    step_s = np.diff(flight.keyframe_s)
    kept = np.exp(-step_s / NOISE.velocity_tau_s)
    for k in range(KEYS - 1):
        state[k + 1, :, 3:] = kept[k] * state[k, :, 3:]
    made = consistent(flight, state, constants)
    rows = _whiten_rows(made, NOISE, state, constants)
    for part in (*rows.steps, *rows.ranges):
        assert np.abs(part[..., -1]).max() < 1e-4
    # A residual of one is of one standard deviation.
    for robot in range(ROBOTS):
        gap_s = flight.dropout_s[robot] / 2
        place = NOISE.velocity_white_psd * step_s + NOISE.dropout_speed_mps**2 * gap_s
        turn = NOISE.yaw_rate_psd * step_s + NOISE.dropout_turn_radps**2 * gap_s
        error = NOISE.velocity_std_mps**2 * (1 - kept**2)
        steps = rows.steps[robot]
        assert steps[:, 2, STATES_PER_ROBOT + 2] == pytest.approx(turn**-0.5)
        assert steps[:, 3, STATES_PER_ROBOT + 3] == pytest.approx(error**-0.5)
        along = np.hypot(*steps[:, 0, :2].T) / abs(1 + constants[robot * CONSTANTS_PER_ROBOT + 1])
        assert along == pytest.approx(place**-0.5)
    for ranges in rows.ranges:
        assert ranges[:, 6] == pytest.approx(-1 / NOISE.range_std_m)


def test_a_solve_comes_back_to_what_was_flown(flight: SwarmProblem) -> None:
    state, _ = anywhere()
    state[:, :, 3:] = 0.0
    state[0, 0, :3] = 0.0
    constants = np.zeros(ROBOTS * CONSTANTS_PER_ROBOT + len(PAIRS) * CONSTANTS_PER_LINK)
    made = consistent(flight, state, constants)
    found = solve(made, NOISE, state + 0.02 * np.random.default_rng(2).normal(size=state.shape))
    assert found.cost < 0.1
    rows = _whiten_rows(made, NOISE, found.state, found.constants)
    assert found.cost == pytest.approx(_total_cost(made, NOISE, rows, found.constants))
    assert np.abs(found.state[:, 0, :2] - state[:, 0, :2]).max() < 0.05
    exact = solve(made, NOISE, state)
    assert exact.cost < 1e-6 and np.abs(exact.state - state).max() < 1e-3


def test_what_other_flights_know_is_held_as_closely_as_they_know_it(flight: SwarmProblem) -> None:
    state, constants = anywhere()
    rows = _whiten_rows(flight, NOISE, state, constants)
    first = ROBOTS * CONSTANTS_PER_ROBOT
    known = np.full(len(constants), np.inf)
    known[[0, first]] = 0.001, 0.01  # the first robot's yaw rate, and the first link's offset
    known[1] = 10.0  # no better than is usual
    closer = replace(flight, calibrated_std=known)
    loose, held = (
        np.diag(
            _assemble_equations(
                f, NOISE, rows, constants, _range_weights(NOISE, rows)
            ).globals_block
        )
        for f in (flight, closer)
    )
    more = np.zeros(len(constants))
    more[0] = 0.001**-2 - NOISE.gyro_std_radps**-2
    more[first] = 0.01**-2 - NOISE.bias_std_m**-2
    assert held - loose == pytest.approx(more, rel=1e-9, abs=1e-6)
    more_cost = (constants**2 * more).sum() / 2
    cost, closer_cost = (_total_cost(f, NOISE, rows, constants) for f in (flight, closer))
    assert closer_cost - cost == pytest.approx(more_cost)
